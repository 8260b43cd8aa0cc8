"""How probable a hypothesis is beside the others that were fitted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from autotune.diagnosis.selection.hypothesis import penalised
from autotune.diagnosis.selection.parsimony import charge, final_lead
from autotune.diagnosis.selection.searched import Search


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A hypothesis with its probability."""

    name: str
    probability: float


def candidates_of(found: Search, unknown_odds: float) -> tuple[Candidate, ...]:
    """Return every hypothesis's name with its probability among those searched, best first.

    Parameters
    ----------
    found : Search
        Hypotheses with their fits.
    unknown_odds : float
        Prior odds of a cause outside the catalogue, beside 1 of all hypotheses together.

    Notes
    -----
    The probabilities weigh what the choice weighed, see :func:`autotune.diagnosis.selection.parsimony.charge`.
    """
    pool = found.all
    chosen = found.chosen
    lead = final_lead(found.retuned.fit, min(pool, key=penalised), found.data)
    scores: dict[str, float] = {}
    for h in pool:
        pays = charge(h, chosen, lead, found.data, found.retuned.fit)
        name = "+".join(h.names) if h.names else "none"
        scores[name] = min(scores.get(name, math.inf), penalised(h) + pays)
    temperature = found.data.thresholds.temperature
    return weighed(scores, temperature * max(1.0, chosen.fit.chi2 / chosen.fit.rows), unknown_odds)


def weighed(scores: Mapping[str, float], scale: float, unknown_odds: float) -> tuple[Candidate, ...]:
    """Return probabilities of hypotheses from their scores, best first, a cause that is none of them included.

    Parameters
    ----------
    scores : mapping
        Penalised chi-square by name; twice a log-likelihood where noise is ideal.
    scale : float
        Units of it that count as one.
    unknown_odds : float
        Prior odds of what is none of them, beside 1 of all together.
    """
    best = min(scores.values())
    weights = {name: math.exp(-(value - best) / (2.0 * scale)) for name, value in scores.items()}
    weights["unknown"] = unknown_odds * sum(weights.values())
    total = sum(weights.values())
    ranked = sorted(weights.items(), key=lambda item: -item[1])
    return tuple(Candidate(name=name, probability=w / total) for name, w in ranked if w / total > 1e-4)[:12]
