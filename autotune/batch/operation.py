"""A loop of a campaign looked at in operation: its record's pieces together, and what its row says of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

import numpy as np

from autotune.batch.settings import RoutineSettings
from autotune.diagnosis.routine import RoutineDiagnosis, diagnose_routine
from autotune.diagnosis.routine.operation import operation_of
from autotune.diagnosis.routine.thresholds import RoutineThresholds
from autotune.errors import InputError
from autotune.recording import Recording

Urgency: TypeAlias = Literal["act", "look", "fine"]

_URGENCY: dict[str, Urgency] = {
    "stiction": "act", "backlash": "act", "tight_tuning": "act", "outside_oscillation": "look", "abstain": "look",
    "none": "fine",
}  # fmt: skip
#: Sample times of pieces that are looked at together differ by less than this share.
_SAME_STEP = 0.02


def look_in_operation(
    pieces: Sequence[Recording], settings: RoutineSettings | None
) -> tuple[RoutineDiagnosis, tuple[str, ...]]:
    """Look at the pieces of a loop's record together, as ``autotune diagnose --routine`` does.

    Parameters
    ----------
    pieces : sequence of Recording
        Uninterrupted stretches of one loop's record.
    settings : RoutineSettings, optional
        What is asked of a finding.

    Returns
    -------
    found : RoutineDiagnosis
        What was found.
    notes : tuple of str
        How many pieces were left out, and why the first was.

    Raises
    ------
    InputError
        No piece can be looked at; the reason of the first.
    """
    asked = settings or RoutineSettings()
    limits = RoutineThresholds(chance=asked.chance, least_reversals=asked.least_reversals)
    step = max(pieces, key=len).sample_time_s
    fit: list[Recording] = []
    refusals: list[InputError | str] = []
    for piece in pieces:
        if abs(piece.sample_time_s - step) > _SAME_STEP * step:
            refusals.append(f"{piece.name}: rows {piece.sample_time_s:g} s apart, {step:g} s in the longest piece")
            continue
        try:
            operation_of([piece], limits)
        except InputError as error:
            refusals.append(error)
        else:
            fit.append(piece)
    if not fit:
        raise next(reason for reason in refusals if isinstance(reason, InputError))
    found = diagnose_routine(fit, limits)
    if not refusals:
        return found, ()
    return found, (f"{len(refusals)} of {len(pieces)} pieces are left out, the first: {refusals[0]}",)


def row_of(found: RoutineDiagnosis) -> dict[str, Any]:
    """Return what a loop's row says of its operation, by the row's fields.

    Returns
    -------
    dict
        ``severity`` is the share of the squared prediction error that the valve explains, the share of y that swings
        after the set-point for tight tuning, and the share of y's variance in its dominant line for an oscillation
        that is from outside or not explained.
    """
    valves, seen, answer = found.valves, found.oscillation, found.answer
    urgency = _URGENCY[found.verdict]
    shares = {
        "stiction": 1.0 - math.exp(-valves.decrease), "backlash": 1.0 - math.exp(-valves.decrease),
        "tight_tuning": 0.0 if answer is None else answer.explained, "none": 0.0,
    }  # fmt: skip
    return {
        "attention": urgency,
        "severity": float(np.clip(shares.get(found.verdict, seen.share), 0.0, 1.0)),
        "reason": "" if urgency == "fine" else found.sentences[0],
        "verdict": found.verdict,
        "sure": _how_sure(found),
        "what_next": found.following,
        "period_s": seen.period_s if math.isfinite(seen.period_s) else None,
        "reversals": valves.reversals,
        "chance": valves.chance,
        "error_decrease": valves.decrease,
    } | _valve(found)


def _valve(found: RoutineDiagnosis) -> dict[str, float]:
    band, jump = found.band, found.jump
    if band is None or jump is None:
        return {}
    return {
        "band": band.value, "band_low": band.low, "band_high": band.high, "jump": jump.value, "jump_low": jump.low,
        "jump_high": jump.high, "band_of_range": band.value / found.valves.span,
    }  # fmt: skip


def _how_sure(found: RoutineDiagnosis) -> str:
    valves, seen, answer = found.valves, found.oscillation, found.answer
    of_valve = f"{valves.reversals} reversals, by chance {valves.chance:.2g}"
    match found.verdict:
        case "stiction" | "backlash":
            return f"{100.0 * (1.0 - math.exp(-valves.decrease)):.0f} % less error, {of_valve}"
        case "tight_tuning" if answer is not None:
            return f"{100.0 * answer.explained:.0f} % of y foretold by the set-point"
        case "outside_oscillation":
            return f"{100.0 * seen.phase_kept:.0f} % of y foretold by one sine over {seen.periods:.0f} periods"
        case _:
            return of_valve
