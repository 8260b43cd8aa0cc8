"""Hypotheses of a chain, judged, and what a search among them found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from autotune.diagnosis.evidence.adequacy import is_noise
from autotune.diagnosis.evidence.constancy import largest_variation
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.evidence.stretches import error_beside_still, judged_rows, rms
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import LAST_STEPS, RUNAWAY, STEPS, Fit, fit, residual_at, states_in
from autotune.diagnosis.fitting.levels import sweep
from autotune.diagnosis.fitting.long_windows import spread_of
from autotune.diagnosis.fitting.retuning import is_unfelt, reduced_chi2, under_noise
from autotune.diagnosis.fitting.spreading import spread_out
from autotune.diagnosis.selection.hypothesis import Hypothesis
from autotune.diagnosis.selection.judged import Judged, total
from autotune.diagnosis.selection.prediction import extend
from autotune.diagnosis.selection.search import Found
from autotune.diagnosis.selection.searched import Search
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of
from autotune.models import Effect


@dataclass(frozen=True, kw_only=True, eq=False)
class JudgedChain(Judged):
    """A chain with effects, judged.

    Attributes
    ----------
    fit, short : Fit
        Fitted to long and to short windows.
    data, few : Data
        What they were fitted to.
    """

    fit: Fit
    short: Fit
    data: Data
    few: Data

    @property
    def limits(self) -> Thresholds:
        """What decides between two findings."""
        return self.data.thresholds

    @property
    def rows(self) -> int:
        """Rows that it was fitted to."""
        return self.fit.rows

    @cached_property
    def beside_still(self) -> tuple[float, ...]:
        """Errors on left-out stretches as shares of those with commands that stand still; none if none moves."""
        both = ((self.fit, self.data), (self.short, self.few))[: 1 if self.few is self.data else 2]
        shares = [error_beside_still(*one) for one in both]
        return tuple(share for share in shares if share is not None)

    @property
    def added(self) -> tuple[Effect, ...]:
        """Its effects with their fitted values."""
        return self.fit.model.effects[self.fit.parametrisation.own :]

    @property
    def numbers(self) -> int:
        """Numbers of its effects that were fitted."""
        return self.fit.parametrisation.effect_numbers

    @property
    def identity(self) -> frozenset[object]:
        """What tells hypotheses apart: effects of a chain have their places."""
        return frozenset(self.names)

    @cached_property
    def leaves_noise(self) -> bool:
        """Whether what it leaves is noise, at both scales, and rows that were left out are foretold about as well.

        Start states that are free may make noise of anything; then it does not run through what was left out.
        """
        both = ((self.fit, self.data, self.long_squares), (self.short, self.few, self.short_squares))
        return all(
            is_noise(result, data)
            and math.sqrt(total(squares) / judged_rows(data))
            < data.thresholds.foretold * rms(result.residuals, data.good)
            for result, data, squares in both
        )

    @cached_property
    def variance(self) -> float:
        """Variance of the innovations of what it leaves, under the noise that this shows from row to row."""
        return reduced_chi2(self.fit, self.data) * under_noise(self.fit, self.data).noise.sd ** 2

    def spread_out(self) -> JudgedChain:
        """Return it with all rows of the recordings."""
        result, data = spread_out(self.fit, self.data)
        return replace(self, fit=result, data=data)

    def unfelt(self, effects: Sequence[Effect]) -> frozenset[str]:
        """Return the effects that would change what is read by less than one row's noise does."""
        names = set()
        for effect in effects:
            p, theta, states = extend(self.fit, effect, self.data)
            try:
                change = residual_at(p, self.data, theta, states) - self.fit.e
            except RUNAWAY:
                continue
            if is_unfelt(self.fit, change, self.data):
                names.add(effect.name)
        return frozenset(names)

    @property
    def error(self) -> float:
        """Held-out error of the free run as a share of the spread of y."""
        return math.sqrt(total(self.long_squares) / judged_rows(self.data)) / spread_of(self.data)


def at_both_scales(one: JudgedChain, found: Sequence[JudgedChain]) -> JudgedChain:
    """Return a hypothesis with the numbers that suit long and short windows together.

    What a plant that integrates lacks piles up in a long run and bends its numbers along a valley that the long run
    hardly sees; short windows see it, and are bent otherwise. So both are fitted at once, each in units of its own
    residual, from the numbers of the same hypothesis, wherever they were found, and from other levels of dry friction,
    under which fits end in local minima.
    """
    if one.few is one.data:
        return one
    p, held = one.fit.parametrisation, np.zeros(one.fit.theta.size, dtype=bool)
    both = one.data.beside(one.few)
    known = [pair for j in found if j.names == one.names for pair in ((j.fit, j.data), (j.short, j.few))]
    try:
        begun = (
            (f.theta, [x for there in (one.data, one.few) for x in states_in(f, data, there)]) for f, data in known
        )
        start = min((fit(p, both, *at, free=held, iterations=STEPS) for at in begun), key=lambda f: f.cost)
        joint = _least_over_levels(fit(p, both, start.theta, start.x0, iterations=STEPS), both)
        joint = fit(p, both, joint.theta, joint.x0, iterations=LAST_STEPS)
        far = fit(p, one.data, joint.theta, joint.x0[: len(one.data.starts)], rounds=0)
    except RUNAWAY:
        return one
    return replace(one, fit=replace(far, covariance=joint.covariance))


def _least_over_levels(joint: Fit, both: Data) -> Fit:
    """Return the fit that leaves least, of one and of those from other levels of its dry friction."""
    p = joint.parametrisation
    levels = [i for i, f in enumerate(p.free) if f.kind == "effect" and _is_level(f.name)]
    if not levels:
        return joint

    def fitted_at(at: Fit, factor: float) -> Fit | None:
        theta = at.theta.copy()
        theta[levels] += math.log(factor)
        with suppress(*RUNAWAY):
            return fit(p, both, theta, at.x0, iterations=STEPS)
        return None

    return min(sweep(joint, fitted_at, lambda other: other.cost), key=lambda other: other.cost)


def _is_level(name: str) -> bool:
    """Whether a number of an effect is a level of dry friction."""
    effect, _, number = name.rpartition(".")
    form = kind_of(effect).in_equations
    return form is not None and number in form.levels


def as_search(found: Found[JudgedChain]) -> Search:
    """Return what a search found in the form that pages and planning know."""
    chosen = found.chosen

    def scaled(one: JudgedChain) -> Fit:
        # chi-square in units of the residual that the chosen hypothesis was fitted at
        return replace(one.fit, chi2=one.fit.chi2 * (one.data.noise.sd / chosen.data.noise.sd) ** 2)

    return Search(
        data=chosen.data,
        nominal=scaled(found.nominal),
        retuned=Hypothesis(names=(), fit=scaled(found.retuned)),
        others=tuple(Hypothesis(names=one.names, fit=scaled(one)) for one in found.others),
        chosen=Hypothesis(names=chosen.names, fit=chosen.fit),
    )


def gained(found: Found[JudgedChain]) -> float:
    """Return twice the log likelihood ratio of what was chosen beside the retuned model, every row a witness."""
    left, before = (rms(j.fit.residuals, j.data.good) for j in (found.chosen, found.retuned))
    return 2.0 * found.chosen.fit.rows * math.log(before / left)


def quality(found: Found[JudgedChain], noise_floor: float) -> FitQuality:
    """Return errors beside the noise of the retuned model from row to row, or of the chosen one where that is less.

    Parameters
    ----------
    found : Found
        What a search found.
    noise_floor : float
        What the retuned model shows, as a share of the spread of y: a missing sign looks like noise there.
    """
    chosen = found.chosen
    shown = under_noise(chosen.fit, chosen.data).noise.total_sd / spread_of(chosen.data)
    return found.quality(min(noise_floor, shown))


def varies_more(found: Found[JudgedChain]) -> bool:
    """Whether what varies beside chosen effects that leave noise explains more than it may where they are true.

    It may be a share of what was gained, which simulations are wrong by. Where the model's error decides, much varies
    beside what is true as well, and says nothing.
    """
    chosen, limits = found.chosen, found.chosen.limits
    if not chosen.names or not chosen.leaves_noise:
        return False
    before = rms(found.retuned.fit.residuals, found.retuned.data.good)
    share = before**2 / rms(chosen.fit.residuals, chosen.data.good) ** 2 - 1.0
    explained = max(share, 0.0) * sum(int(g.sum()) for g in chosen.data.good)
    left = largest_variation(chosen.fit, under_noise(chosen.fit, chosen.data)).gain
    return left > max(limits.beyond_chance, limits.material * explained)
