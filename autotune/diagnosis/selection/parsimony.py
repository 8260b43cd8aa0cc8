"""Parsimony: how much more a richer hypothesis must explain before it is preferred to a simpler one."""

from __future__ import annotations

import math
from collections.abc import Sequence

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.noise import noise_from_differences
from autotune.diagnosis.fitting.retuning import far_from_prior, reduced_chi2
from autotune.diagnosis.selection.hypothesis import Hypothesis, penalised
from autotune.diagnosis.thresholds import Thresholds

#: Standard deviations that chance may reach.
CHANCE = 3.0


def simplest(ranked: Sequence[Hypothesis], lead: float) -> Hypothesis:
    """Return the hypothesis of the fewest numbers that is less than a lead behind the first one."""
    near = [h for h in ranked if penalised(h) - penalised(ranked[0]) < lead]
    return min(near, key=lambda h: (h.parameters, penalised(h)))


def simplicity_lead(base: Fit, best: Hypothesis, data: Data) -> float:
    """Return by how much a richer hypothesis must beat a simpler one to be preferred, in penalised chi-square.

    Where even the best leaves more than noise, its chi-square counts what is wrong with all of them, and more is asked.
    """
    limits, explained = data.thresholds, base.cost - best.fit.cost
    if reduced_chi2(best.fit, data) < limits.noise_alone:
        return max(limits.simpler_lead, _inexact(best, limits) * explained)
    return max(limits.simpler_lead, limits.simpler_share * explained)


def final_lead(base: Fit, best: Hypothesis, data: Data) -> float:
    """Return the same for the choice among all that were found, where the model's error may be what is left."""
    lead = simplicity_lead(base, best, data)
    if reduced_chi2(best.fit, data) < data.thresholds.model_error:
        return lead
    return max(lead, data.thresholds.model_error_share * (base.cost - best.fit.cost))


def worth_adding(smaller: Hypothesis, larger: Hypothesis, limits: Thresholds) -> bool:
    """Whether a larger hypothesis explains enough more to be worth its numbers."""
    excess = max(1.0, larger.fit.chi2 / larger.fit.rows)
    beyond = far_from_prior(smaller.fit, limits.beyond_prior)
    least = limits.least_decrease_beyond if beyond else limits.least_decrease
    return bool(penalised(smaller) - penalised(larger) > least * excess)


def needed(smaller: Hypothesis, larger: Hypothesis, data: Data, base: Fit) -> bool:
    """Whether one more effect is worth it and brings the residual to noise, or most of the way there.

    On a rig with disturbances of its own every further effect explains a little; that little is not physics.
    """
    limits = data.thresholds
    before, after = reduced_chi2(smaller.fit, data) - 1.0, reduced_chi2(larger.fit, data) - 1.0
    more = penalised(smaller) - penalised(larger) > _inexact(larger, limits) * (base.cost - larger.fit.cost)
    enough = after < limits.noise_left or after < limits.half_left * before
    return more and worth_adding(smaller, larger, limits) and enough


def may_be_needed(smaller: Hypothesis, data: Data, base: Fit) -> bool:
    """Whether any further effect could be :func:`needed`: it can explain no more than what is left above the noise.

    Half the variance of a residual's differences is the noise that no model takes away, to within the scatter of its
    correlation from row to row: what is slow may be the model's own error.
    """
    limits, rows = data.thresholds, data.rows
    noise = noise_from_differences(smaller.fit.residuals, data.good, limits.largest_correlation)
    whitened = 1.0 + sum(a * a for a in data.noise.ar)  # what whitening makes of noise that is white
    alone = rows * whitened * (noise.sd / data.noise.sd) ** 2 / (1.0 + sum(noise.ar))
    left = smaller.fit.cost - alone + CHANCE * math.sqrt(rows)
    return left > limits.simulation_error * (base.cost - smaller.fit.cost)


def charge(h: Hypothesis, chosen: Hypothesis, lead: float, data: Data, base: Fit) -> float:
    """Return what a hypothesis has to pay beside the chosen one: nothing, unless its further numbers are not needed.

    A richer one that is ahead by less than the lead of simplicity pays that lead; one that is not needed all that it is
    ahead as well.
    """
    ahead = penalised(chosen) - penalised(h)
    if h.parameters <= chosen.parameters or ahead <= 0.0:
        return 0.0
    if ahead < lead:
        return lead
    return 0.0 if needed(chosen, h, data, base) else ahead + lead


def settled(chosen: Hypothesis, pool: Sequence[Hypothesis], data: Data, base: Fit) -> Hypothesis:
    """Return the hypothesis that no other is ahead of once that has paid: what is named is what is most probable.

    Parameters
    ----------
    chosen : Hypothesis
        Where to begin.
    pool : sequence of Hypothesis
        All that were fitted, the retuned model among them.
    data, base : Data, Fit
        What they were fitted to, and the retuned model.
    """
    lead = final_lead(base, min(pool, key=penalised), data)
    for _ in pool:
        paid = {id(h): penalised(h) + charge(h, chosen, lead, data, base) for h in pool}
        best = min(pool, key=lambda h, paid=paid: paid[id(h)])  # type: ignore[misc]  # bound at once
        if paid[id(best)] >= penalised(chosen):
            break
        chosen = best
    return chosen


def _inexact(h: Hypothesis, limits: Thresholds) -> float:
    """Return the share of what is explained that a hypothesis's simulation may be wrong by."""
    return limits.impact_error if any(kind.impacts for kind in h.kinds) else limits.simulation_error
