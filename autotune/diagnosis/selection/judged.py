"""Hypotheses judged by what they leave: compared in pairs, ranked, weighed.

Where one of two leaves noise alone, rows are independent witnesses and the likelihood of the rows decides. Where both
err by more, the model's own error decides and rows are none: then stretches that were left out are what counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.adequacy import is_noise
from autotune.diagnosis.evidence.constancy import largest_variation
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.evidence.stretches import advantage, judged_rows, reduction, rms
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.long_windows import spread_of
from autotune.diagnosis.fitting.retuning import reduced_chi2, under_noise
from autotune.diagnosis.fitting.spreading import spread_out
from autotune.diagnosis.selection.hypothesis import Hypothesis, vanished
from autotune.diagnosis.selection.probability import Candidate, weighed
from autotune.diagnosis.selection.searched import Search
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of

#: Leading hypotheses that are compared as what is material in them.
LEADING = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """A hypothesis with its errors on left-out stretches.

    Attributes
    ----------
    names : tuple of str
        Its effects.
    fit, short : Fit
        Fitted to long and to short windows.
    data, few : Data
        What they were fitted to.
    long_squares, short_squares : (K,) array
        Squared errors of both on left-out stretches.
    log_odds : float
        Logarithm of its prior odds.
    """

    names: tuple[str, ...]
    fit: Fit
    short: Fit
    data: Data
    few: Data
    long_squares: FloatArray
    short_squares: FloatArray
    log_odds: float

    @cached_property
    def leaves_noise(self) -> bool:
        """Whether what it leaves is noise, at both scales, and rows that were left out are foretold about as well.

        Start states that are free may make noise of anything; then it does not run through what was left out.
        """
        both = ((self.fit, self.data, self.long_squares), (self.short, self.few, self.short_squares))
        return all(
            is_noise(result, data)
            and math.sqrt(float(squares.sum()) / judged_rows(data))
            < data.thresholds.foretold * rms(result.residuals, data.good)
            for result, data, squares in both
        )

    @cached_property
    def variance(self) -> float:
        """Variance of the innovations of what it leaves, under the noise that this shows from row to row."""
        return reduced_chi2(self.fit, self.data) * under_noise(self.fit, self.data).noise.sd ** 2

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
        numbers = self.fit.parametrisation.effect_numbers - other.fit.parametrisation.effect_numbers
        said = self.fit.rows * math.log(self.variance / other.variance) + numbers * math.log(self.fit.rows)
        return said / self.data.thresholds.temperature

    def _by_stretches(self, other: Judged) -> float:
        """Return what stretches that were left out say for another hypothesis.

        The scale, long or short, at which they differ more decides, unless the other one contradicts it. Stretches have
        the rig and its excitation in common: together they speak for no more than ``most_evidence``, however well they
        agree, unless the error is far smaller at both scales: so much that ``error_witnesses`` errors, independent and
        of unknown size, would say more.
        """
        scales = ((self.long_squares, other.long_squares), (self.short_squares, other.short_squares))
        limits = self.data.thresholds
        agree = [advantage(*pair) for pair in scales]
        capped = min(max(max(agree) if sum(agree) > 0.0 else min(agree), -limits.most_evidence), limits.most_evidence)
        smaller = [limits.error_witnesses * reduction(*pair) for pair in scales]
        least = min(smaller, key=abs) if smaller[0] * smaller[1] > 0.0 else 0.0
        return least if least * capped > 0.0 and abs(least) > abs(capped) else capped

    def spread_out(self) -> Judged:
        """Return it with all rows of the recordings."""
        result, data = spread_out(self.fit, self.data)
        return replace(self, fit=result, data=data)

    @property
    def error(self) -> float:
        """Held-out error of the free run as a share of the spread of y."""
        return math.sqrt(float(self.long_squares.sum()) / judged_rows(self.data)) / spread_of(self.data)

    def is_better(self, other: Judged, share: float) -> bool:
        """Whether it takes a share of another one's held-out error away, at one of the scales.

        What it has beyond the other one may have come to nothing on long windows: then short ones do not speak for it.
        What happens at a time of its own explains a part of everything: it must take away more, and since it lasts,
        at both scales. Near the noise whatever rows speak for is better.
        """
        if self.leaves_noise or other.leaves_noise:
            return other.behind(self) > 0.0
        extra = set(self.names) - set(other.names)
        at_nothing = bool(extra) and extra <= vanished(Hypothesis(names=self.names, fit=self.fit))
        long, short = (
            math.sqrt(float(mine.sum() / its.sum()))
            for mine, its in ((self.long_squares, other.long_squares), (self.short_squares, other.short_squares))
        )
        if any(kind_of(name).is_event for name in extra):
            return max(long, short) < 1.0 - max(share, self.data.thresholds.material_event)
        return (long if at_nothing else min(long, short)) < 1.0 - share


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """What a search found.

    Attributes
    ----------
    nominal, retuned : Judged
        The nominal structure with the operating point fitted alone, and all its numbers.
    judged : tuple of Judged
        All that were judged, the retuned one first.
    best : Judged
        The one that predicts best, for what it is.
    chosen : Judged
        The one to go on with: the best one, or what is left of it where parts of the recordings do not agree.
    """

    nominal: Judged
    retuned: Judged
    judged: tuple[Judged, ...]
    best: Judged
    chosen: Judged

    def as_search(self) -> Search:
        """Return the hypotheses in the form that pages and planning know."""
        order = sorted(self.judged, key=lambda j: j.behind(self.chosen))
        return Search(
            data=self.chosen.data,
            nominal=self._scaled(self.nominal),
            retuned=Hypothesis(names=(), fit=self._scaled(self.retuned)),
            others=tuple(Hypothesis(names=one.names, fit=self._scaled(one)) for one in order if one.names),
            chosen=Hypothesis(names=self.chosen.names, fit=self.chosen.fit),
        )

    def _scaled(self, one: Judged) -> Fit:
        """Return a fit with its chi-square in units of the residual that the chosen hypothesis was fitted at."""
        return replace(one.fit, chi2=one.fit.chi2 * (one.data.noise.sd / self.chosen.data.noise.sd) ** 2)

    @property
    def gained(self) -> float:
        """Twice the log likelihood ratio of the chosen hypothesis beside the retuned model, every row a witness."""
        left, before = (rms(j.fit.residuals, j.data.good) for j in (self.chosen, self.retuned))
        return 2.0 * self.chosen.fit.rows * math.log(before / left)

    def candidates(self, unknown_odds: float) -> tuple[Candidate, ...]:
        """Return every hypothesis with its probability: what chose it weighs here too."""
        scores: dict[str, float] = {}
        for one in self.judged:
            name = "+".join(one.names) if one.names else "none"
            rivals = [other for other in self.judged if set(other.names) != set(one.names)]
            scores[name] = min(scores.get(name, math.inf), max(worst(one, rivals), 0.0))
        best = "+".join(self.best.names) if self.best.names else "none"
        scores[best] = min(scores.values())  # what was more, and not material, speaks for it too
        return weighed(scores, 1.0, unknown_odds)

    def quality(self, noise_floor: float) -> FitQuality:
        """Return errors of free runs through stretches that were left out."""
        return FitQuality(
            nominal=self.nominal.error,
            retuned=self.retuned.error,
            extended=self.chosen.error,
            noise_floor=noise_floor,
        )

    def varies_more(self, limits: Thresholds) -> bool:
        """Whether what varies beside the chosen effects explains more than it may where they are what is missing.

        What leaves noise leaves nothing that varies but for a share of what was gained, which simulations are wrong by;
        where the model's error decides, three times as much is left beside what is true.
        """
        chosen, before = self.chosen, rms(self.retuned.fit.residuals, self.retuned.data.good)
        if not chosen.names:
            return False
        share = before**2 / rms(chosen.fit.residuals, chosen.data.good) ** 2 - 1.0
        gained = max(share, 0.0) * sum(int(g.sum()) for g in chosen.data.good)
        if chosen.leaves_noise:
            left = largest_variation(chosen.fit, under_noise(chosen.fit, chosen.data)).gain
            return left > max(limits.inconstant, limits.inconstant_share * gained)
        return largest_variation(chosen.fit, chosen.data).gain > limits.varies_more * gained

    def keeps_nominal(self, share: float) -> bool:
        """Whether the nominal numbers predict about as well as those retuned, so that they stand."""
        ratio = float(self.retuned.long_squares.sum() / self.nominal.long_squares.sum())
        return not self.chosen.names and math.sqrt(ratio) > 1.0 - share


def worst(one: Judged, others: Sequence[Judged]) -> float:
    """Return how far a hypothesis is behind the one that is farthest ahead of it, in units of 2 ln odds."""
    return max((one.behind(other) for other in others if other is not one), default=0.0)


def ranked(found: Sequence[Judged]) -> list[Judged]:
    """Return hypotheses by how far the best rival of each is ahead of it: the first is beaten by none, or by least."""
    return sorted(found, key=lambda j: worst(j, found))


def leading(found: Sequence[Judged], count: int) -> list[Judged]:
    """Return the first of a ranking, the best one of each set of effects."""
    best: dict[frozenset[str], Judged] = {}
    for one in ranked(found):
        best.setdefault(frozenset(one.names), one)
    return list(best.values())[:count]


def simplest(found: Sequence[Judged], material: float) -> Judged:
    """Return the hypothesis that stretches speak for most, priors counted, without what is not material in any.

    Each of the leading ones is first freed of what is not material in it, and they are compared as what they then are.
    """
    order = ranked(found)
    return min((_freed(one, order, material) for one in leading(found, LEADING)), key=lambda one: worst(one, found))


def _freed(best: Judged, order: Sequence[Judged], material: float) -> Judged:
    """Return a hypothesis without what is not material in it: one of those that were judged."""
    while best.names:
        lesser = [j for j in order if set(j.names) < set(best.names) and not best.is_better(j, material)]
        if not lesser:
            break
        best = lesser[0]
    return best
