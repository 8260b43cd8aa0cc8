"""Hypotheses judged by what they leave: compared in pairs, ranked, weighed. Chains and equations are judged alike.

Where both leave noise alone, rows are independent witnesses and the likelihood of the rows decides. Where both err by
more, the model's own error decides and rows are none: stretches that were left out are, by the same formula.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self, TypeVar

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.stretches import STRETCHES
from autotune.diagnosis.selection.probability import Candidate, weighed
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import KINDS, forms_of, kind_of, shared_name
from autotune.models import Effect

#: Added to squared errors, for a stretch without rows has none.
TINY = 1e-300
#: How far every effect stands from the reading: the catalogue has them in the order in which a signal meets them.
_ORDER = {name: -k for k, name in enumerate(KINDS)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged(ABC):
    """A hypothesis with its errors on left-out stretches.

    Attributes
    ----------
    names : tuple of str
        Its effects.
    long_squares, short_squares : (C, K) array
        Squared errors on K left-out stretches, for each of C ways to cut them, of fits to long windows and short ones.
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
    def error(self) -> float:
        """Error on rows that were not fitted, as a share of the spread of y."""

    @property
    @abstractmethod
    def beside_still(self) -> tuple[float, ...]:
        """Errors on left-out stretches as shares of those with commands that stand still; none if none moves."""

    @property
    def heeds_commands(self) -> bool:
        """Whether commands that stand still in the stretches that were left out make it err by a tenth more there.

        A slow lag follows any walk from where a stretch begins, whatever the command does. At one of the scales is
        enough: in short windows slow plants hardly move, and in long ones those that integrate err by what piles up.
        """
        shares = self.beside_still
        return not shares or min(shares) < 1.0 - self.limits.material

    @property
    @abstractmethod
    def added(self) -> tuple[Effect, ...]:
        """Its effects with their fitted values."""

    @abstractmethod
    def unfelt(self, effects: Sequence[Effect]) -> frozenset[str]:
        """Return the effects that would change what is read by less than one row's noise does."""

    @property
    @abstractmethod
    def identity(self) -> frozenset[object]:
        """What tells hypotheses apart that are fitted."""

    def spread_out(self) -> Self:
        """Return it with all rows of the recordings, where it was fitted to a part of them."""
        return self

    @cached_property
    def log_squares(self) -> float:
        """Logarithm of its squared errors: the mean of all left-out stretches, however cut, and of both scales."""
        return float(np.mean([np.mean(np.log(s + TINY)) for s in (self.long_squares, self.short_squares)]))

    def behind(self, other: Judged) -> float:
        """Return twice the logarithm of the odds that another hypothesis is the better one, priors counted.

        Where both leave noise that is what rows say. Where neither does, the model's error decides, and it is what
        stretches say that were left out. Where one does, rows may speak for it as far as those that were left out do,
        and not against it: start states that are free make noise of much in the rows that they were fitted to, and what
        leaves more than noise is no better for what it makes of those.
        """
        prior = 2.0 * (self.log_odds - other.log_odds)
        if self.leaves_noise and other.leaves_noise:
            return self._by_rows(other) - prior
        stretches = self._by_left_out(other, STRETCHES)
        if other.leaves_noise:
            return max(min(self._by_rows(other), self._by_left_out(other, self.rows)), stretches) - prior
        if self.leaves_noise:
            return min(max(self._by_rows(other), self._by_left_out(other, self.rows)), stretches) - prior
        return stretches - prior

    def _by_rows(self, other: Judged) -> float:
        """Return what the innovations of all rows say for another hypothesis: Schwarz's criterion, cooled.

        Noise is never ideal: ``temperature`` units of chi-square count as one.
        """
        said = self.rows * math.log(self.variance / other.variance)
        said += (self.numbers - other.numbers) * math.log(self.rows)
        return said / self.limits.temperature

    def _by_left_out(self, other: Judged, witnesses: int) -> float:
        """Return what left-out stretches, or rows of them, say for another hypothesis, cooled as fitted rows are.

        A stretch is one witness of the model's own error, as a row is of noise: errors that are normal, independent
        from stretch to stretch and of a size that each stretch has for itself give K times the mean of ln(S1/S2) for
        the squared errors S on K stretches. Long windows and short ones are two measurements of the same, and count as
        their mean.
        """
        return witnesses * (self.log_squares - other.log_squares) / self.limits.temperature

    def is_better(self, other: Judged) -> bool:
        """Whether it takes what matters of another one's held-out error away; near the noise, what rows speak for."""
        if self.leaves_noise or other.leaves_noise:
            return other.behind(self) > 0.0
        return math.exp(0.5 * (self.log_squares - other.log_squares)) < 1.0 - self.limits.material


_J = TypeVar("_J", bound=Judged)


def total(squares: FloatArray) -> float:
    """Return the sum of squared errors on all left-out stretches: the mean of the ways to cut them."""
    return float(np.mean(np.sum(squares, axis=-1)))


def worst(one: Judged, others: Sequence[Judged]) -> float:
    """Return how far a hypothesis is behind the one that is farthest ahead of it, in units of 2 ln odds."""
    return max((one.behind(other) for other in others if other is not one), default=0.0)


def rank(found: Sequence[_J]) -> list[_J]:
    """Return hypotheses by how far the best rival of each is ahead of it: the first is beaten by none, or by least.

    Two lags in one line are the same by any recording, and rounding would choose between them: what no hundredth of
    2 ln odds tells apart comes with fewer effects first, then with those that stand nearest to the reading.
    """

    def place(one: _J) -> tuple[float, int, list[int], float]:
        behind = worst(one, found)
        return round(behind, 2), len(one.names), sorted(_ORDER[name] for name in one.names), behind

    return sorted(found, key=place)


def each_best(found: Sequence[_J]) -> list[_J]:
    """Return the best hypothesis of each set of effects, by rank."""
    best: dict[frozenset[object], _J] = {}
    for one in rank(found):
        best.setdefault(one.identity, one)
    return list(best.values())


def built_on(found: Sequence[_J], count: int) -> list[_J]:
    """Return what a search builds on, of a ranking: its first ones, and what predicts best for all that it is rare.

    What is usual in a rig may show only beside what is not: a root outflow beside the tank that runs over. Forms of the
    same effects take one place: two kinds of dry friction would leave none for gravity.
    """
    best = min(found, key=lambda j: j.log_squares, default=None)
    forms: dict[frozenset[str], _J] = {}
    for one in found:
        forms.setdefault(forms_of(one.names), one)
    first = list(forms.values())[:count]
    return [*first, *([] if best is None or any(best is j for j in first) else [best])]


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
    most = max(len({shared_name(name) for name in one.names}) for one in able)
    return rank([one for one in able if len({shared_name(name) for name in one.names}) == most])[0]


def errors_of(leading: Sequence[Judged]) -> dict[frozenset[object], float]:
    """Return the logarithm of squared errors on left-out stretches, of hypotheses that differ in their effects."""
    return {one.identity: one.log_squares for one in leading}


def predicts_best(base: _J, found: Sequence[_J], parts: Sequence[Mapping[frozenset[object], float]]) -> _J:
    """Return what simulates rows that were left out best: a hypothesis, or one with further effects of the rig.

    A name is a claim, and must be likelier than not; a model that is simulated with need only predict. An effect that
    is not sure enough to be named may take away most of what the named ones leave.

    Parameters
    ----------
    base : Judged
        The hypothesis of the effects that are named.
    found : sequence of Judged
        All hypotheses, on all rows.
    parts : sequence of mapping of frozenset to float
        Errors of the same hypotheses, fitted and judged on each part of the rows (:func:`errors_of`).

    Returns
    -------
    Judged
        The one with the least mean logarithm of the errors on all rows and on the parts, of those that err less on each
        of them, by a share that is material. The given one where there is none, where no part tells, and where what it
        leaves is noise. What came from the surroundings, or at a time, is not in another recording.
    """
    leading = each_best(found)
    sets = [errors_of(leading), *parts]
    if base.leaves_noise or not parts or any(base.identity not in told for told in sets):
        return base

    def mean(one: Judged) -> float:
        return float(np.mean([told[one.identity] for told in sets]))

    def is_able(one: Judged) -> bool:
        further = [kind_of(name) for name in {*one.names} - {*base.names}]
        lasts = all(kind.place != "environment" and not kind.at_a_time for kind in further)
        gains = (told[base.identity] - told.get(one.identity, math.inf) for told in sets)
        return base.identity < one.identity and lasts and all(0.5 * gain > least for gain in gains)

    least = -math.log(1.0 - base.limits.material)
    return min(filter(is_able, leading), key=mean, default=base)


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
        scores[_title(one)] = min(scores.get(_title(one), math.inf), max(worst(one, rivals), 0.0))
    scores[_title(best)] = min(scores.values())
    return weighed(scores, unknown_odds)


def _title(one: Judged) -> str:
    return "+".join(one.names) if one.names else "none"
