"""Hypotheses judged by what they leave: compared in pairs, ranked, weighed. Chains and equations are judged alike.

A hypothesis leaves noise and a discrepancy, what it lacks. Noise is new in every row; a discrepancy goes on and on, so
that a stretch of the recordings says no more of it than one independent number would. One formula has both: see
:meth:`Judged.behind`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import TypeVar

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.stretches import STRETCHES, reduction
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.selection.probability import Candidate, weighed
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import called


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
    def noise(self) -> Noise:
        """The noise that what it leaves shows from row to row."""

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
    def judged_rows(self) -> tuple[int, int]:
        """Rows that are judged on left-out stretches of long windows, and of short ones."""

    @property
    @abstractmethod
    def numbers(self) -> int:
        """Numbers of its effects that were fitted."""

    @property
    def most_foretold(self) -> float:
        """Error of rows that were left out over the noise, up to which it may be that of start states alone."""
        return self.limits.foretold

    @property
    @abstractmethod
    def identity(self) -> frozenset[object]:
        """What tells hypotheses apart that are fitted."""

    @property
    def log_squares(self) -> float:
        """Logarithm of its squared errors on left-out stretches, the mean of both scales."""
        return 0.5 * math.log(float(self.long_squares.sum()) * float(self.short_squares.sum()))

    def behind(self, other: Judged) -> float:
        """Return twice the logarithm of the odds that another hypothesis is the better one, priors counted.

        Notes
        -----
        Of N rows with noise of variance s^2 and a discrepancy of mean square d^2 that has K independent values, one
        in each stretch, K directions of the residual have the variance s^2 + N d^2/K and all others s^2. With d of a
        size that is not known, two hypotheses differ in twice their log likelihood by

            K ln((1 + N d1^2/(K s^2)) / (1 + N d2^2/(K s^2))).

        Near the noise that is the difference of their chi-squares, every row a witness; far from it K ln(d1^2/d2^2),
        every stretch one. What is left inside the fitted rows pays ln N for each number (Schwarz 1978), what is left
        of stretches that were not fitted pays nothing, and the larger of both is the discrepancy (Kennedy & O'Hagan,
        J. R. Statist. Soc. B 63, 2001). The noise is that of the quieter one: what moves fast may be missing physics.
        """
        noise = min((self.noise, other.noise), key=lambda each: each.total_sd)
        scales = zip(self._spread_over_stretches(noise), other._spread_over_stretches(noise), strict=True)
        said = STRETCHES * fmean(reduction(mine, its) for mine, its in scales) / self.limits.temperature
        return said - 2.0 * (self.log_odds - other.log_odds)

    def _spread_over_stretches(self, noise: Noise) -> tuple[FloatArray, FloatArray]:
        """Return 1 + N d^2/(K s^2) by every stretch, of long windows and of short ones."""
        inside = self.variance / noise.sd**2 - 1.0 + self.numbers * math.log(self.rows) / self.rows
        scales = zip((self.long_squares, self.short_squares), self.judged_rows, strict=True)
        outside = (STRETCHES * squares / (rows * noise.total_sd**2) - self.most_foretold**2 for squares, rows in scales)
        long, short = (1.0 + self.rows / STRETCHES * np.maximum(each, max(inside, 0.0)) for each in outside)
        return long, short

    def is_better(self, other: Judged, share: float) -> bool:
        """Whether it takes a share of another one's held-out error away, at one of the scales.

        Near the noise whatever rows speak for is better.
        """
        if self.leaves_noise or other.leaves_noise:
            return other.behind(self) > 0.0
        scales = ((self.long_squares, other.long_squares), (self.short_squares, other.short_squares))
        return min(math.sqrt(float(mine.sum() / its.sum())) for mine, its in scales) < 1.0 - share


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


def of_likely(found: Sequence[_J], likely: Collection[str]) -> _J:
    """Return the hypothesis of the effects that are likely: the first of a ranking of those with most of them alone.

    Parameters
    ----------
    found : sequence of Judged
        All hypotheses, one without effects among them.
    likely : collection of str
        Effects whose probability, over all hypotheses that have them, is at least a half. Of those that command and
        reading cannot tell from one another one is enough.

    References
    ----------
    Barbieri and Berger, Annals of Statistics 32, 2004: the median probability model predicts best where one model must
    be taken for all.
    """
    able = [one for one in found if set(one.names) <= set(likely)]
    most = max(len({called(name) for name in one.names}) for one in able)
    return ranked([one for one in able if len({called(name) for name in one.names}) == most])[0]


def probabilities(found: Sequence[_J], best: _J, unknown_odds: float) -> tuple[Candidate, ...]:
    """Return every hypothesis with its probability, by how far it is behind the one that is farthest ahead of it.

    Parameters
    ----------
    found : sequence of Judged
        All hypotheses.
    best : Judged
        The one that was chosen.
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
