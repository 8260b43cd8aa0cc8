"""Parsimony: how much more a richer hypothesis must explain before it is preferred to a simpler one."""

from __future__ import annotations

from collections.abc import Sequence

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.retuning import far_from_prior, reduced_chi2
from autotune.diagnosis.selection.hypothesis import Hypothesis, penalised

#: Decrease of the score that an effect must bring: what chance brings among some two hundred starts, with a margin (on
#: clean recordings nothing brought more than 15); weak effects that can be told bring a hundred and more, some 40.
LEAST_DECREASE = 30.0
#: The same where a number of the nominal structure lies beyond belief without the effect, by that many of its prior's
#: standard deviations: a lag that has to be tripled is no wrong number.
LEAST_BEYOND_BELIEF, BEYOND_BELIEF = 16.0, 4.0
#: Score that a hypothesis with more free numbers must be ahead of one with fewer; a hundredth of what it explains where
#: that is more and the misfit of the best is more than noise has.
SIMPLER, NOISE_ALONE = 6.0, 1.02
#: The same where the best leaves noise alone, and what a further effect has to bring, as a share of what is explained:
#: no simulation of thresholds is more exact; after a blow against a stop the least change of any number shows.
SIMULATED, AFTER_BLOWS = 2e-3, 5e-3
#: Misfit from which on what is wrong with all of them rules, and not noise; the lead is then this share of what the
#: best explains: a real rig's every imperfection is more than its noise, and little of it is worth a name.
MODEL_ERROR, MODEL_ERROR_SHARE = 2.0, 0.12


def simplest(ranked: Sequence[Hypothesis], lead: float) -> Hypothesis:
    """Return the hypothesis of the fewest numbers that is less than a lead behind the first one."""
    near = [h for h in ranked if penalised(h) - penalised(ranked[0]) < lead]
    return min(near, key=lambda h: (h.parameters, penalised(h)))


def simplicity_lead(base: Fit, best: Hypothesis, data: Data) -> float:
    """Return by how much a richer hypothesis must beat a simpler one to be preferred, in units of the score.

    Where even the best leaves more than noise, its score counts what is wrong with all of them, and more is asked.
    """
    if reduced_chi2(best.fit, data) < NOISE_ALONE:
        return max(SIMPLER, _inexact(best) * (base.cost - best.fit.cost))
    return max(SIMPLER, 0.01 * (base.cost - best.fit.cost))


def final_lead(base: Fit, best: Hypothesis, data: Data) -> float:
    """Return the same for the choice among all that were found, where the model's error may be what is left."""
    lead = simplicity_lead(base, best, data)
    if reduced_chi2(best.fit, data) < MODEL_ERROR:
        return lead
    return max(lead, MODEL_ERROR_SHARE * (base.cost - best.fit.cost))


def worth_adding(smaller: Hypothesis, larger: Hypothesis) -> bool:
    """Whether a larger hypothesis explains enough more to be believed."""
    excess = max(1.0, larger.fit.chi2 / larger.fit.rows)
    least = LEAST_BEYOND_BELIEF if far_from_prior(smaller.fit, BEYOND_BELIEF) else LEAST_DECREASE
    return bool(penalised(smaller) - penalised(larger) > least * excess)


def needed(smaller: Hypothesis, larger: Hypothesis, data: Data, base: Fit) -> bool:
    """Whether one more effect is worth it and brings the residual to noise, or most of the way there.

    On a rig with disturbances of its own every further effect explains a little; that little is not physics.
    """
    before, after = reduced_chi2(smaller.fit, data) - 1.0, reduced_chi2(larger.fit, data) - 1.0
    more = penalised(smaller) - penalised(larger) > _inexact(larger) * (base.cost - larger.fit.cost)
    return more and worth_adding(smaller, larger) and (after < 0.08 or after < 0.5 * before)


def _inexact(h: Hypothesis) -> float:
    """Return the share of what is explained that a hypothesis's simulation may be wrong by."""
    return AFTER_BLOWS if any(kind.impacts for kind in h.kinds) else SIMULATED
