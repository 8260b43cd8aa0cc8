"""How probable what a search in equations found is, and what is too improbable to be named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.diagnosis.equations.bench import Outcome
from autotune.diagnosis.equations.candidates import key_of
from autotune.diagnosis.equations.search import Searched
from autotune.diagnosis.selection.probability import Candidate, weighed
from autotune.effects import kind_of
from autotune.models import Effect


def candidates_of(found: Searched, unknown: float) -> tuple[Candidate, ...]:
    """Return the hypotheses of a search with their probabilities, best first.

    Parameters
    ----------
    found : Searched
        The hypotheses.
    unknown : float
        Prior odds of a cause that is none of them.
    """
    scores: dict[str, float] = {}
    base = len(found.retuned.effects)
    for one in (found.retuned, *found.tried):
        name = "+".join(e.name for e in one.effects[base:]) or "none"
        scores[name] = min(scores.get(name, np.inf), found.score(one) + _charge(one, found))
    return weighed(scores, found.limits.temperature * max(1.0, found.variance_ratio(found.chosen)), unknown)


def _charge(one: Outcome, found: Searched) -> float:
    """Return what a hypothesis of needless further effects pays: what it is ahead of the chosen one, and more.

    Other forms of the effects that were chosen pay nothing: which of them is true is what a probability says.
    """
    ahead = found.score(found.chosen) - found.score(one)
    more = len(one.effects) > len(found.chosen.effects)
    return ahead + found.limits.equation_decrease if more and ahead > 0.0 else 0.0


def probability_of(effect: Effect, candidates: Sequence[Candidate]) -> float:
    """Return the probability that an effect acts, or one that recordings cannot tell from it."""
    same = set(kind_of(effect.name).same)
    total = sum(c.probability for c in candidates if {effect.name, *same} & set(c.name.split("+")))
    return float(min(max(total, 0.0), 0.99))


def without_improbable(found: Searched) -> Searched:
    """Return a search whose choice has no effects beside others that are less probable than is named.

    A small rest may be explained as well by a load, a bend and a torque: then none of them is told from the others.
    Where the model's error and not noise is left, rows are no witnesses, and what stretches decided stays.
    """
    own = len(found.retuned.effects)
    while len(found.chosen.effects) - own > 1:
        candidates = candidates_of(found, found.limits.unknown_odds)
        each = [probability_of(e, candidates) for e in found.chosen.effects[own:]]
        least = int(np.argmin(each))
        names = [key_of(e) for i, e in enumerate(found.chosen.effects) if i != own + least]
        smaller = [one for one in found.tried if sorted(key_of(e) for e in one.effects) == sorted(names)]
        if each[least] >= found.limits.least_named or not smaller:
            break
        best = min(smaller, key=found.score)
        if found.variance_ratio(best) > found.limits.equation_astray:
            break
        found = replace(found, chosen=best)
    return found
