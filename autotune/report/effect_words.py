"""Effects in words: what each one is, as a sentence that a stranger understands, and a few words for a diagram."""

from __future__ import annotations

from collections.abc import Sequence

from autotune.effects import KINDS
from autotune.report.writing import join_clauses


def in_short(name: str) -> str:
    """Return an effect in a few words; its own name where there are none."""
    return KINDS[name].words[0] if name in KINDS else name.rpartition(".")[2].replace("_", " ")


def clause(name: str) -> str:
    """Return what an effect is, as a clause that begins with a small letter."""
    return KINDS[name].words[1] if name in KINDS else f"there is {in_short(name)}"


def of_candidate(name: str, *, beside: bool = False) -> str:
    """Return a hypothesis in words, its effects' names in brackets.

    Parameters
    ----------
    name : str
        ``none``, ``unknown``, or names of effects with ``+`` between them.
    beside : bool
        Whether something is named that no hypothesis has, as the samples or the operating point show it by themselves.
    """
    if name in ("none", "unknown"):
        none = "nothing else is missing" if beside else "nothing is missing"
        return {"none": none, "unknown": "a cause outside the catalogue"}[name]
    return join_clauses([clause(one) for one in name.split("+")]) + f" ({name.replace('+', ' + ')})"


def of_candidates(candidates: Sequence[tuple[str, float]], verdict: str) -> list[tuple[str, float]]:
    """Return hypotheses in words, with their probabilities.

    Parameters
    ----------
    candidates : sequence of (str, float)
        Names and probabilities, the likeliest first.
    verdict : str
        Of the diagnosis that they are of: an effect that no hypothesis has leaves the likeliest of them without one.
    """
    beside = verdict == "effect" and bool(candidates) and candidates[0][0] == "none"
    return [(of_candidate(name, beside=beside), p) for name, p in candidates]
