"""Fits of equations with dry friction: from other levels, and which of their minima is taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import form_of
from autotune.diagnosis.equations.scores import attempt
from autotune.diagnosis.fitting.levels import sweep
from autotune.models import Effect

#: Iterations of a fit from one level to the next.
ITERATIONS = 8


def with_force(effect: Effect, times: float) -> Effect:
    """Return dry friction with so many times its force, any other effect as it is."""
    levels = form_of(effect).levels
    return effect.with_values({key: times * value for key, value in effect.values.items() if key in levels})


def sweep_levels(bench: Bench, one: Outcome) -> list[Outcome]:
    """Return a fit and, where it has dry friction, those from forces above and below it.

    Parameters
    ----------
    bench, one
        The model on its recordings; where to begin.
    """
    if not any(form_of(effect).levels for effect in one.effects):
        return [one]

    def fitted_at(at: Outcome, factor: float) -> Outcome | None:
        return attempt(bench, [with_force(effect, factor) for effect in at.effects], at, ITERATIONS)

    return sweep(one, fitted_at, lambda other: other.rss)


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
