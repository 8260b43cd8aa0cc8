"""The verdict on a loop in operation: what the test of the valve, the phase and the set-point say."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as students_t

from autotune.arrays import FloatArray
from autotune.diagnosis.routine import sentences
from autotune.diagnosis.routine.operation import Operation, operation_of
from autotune.diagnosis.routine.oscillation import (
    SetpointAnswer,
    line_share,
    phase_kept,
    regularity,
    setpoint_answer,
)
from autotune.diagnosis.routine.result import Oscillation, RoutineDiagnosis, Verdict
from autotune.diagnosis.routine.thresholds import RoutineThresholds
from autotune.diagnosis.routine.valves import ValveComparison, compare_valves
from autotune.identification.answer import require_order
from autotune.recording import Recording


def diagnose_routine(
    recordings: Sequence[Recording],
    thresholds: RoutineThresholds | None = None,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> RoutineDiagnosis:
    """Say why a loop in operation oscillates: its valve, its tuning, something outside, or that the record cannot tell.

    A faulty valve is named where the past of its position predicts y clearly better than the past of the command, and
    better than it would in the same loop with a linear valve.

    Parameters
    ----------
    recordings : sequence of Recording
        Of one loop, at one sample time; r where it was recorded.
    thresholds : RoutineThresholds, optional
        Numbers that decide.
    progress : callable
        Told what is done, and which share of it.

    Returns
    -------
    RoutineDiagnosis

    Raises
    ------
    InputError
        Too few rows, a command that does not move or has gaps, recordings of different sample times.
    IdentificationError
        u and y seem swapped.

    Notes
    -----
    Bias: the band's interval is a bootstrap over half cycles of the command, and no narrower than the grid of bands.
    """
    limits = thresholds or RoutineThresholds()
    operation = operation_of(recordings, limits)
    require_order(recordings)
    valves = compare_valves(operation, limits, lambda share: progress("valves", 0.8 * share))
    progress("oscillation", 0.8)
    answer, seen = setpoint_answer(operation, limits.badly_damped), _oscillation(operation)
    found = RoutineDiagnosis(
        verdict=_verdict(valves, seen, answer, limits),
        kinds_apart=min(valves.sticks, 1.0 - valves.sticks) < limits.unlikely,
        valves=valves, oscillation=seen, answer=answer, sentences=(), following="", operation=operation,
    )  # fmt: skip
    return replace(found, sentences=sentences.said(found, limits), following=sentences.following(found))


def _oscillation(operation: Operation) -> Oscillation:
    kept, periods = phase_kept(operation)
    parts = [operation.y[operation.rows_of(i)] for i in range(operation.starts.size)]
    return Oscillation(
        period_s=operation.period_rows * operation.dt_s, share=line_share(operation), phase_kept=kept, periods=periods,
        regularity=min(regularity(np.where(np.isfinite(y), y, np.nanmean(y))) for y in parts),
    )  # fmt: skip


def chance_of(ratios: FloatArray) -> float:
    """Return the probability that values of mean 0 have a mean as large by chance: Student's t, one-sided."""
    spread = float(np.std(ratios, ddof=1)) / math.sqrt(ratios.size)
    mean = float(np.mean(ratios))
    t = mean / spread if spread > 0.0 else math.copysign(math.inf, mean) if mean else 0.0
    return float(students_t.sf(t, ratios.size - 1))


def _verdict(
    valves: ValveComparison, seen: Oscillation, answer: SetpointAnswer | None, limits: RoutineThresholds
) -> Verdict:
    clear = valves.chance <= limits.chance and valves.decrease > limits.least_decrease
    if clear and valves.reversals >= limits.least_reversals:
        return "stiction" if valves.valve.J > 0.0 else "backlash"
    if answer is not None and answer.explained > limits.least_share:
        moved = answer.ratios[np.abs(answer.ratios) > 1e-9]  # elsewhere the set-point says nothing
        damped = moved.size > 3 and chance_of(moved) < limits.chance
        if damped and float(np.max(answer.dampings)) <= limits.badly_damped:
            return "tight_tuning"
    follows = valves.decrease <= limits.least_decrease or valves.chance > limits.unlikely
    if seen.phase_kept > limits.least_phase and seen.periods >= limits.least_periods and follows:
        return "outside_oscillation"
    oscillates = seen.regularity > limits.regular and seen.share > limits.least_share
    return "abstain" if oscillates else "none"
