"""Other minima of a fit with dry friction: where a plant that rests begins to move or not, levels lie between them.

Each rest that holds, or does not, is another piece of the squared error over the level: a descent ends in the piece
where it began, and the curvature there says nothing of the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import form_of
from autotune.diagnosis.equations.scores import attempt
from autotune.models import Effect

#: From one level to the next, in each direction so many at most, each with so many iterations.
FACTOR, LEVELS, ITERATIONS = 1.5, 4, 8
#: Times the least squared error, from which on a direction is left.
TOO_FAR = 1.2


def with_force(effect: Effect, times: float) -> Effect:
    """Return dry friction with so many times its force, any other effect as it is."""
    levels = form_of(effect).levels
    return effect.with_values({key: times * value for key, value in effect.values.items() if key in levels})


def sweep_levels(bench: Bench, one: Outcome) -> list[Outcome]:
    """Return a fit with dry friction and those from forces above and below it, each from the one before.

    Parameters
    ----------
    bench : Bench
        The model on its recordings.
    one : Outcome
        Where to begin.

    Returns
    -------
    list of Outcome
        The one given first; what runs away, or leaves far more than the best, ends a direction.
    """
    found = [one]
    if not any(form_of(effect).levels for effect in one.effects):
        return found
    for factor in (FACTOR, 1.0 / FACTOR):
        at: Outcome | None = min(found, key=lambda other: other.rss)
        for _ in range(LEVELS):
            assert at is not None
            at = attempt(bench, [with_force(effect, factor) for effect in at.effects], at, ITERATIONS)
            if at is None or at.rss > TOO_FAR * min(other.rss for other in found):
                break
            found.append(at)
    return found


def select_minimum(bench: Bench, fits: Sequence[Outcome], rows: float, ratio: float) -> Outcome:
    """Return the minimum that predicts best among those that rows do not tell apart, its levels as far as the others.

    Parameters
    ----------
    bench : Bench
        The model on its recordings.
    fits : sequence of Outcome
        Fits of the same effects.
    rows : float
        Rows that count.
    ratio : float
        The residual's variance in units of the noise's: where the model's error is left, rows say so much less.

    Notes
    -----
    Minima are told apart where the profile of the likelihood is one standard deviation worse: rows ln(squared error /
    the least) > max(ratio, 1). A level's standard deviation reaches at least to the others. Where there
    are several, the held-out error has told which is taken, and as the error of what was taken it is a little too good.
    """
    least = min(one.rss for one in fits)
    near = [one for one in fits if rows * np.log(one.rss / least) < max(ratio, 1.0)]
    best = near[0] if len(near) == 1 else min(near, key=lambda one: bench.held_out_error(one, True))
    effects = []
    for i, effect in enumerate(best.effects):
        parameters = dict(effect.parameters)
        for key in form_of(effect).levels:
            if key in parameters:
                q = parameters[key]
                far = max(abs(one.effects[i].parameters[key].value - q.value) for one in near)
                parameters[key] = replace(q, sd=max(q.sd, far))
        effects.append(replace(effect, parameters=MappingProxyType(parameters)))
    return replace(best, effects=tuple(effects))
