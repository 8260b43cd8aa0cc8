"""The verdict on a loop in operation: what the free runs on stretches left out, the phase and the set-point say."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as students_t

from autotune.arrays import FloatArray
from autotune.diagnosis.routine import sentences
from autotune.diagnosis.routine.candidates import LEAST_BAND, Bench, Point, bench_of, replace_filter, whitening
from autotune.diagnosis.routine.fitting import Family, Fitted, LeftOut, band_step, fit, left_out, resampled_bands
from autotune.diagnosis.routine.operation import Operation, operation_of
from autotune.diagnosis.routine.oscillation import (
    SetpointAnswer,
    line_share,
    phase_kept,
    regularity,
    setpoint_answer,
)
from autotune.diagnosis.routine.result import Comparison, Interval, Oscillation, RoutineDiagnosis, Verdict
from autotune.diagnosis.routine.thresholds import RoutineThresholds
from autotune.recording import Recording

_FAULTS: tuple[Family, ...] = ("play", "stiction")


def diagnose_routine(
    recordings: Sequence[Recording],
    thresholds: RoutineThresholds | None = None,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> RoutineDiagnosis:
    """Say why a loop in operation oscillates: its valve, its tuning, something outside, or that the record cannot tell.

    A plant of one or two lags (or an integrator) with dead time is fitted together with the valve, driven by the
    recorded command; each family of valves is judged by its free run on stretches that were not fitted.

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

    Notes
    -----
    Bias: load that the controller answers stands in u as well as in y, so gain, lag and a narrow band are drawn
    towards the controller's inverse. The band's interval is a bootstrap over stretches and does not hold that bias.
    """
    limits = thresholds or RoutineThresholds()
    operation = operation_of(recordings, limits)
    bench = bench_of(operation)
    runs: dict[Family, LeftOut] = {}
    for number, family in enumerate(("linear", *_FAULTS)):
        progress(f"free runs, {family}", number / 5)
        runs[family] = left_out(bench, family)
    linear, least = runs["linear"].errors, band_step(limits.wide_band)
    progress("free runs, wide bands", 0.6)
    wide = {family: compared(linear, left_out(bench, family, least).errors) for family in _FAULTS}
    progress("oscillation", 0.9)
    answer, seen = setpoint_answer(operation, limits.badly_damped), _oscillation(operation)
    verdict, apart = _verdict(runs, wide, seen, answer, limits)
    found = RoutineDiagnosis(
        verdict=verdict, band=None, jump=None, kinds_apart=apart, runs=runs, wide=wide, oscillation=seen,
        fits={family: fit(bench, family, np.ones(operation.stretches)) for family in runs},
        spread=bench.sums(Point())[0, :, 2],
        against_linear={family: compared(linear, runs[family].errors) for family in _FAULTS},
        answer=answer, sentences=(), following="", bench=bench,
    )  # fmt: skip
    if found.family != "linear":
        band, jump = _bands(bench, found.family, found.fits[found.family], limits)
        if band.low < limits.least_band * bench.span:
            found = replace(found, verdict="abstain", kinds_apart=False)
        else:
            found = replace(found, band=band, jump=jump)
    return replace(found, sentences=sentences.said(found, limits), following=sentences.following(found))


def _oscillation(operation: Operation) -> Oscillation:
    kept, periods = phase_kept(operation)
    parts = [operation.y[operation.rows_of(i)] for i in range(operation.starts.size)]
    return Oscillation(
        period_s=operation.period_rows * operation.dt_s, share=line_share(operation), phase_kept=kept, periods=periods,
        regularity=min(regularity(np.where(np.isfinite(y), y, np.nanmean(y))) for y in parts),
    )  # fmt: skip


def compared(first: FloatArray, second: FloatArray) -> Comparison:
    """Return how the squared errors of a second family compare with those of a first, stretch by stretch."""
    ratios = np.log(np.maximum(first, 1e-300) / np.maximum(second, 1e-300))
    spread = float(np.std(ratios, ddof=1)) / math.sqrt(ratios.size)
    mean = float(np.mean(ratios))
    t = mean / spread if spread > 0.0 else math.copysign(math.inf, mean) if mean else 0.0
    return Comparison(decrease=mean, chance=float(students_t.sf(t, ratios.size - 1)), won=int(np.sum(ratios > 0.0)))


def _verdict(
    runs: dict[Family, LeftOut],
    wide: dict[Family, Comparison],
    seen: Oscillation,
    answer: SetpointAnswer | None,
    limits: RoutineThresholds,
) -> tuple[Verdict, bool]:
    """Return the verdict, and whether sticking and play are told apart."""
    clear = [f for f in _FAULTS if wide[f].chance < limits.chance and wide[f].decrease > limits.least_decrease]
    if clear:
        sticks = compared(runs["play"].errors, runs["stiction"].errors)
        plays = compared(runs["stiction"].errors, runs["play"].errors)
        if "play" not in clear or (sticks.chance < limits.kinds_apart and "stiction" in clear):
            return "stiction", sticks.chance < limits.kinds_apart
        return "backlash", "stiction" not in clear or plays.chance < limits.kinds_apart
    if answer is not None and answer.explained > limits.least_answer:
        moved = answer.ratios[np.abs(answer.ratios) > 1e-9]  # elsewhere the set-point says nothing
        damped = compared(np.exp(moved), np.ones(moved.size)) if moved.size > 3 else None
        if (
            damped is not None
            and damped.chance < limits.chance
            and float(np.max(answer.dampings)) <= limits.badly_damped
        ):
            return "tight_tuning", False
    follows = all(one.chance > limits.unlikely for one in wide.values())
    if seen.phase_kept > limits.least_phase and seen.periods >= limits.least_periods and follows:
        return "outside_oscillation", False
    oscillates = seen.regularity > limits.regular and seen.share > limits.oscillating
    return ("abstain" if oscillates else "none"), False


def _bands(bench: Bench, family: Family, fitted: Fitted, limits: RoutineThresholds) -> tuple[Interval, Interval]:
    """Return S and J with their intervals.

    The free run and the prediction with a model of the noise err in different directions where the controller answers
    a load: the value is the second's, the interval holds the bootstrap over the stretches of both.
    """
    operation, random = bench.of, np.random.default_rng(0)
    share = np.full(operation.stretches, 1.0 / operation.stretches)
    counts = random.multinomial(operation.stretches, share, size=limits.resamplings)
    order = min(limits.whitening_order, int(np.min(np.diff(operation.windows, axis=1))) // 4)
    residual = operation.y - bench.free_run(fitted.at, fitted.delay, fitted.gain)
    white = replace_filter(bench, whitening(bench, residual, order))
    # no narrower than a third of the free run's: a narrow band and a slow plant imitate noise
    second = fit(white, family, np.ones(operation.stretches), max(0, fitted.at.band - band_step(3.0 * LEAST_BAND)))
    drawn = [resampled_bands(bench, family, fitted, counts), resampled_bands(white, family, second, counts)]
    chosen = white.valve(second.at)
    found = []
    for number in (0, 1):
        value = float(chosen[number])
        ends = [float(q) for one in drawn for q in np.quantile(one[:, number], (0.025, 0.975))]
        step = 0.03 * value  # of the grid
        found.append(Interval(value=value, low=max(min(*ends, value) - step, 0.0), high=max(*ends, value) + step))
    return found[0], found[1]
