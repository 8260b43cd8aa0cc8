"""How probable a hypothesis is beside the others that were fitted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

from autotune.effects import KINDS, counted_as


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A hypothesis with its probability."""

    name: str
    probability: float


def weighed(scores: Mapping[str, float], unknown_odds: float) -> tuple[Candidate, ...]:
    """Return probabilities of hypotheses from their scores, best first, a cause that is none of them included.

    Parameters
    ----------
    scores : mapping
        Twice the logarithm of the odds against each, by name.
    unknown_odds : float
        Prior odds of what is none of them, beside 1 of all together.
    """
    best = min(scores.values())
    weights = {name: math.exp(-0.5 * (value - best)) for name, value in scores.items()}
    weights["unknown"] = unknown_odds * sum(weights.values())
    total = sum(weights.values())
    ranked = sorted(weights.items(), key=lambda item: -item[1])
    return tuple(Candidate(name=name, probability=w / total) for name, w in ranked if w / total > 1e-4)


def probability_of(name: str, candidates: Sequence[Candidate]) -> float:
    """Return the probability that an effect is part of the truth: as such, in a larger one, or as one like it."""
    return _sum_of(counted_as(name), candidates)


def share_of(name: str, candidates: Sequence[Candidate]) -> float:
    """Return the share that an effect has in its probability beside those like it, as a lag has beside a dead time."""
    group = counted_as(name)
    total = _sum_of(group, candidates)
    return _sum_of(group - set(KINDS[name].like), candidates) / total if total > 0.0 else 1.0


def _sum_of(names: Set[str], candidates: Sequence[Candidate]) -> float:
    """Return the probability of all hypotheses that have one of the effects."""
    return sum((c.probability for c in candidates if names & set(c.name.split("+"))), 0.0)
