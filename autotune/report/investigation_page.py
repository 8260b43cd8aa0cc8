"""The page of an investigation: how the hypotheses fell, round by round, before the diagnosis that is left."""

from __future__ import annotations

import os

from autotune.diagnosis.result import Diagnosis
from autotune.pipeline.investigation import Investigation
from autotune.report.diagnosis_page import write_diagnosis_page
from autotune.report.effect_words import of_candidates
from autotune.report.page import Section, Table
from autotune.report.writing import unit_of


def write_investigation_page(known: Investigation, found: Diagnosis, path: str | os.PathLike[str]) -> None:
    """Write the page of an investigation.

    Parameters
    ----------
    known : Investigation
        Rounds, and why it ended.
    found : Diagnosis
        Over all its recordings.
    path : path
        File to write.
    """
    write_diagnosis_page(found, path, before=(_rounds(known, found.search.units),), title="Investigation")


def _rounds(known: Investigation, units: tuple[str, str]) -> Section:
    rows = [("0", "given recordings", "-", "-", list_candidates(known.before, ""))] if known.before else []
    for one in known.rounds:
        excitation = one.plan.excitation
        asked = " against ".join(one.plan.between) or "what there is at all"
        unit = unit_of(units[0] if excitation.on == "command" else units[1])
        done = (
            f"{excitation.kind} on the {excitation.on}, {excitation.amplitude:.3g}{unit}, {excitation.duration_s:.4g} s"
        )
        expected = f"{one.plan.discrimination:.0f}" if one.plan.between else "-"
        rows.append((str(one.number), done, asked, expected, list_candidates(one.candidates, one.verdict)))
    table = Table(
        header=("round", "experiment", "to tell", "expected chi-square", "probabilities after it"), rows=tuple(rows),
        caption="Expected chi-square: of one hypothesis where another is true, mean over the pairs.",
    )  # fmt: skip
    text = f"Ended: {known.ended}." if known.ended else "It goes on."
    return Section(title="How it was learnt", text=(text,), tables=(table,) if rows else ())


def list_candidates(candidates: tuple[tuple[str, float], ...], verdict: str) -> str:
    """Return the likeliest hypotheses in words, with their probabilities.

    Parameters
    ----------
    candidates : tuple of (str, float)
        Names and probabilities, the likeliest first.
    verdict : str
        Of the diagnosis that they are of.
    """
    return ", ".join(f"{words} {p:.2f}" for words, p in of_candidates(candidates[:3], verdict))
