"""Which hypotheses a diagnosis leaves open: one of each class that command and measurement cannot tell apart."""

from __future__ import annotations

from autotune.diagnosis.result import Diagnosis
from autotune.diagnosis.selection.hypothesis import Hypothesis
from autotune.effects import shared_name


def open_hypotheses(found: Diagnosis) -> dict[str, tuple[Hypothesis, float]]:
    """Return the hypotheses still open with their probabilities, one of each class that u and y cannot tell apart.

    Parameters
    ----------
    found : Diagnosis
        With candidates and search; ``unknown`` is no hypothesis that predicts anything. The chosen hypothesis is
        always among those returned, however little is left for it; one whose extra parameters buy nothing is not.
    """
    search, limits = found.search, found.search.data.thresholds
    least = frozenset(search.chosen.names)
    pool = {frozenset(h.names): h for h in search.all}
    stated = {candidate.name: candidate.probability for candidate in found.candidates}
    chosen = "+".join(search.chosen.names) or "none"
    classes: dict[frozenset[str], tuple[str, Hypothesis, float]] = {}
    for name, probability in ({chosen: 0.0} | stated).items():
        names = frozenset() if name == "none" else frozenset(name.split("+"))
        if names not in pool or (names > least and not _gains(pool[names], search.chosen)):
            continue
        label, h, p = classes.get(_class(names), (name, pool[names], 0.0))
        classes[_class(names)] = (label, h, p + probability)
    total = sum(p for _, _, p in classes.values()) or 1.0
    kept = classes[_class(least)][0]
    ranked = sorted(((label, h, p / total) for label, h, p in classes.values()), key=lambda c: -c[2])
    few = [one for one in ranked if one[2] >= limits.unknown_odds][: limits.leading]
    few += [one for one in ranked if one[0] == kept and one not in few]
    return {label: (h, max(p, limits.unknown_odds)) for label, h, p in few}


def only_hypothesis(found: Diagnosis) -> str:
    """Return the hypothesis that is left, with all that u and y cannot tell from it; empty where several are."""
    hypotheses = open_hypotheses(found)
    best, (h, p) = next(iter(hypotheses.items()))
    same = _class(frozenset(h.names)) == _class(frozenset(found.search.chosen.names))
    return best if same and (len(hypotheses) == 1 or p >= found.search.data.thresholds.decided) else ""


def _gains(h: Hypothesis, chosen: Hypothesis) -> bool:
    """Whether a richer hypothesis explains more than chance brings to its further numbers."""
    return chosen.fit.cost - h.fit.cost > h.parameters - chosen.parameters


def _class(names: frozenset[str]) -> frozenset[str]:
    return frozenset(map(shared_name, names))
