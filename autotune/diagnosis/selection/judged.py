"""Hypotheses judged by what they leave: compared in pairs, ranked, weighed. Chains and equations are judged alike.

Where one of two leaves noise alone, rows are independent witnesses and the likelihood of the rows decides. Where both
err by more, the model's own error decides and rows are none: then stretches that were left out are what counts.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.stretches import advantage, reduction
from autotune.diagnosis.selection.probability import Candidate, weighed
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of

#: Leading hypotheses that are compared as what is material in them.
LEADING = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged(ABC):
    """A hypothesis with its errors on left-out stretches.

    Attributes
    ----------
    names : tuple of str
        Its effects.
    long_squares, short_squares : (K,) array
        Squared errors on left-out stretches, of fits to long windows and to short ones.
    log_odds : float
        Logarithm of its prior odds.
    """

    names: tuple[str, ...]
    long_squares: FloatArray
    short_squares: FloatArray
    log_odds: float

    @property
    @abstractmethod
    def limits(self) -> Thresholds:
        """What decides between two findings."""

    @property
    @abstractmethod
    def leaves_noise(self) -> bool:
        """Whether what it leaves is noise, and rows that were left out are foretold about as well."""

    @property
    @abstractmethod
    def variance(self) -> float:
        """Variance of the innovations of what it leaves."""

    @property
    @abstractmethod
    def rows(self) -> int:
        """Rows that it was fitted to."""

    @property
    @abstractmethod
    def numbers(self) -> int:
        """Numbers of its effects that were fitted."""

    @property
    @abstractmethod
    def identity(self) -> frozenset[object]:
        """What tells hypotheses apart that are fitted."""

    @property
    def vanished(self) -> frozenset[str]:
        """Effects that came to nothing on long windows."""
        return frozenset()

    def behind(self, other: Judged) -> float:
        """Return twice the logarithm of the odds that another hypothesis is the better one, priors counted.

        Where both leave noise that is what rows say. Where neither does, the model's error decides, and it is what
        stretches say that were left out. Where one does, rows may speak for it, but not against it: what leaves more
        than noise, or foretells nothing, is no better for what it makes of the rows that it was fitted to.
        """
        prior = 2.0 * (self.log_odds - other.log_odds)
        if self.leaves_noise and other.leaves_noise:
            return self._by_rows(other) - prior
        if other.leaves_noise:
            return max(self._by_rows(other), self._by_stretches(other)) - prior
        if self.leaves_noise:
            return min(self._by_rows(other), self._by_stretches(other)) - prior
        return self._by_stretches(other) - prior

    def _by_rows(self, other: Judged) -> float:
        """Return what the innovations of all rows say for another hypothesis: Schwarz's criterion, cooled.

        Noise is never ideal: ``temperature`` units of chi-square count as one.
        """
        said = self.rows * math.log(self.variance / other.variance)
        said += (self.numbers - other.numbers) * math.log(self.rows)
        return said / self.limits.temperature

    def _by_stretches(self, other: Judged) -> float:
        """Return what stretches that were left out say for another hypothesis.

        The scale, long or short, at which they differ more decides, unless the other one contradicts it. Stretches have
        the rig and its excitation in common: together they speak for no more than ``most_evidence``, however well they
        agree, unless the error is far smaller at both scales: so much that ``error_witnesses`` errors, independent and
        of unknown size, would say more.
        """
        scales = ((self.long_squares, other.long_squares), (self.short_squares, other.short_squares))
        limits = self.limits
        agree = [advantage(*pair) for pair in scales]
        capped = min(max(max(agree) if sum(agree) > 0.0 else min(agree), -limits.most_evidence), limits.most_evidence)
        smaller = [limits.error_witnesses * reduction(*pair) for pair in scales]
        least = min(smaller, key=abs) if smaller[0] * smaller[1] > 0.0 else 0.0
        return least if least * capped > 0.0 and abs(least) > abs(capped) else capped

    def is_better(self, other: Judged, share: float) -> bool:
        """Whether it takes a share of another one's held-out error away, at one of the scales.

        What it has beyond the other one may have come to nothing on long windows: then short ones do not speak for it.
        What happens at a time of its own explains a part of everything: it must take away more, and since it lasts,
        at both scales. Near the noise whatever rows speak for is better.
        """
        if self.leaves_noise or other.leaves_noise:
            return other.behind(self) > 0.0
        extra = set(self.names) - set(other.names)
        at_nothing = bool(extra) and extra <= self.vanished
        long, short = (
            math.sqrt(float(mine.sum() / its.sum()))
            for mine, its in ((self.long_squares, other.long_squares), (self.short_squares, other.short_squares))
        )
        if any(kind_of(name).is_event for name in extra):
            return max(long, short) < 1.0 - max(share, self.limits.material_event)
        return (long if at_nothing else min(long, short)) < 1.0 - share


_J = TypeVar("_J", bound=Judged)


def worst(one: Judged, others: Sequence[Judged]) -> float:
    """Return how far a hypothesis is behind the one that is farthest ahead of it, in units of 2 ln odds."""
    return max((one.behind(other) for other in others if other is not one), default=0.0)


def ranked(found: Sequence[_J]) -> list[_J]:
    """Return hypotheses by how far the best rival of each is ahead of it: the first is beaten by none, or by least."""
    return sorted(found, key=lambda j: worst(j, found))


def leading(found: Sequence[_J], count: int) -> list[_J]:
    """Return the first of a ranking, the best one of each set of effects."""
    best: dict[frozenset[object], _J] = {}
    for one in ranked(found):
        best.setdefault(one.identity, one)
    return list(best.values())[:count]


def simplest(found: Sequence[_J], material: float) -> _J:
    """Return the hypothesis that stretches speak for most, priors counted, without what is not material in any.

    Each of the leading ones is first freed of what is not material in it, and they are compared as what they then are.
    """
    order = ranked(found)
    return min((_freed(one, order, material) for one in leading(found, LEADING)), key=lambda one: worst(one, found))


def _freed(best: _J, order: Sequence[_J], material: float) -> _J:
    """Return a hypothesis without what is not material in it: one of those that were judged."""
    while best.names:
        lesser = [j for j in order if j.identity < best.identity and not best.is_better(j, material)]
        if not lesser:
            break
        best = lesser[0]
    return best


def probabilities(found: Sequence[_J], best: _J, unknown_odds: float) -> tuple[Candidate, ...]:
    """Return every hypothesis with its probability, by how far it is behind the one that is farthest ahead of it.

    Parameters
    ----------
    found : sequence of Judged
        All hypotheses.
    best : Judged
        The one that was chosen: what was more, and not material, speaks for it too.
    unknown_odds : float
        Prior odds of a cause that is none of them.
    """
    scores: dict[str, float] = {}
    for one in found:
        rivals = [other for other in found if other.identity != one.identity]
        scores[_called(one)] = min(scores.get(_called(one), math.inf), max(worst(one, rivals), 0.0))
    scores[_called(best)] = min(scores.values())
    return weighed(scores, 1.0, unknown_odds)


def _called(one: Judged) -> str:
    return "+".join(one.names) if one.names else "none"
