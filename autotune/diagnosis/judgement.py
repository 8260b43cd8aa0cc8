"""Judgement: how much effects explain, how probable a hypothesis is beside its rivals, errors on held-out windows.

The constants were counted on concealed cases, none of them of the proof: ``python -m tests.benchmarks calibrate``
prints for each what other values do. Temperature and doubt stand where the log loss is flat and what is stated with a
probability is as often true. On real rigs, where no model is adequate, the concealed cases say nothing: ``DOMINANT``,
``FAR_FROM_NOISE`` and ``HALF_EXPLAINED`` keep what the best explains there and refuse the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from autotune.diagnosis.adequacy import Left
from autotune.diagnosis.data import Data
from autotune.diagnosis.fitting import RUNAWAY, Fit, fit
from autotune.diagnosis.noise import noise_from_differences
from autotune.diagnosis.parsimony import final_lead, needed
from autotune.diagnosis.polishing import own
from autotune.diagnosis.result import Candidate, FitQuality
from autotune.diagnosis.search import Hypothesis, score
from autotune.diagnosis.selection import Search

#: Misfit of a model without effects from which on something must be missing, although no effect is worth it; clean
#: recordings leave up to 1.02.
MISSING = 1.05
#: Share of the retuned model's excess misfit that effects must explain where nothing explains all of it, and how many
#: times the noise's variance the retuned model's error must have: nearer to the noise adequacy is asked for.
DOMINANT, FAR_FROM_NOISE = 0.35, 8.0
#: Weight of a cause outside the catalogue, beside 1 of all hypotheses: where the best explains the recordings, and
#: where it explains most of what retuning leaves but not all.
UNKNOWN, HALF_EXPLAINED = 0.03, 0.25
#: Scale of the log-odds: one unit of chi2 counts this much less than for ideal noise.
TEMPERATURE = 3.0


def dominates(quality: FitQuality, share: float = DOMINANT, far: float = FAR_FROM_NOISE) -> bool:
    """Whether the chosen effects explain most of a misfit that nothing explains whole.

    On real rigs something always remains; an effect is named all the same when on rows that were not fitted it takes
    away a share of the variance that retuning leaves above the noise, where that is ``far`` times the noise's.
    """
    retuned, noise = quality.retuned**2, quality.noise_floor**2
    return retuned > far * noise and retuned - quality.extended**2 > share * (retuned - noise)


def rivals(found: Search, doubt: float) -> tuple[Candidate, ...]:
    """Return every hypothesis's name with its probability among those searched, best first.

    Parameters
    ----------
    found : Search
        Hypotheses with their fits.
    doubt : float
        Weight of a cause outside the catalogue beside 1 of all hypotheses together, see :func:`doubt_of`.

    Notes
    -----
    A richer hypothesis that beats the chosen one by less than the lead that simplicity was given pays that lead here
    too, one that was not needed all that it is ahead as well: the probabilities weigh what the choice weighed.
    """
    pool = [found.retuned, *found.singles, *found.pairs, *found.triples]
    chosen = found.chosen
    lead = final_lead(found.retuned.fit, min(pool, key=score), found.data)
    scores: dict[str, float] = {}
    for h in pool:
        ahead, pays = score(chosen) - score(h), 0.0
        if h.parameters > chosen.parameters and ahead > 0.0:
            if ahead < lead:
                pays = lead
            elif not needed(chosen, h, found.data, found.retuned.fit):
                pays = ahead + lead
        name = "+".join(h.names) if h.names else "none"
        scores[name] = min(scores.get(name, math.inf), score(h) + pays)
    return weighed(scores, TEMPERATURE * max(1.0, chosen.fit.chi2 / chosen.fit.rows), doubt)


def weighed(scores: Mapping[str, float], scale: float, doubt: float) -> tuple[Candidate, ...]:
    """Return probabilities of hypotheses from their scores, best first, a cause that is none of them included.

    Parameters
    ----------
    scores : mapping
        Score by name, see :func:`autotune.diagnosis.selection.score`; twice a log-likelihood where noise is ideal.
    scale : float
        Units of score that count as one.
    doubt : float
        Weight of what is none of them, beside 1 of all together.
    """
    best = min(scores.values())
    weights = {name: math.exp(-(value - best) / (2.0 * scale)) for name, value in scores.items()}
    weights["unknown"] = doubt * sum(weights.values())
    total = sum(weights.values())
    ranked = sorted(weights.items(), key=lambda item: -item[1])
    return tuple(Candidate(name=name, probability=w / total) for name, w in ranked if w / total > 1e-4)[:12]


def doubt_of(left: Left, most: bool) -> float:
    """Return the weight of a cause outside the catalogue, beside 1 of all hypotheses together.

    Small where what is left is noise, and the larger the nearer its misfit comes to the bound of adequacy; beyond it
    the two weigh the same, but for effects that explain most of what retuning leaves.
    """
    if left.is_noise:
        excess = max(left.misfit - 1.0, 0.0) / (left.allowed - 1.0)
        return UNKNOWN + (1.0 - UNKNOWN) * excess**4
    return HALF_EXPLAINED if most else 1.0


def held_out(found: Search) -> tuple[FitQuality, bool]:
    """Return errors on windows with numbers fitted to the others, and whether the extended model wins.

    Every second window is left out, then the others: each half is tried with the numbers of the other one.
    """
    data = found.data
    halves = _half(data, 0), _half(data, 1)
    y = np.concatenate([r.y[g] for r, g in zip(data.recordings, data.good, strict=True)])
    spread = float(np.std(y)) or 1.0

    def tested(h: Hypothesis, tune: bool, known: Data, unknown: Data) -> Fit:
        p, none = h.fit.parametrisation, np.zeros(h.fit.theta.size, dtype=bool)
        theta = h.fit.theta if tune else p.centre
        try:
            if tune:
                theta = fit(p, known, theta, own(h.fit, known), iterations=6, rounds=1).theta
            return fit(p, unknown, theta, own(h.fit, unknown), free=none, iterations=8)
        except RUNAWAY:
            # numbers from half the windows can run away on the other half: then those of all windows count
            return h.fit

    def error(h: Hypothesis, tune: bool) -> float:
        fits = [tested(h, tune, *pair) for pair in (halves, halves[::-1])]
        squares = sum(float(e @ e) for f in fits for e in f.residuals)
        freedom = sum(f.rows - sum(Q.shape[1] for Q in f.states_explain) for f in fits)
        return math.sqrt(squares / max(freedom, 1)) / spread

    nominal, retuned = error(found.retuned, tune=False), error(found.retuned, tune=True)
    extended = error(found.chosen, tune=True) if found.chosen.names else retuned
    noise = noise_from_differences(found.chosen.fit.residuals, data.good).total_sd / spread
    quality = FitQuality(nominal=nominal, retuned=retuned, extended=extended, noise_floor=noise)
    return quality, extended <= retuned


def _half(data: Data, which: int) -> Data:
    """Return every second window of the data, or block of windows where there are few."""
    chosen = []
    for a in data.starts:
        # few windows may go by direction one and one: then blocks of them are taken
        block = 1 if len(a) >= 8 else max(1, len(a) // 2)
        keep = (np.arange(len(a)) // block) % 2 == which % 2
        chosen.append(keep if keep.any() else np.ones(len(a), dtype=bool))
    return data.only(chosen)
