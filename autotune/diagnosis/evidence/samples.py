"""What can be seen in the samples alone: repeated values, steps of a converter, spikes, stamps that are not true.

These effects change single readings and leave the chain as it is. They are looked for first, and the rows they spoil
are left out of every fit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.evidence.readings import (
    clipped_rows,
    converter_spread,
    converter_step,
    jitter_of,
    lost_rows,
    runs_of,
    spikes,
)
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.models import Parameter
from autotune.recording import Recording

#: The effect that is looked for in stamps, in the residual's size, and in how innovations go with steps of the command.
JITTER = "timing.jitter"


@dataclass(frozen=True, kw_only=True, eq=False)
class SampleEffect:
    """An effect seen in the samples.

    Attributes
    ----------
    name, equation : str
        Name in the catalogue and what it does.
    parameters : mapping
        Values with units.
    evidence : float
        Decrease of chi2 that it brings, comparable with a fit's.
    speaks : float
        Twice the logarithm of the odds that the stretches it acts in give to a simulation with it, beside one without;
        infinite where no simulation was asked.
    windows : tuple of (recording, t0, t1)
        When it acts; empty for always.
    rows : tuple of (N,) bool array
        Rows that it spoils and that no fit sees; empty for all or none.
    """

    name: str
    equation: str
    parameters: Mapping[str, Parameter]
    evidence: float
    speaks: float = math.inf
    windows: tuple[tuple[int, float, float], ...] = ()
    rows: tuple[BoolArray, ...] = ()


def inspect(
    recordings: Sequence[Recording], without: Collection[str] = (), limits: Thresholds = IN_USE
) -> tuple[list[BoolArray], list[SampleEffect]]:
    """Look at the readings of all recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        What was measured.
    without : collection of str
        Effects that are not looked for: their rows count like any other.
    limits : Thresholds
        What decides between two findings.

    Returns
    -------
    good : list of (N,) bool array
        Rows whose reading counts.
    effects : list of SampleEffect
        A limit, dropouts, outliers and converter steps found: a simulation has yet to confirm them.
    """
    good = [np.isfinite(r.y) for r in recordings]
    unit = str(recordings[0].metadata.get("units", {}).get("y", ""))
    effects: list[SampleEffect] = []
    step = converter_step(np.concatenate([r.y for r in recordings]))
    if step > 0.0 and "sensor.quantisation" not in without:
        effects += _quantisation(recordings, step, unit, limits)
    clipped, levels = clipped_rows(recordings, limits)
    if levels and "sensor.saturation" not in without:
        effects.append(_saturation(recordings, clipped, levels, unit))
        good = [g & ~c for g, c in zip(good, clipped, strict=True)]
    frozen = [f & ~c for f, c in zip(lost_rows(recordings, limits), clipped, strict=True)]
    count = sum(int(f.sum()) for f in frozen)
    total = sum(len(r) for r in recordings)
    if count and "sensor.dropout" not in without:
        effects.append(_dropout(recordings, frozen, count / total))
        good = [g & ~f for g, f in zip(good, frozen, strict=True)]
    outliers = (
        None if "sensor.outliers" in without else outliers_in([r.y for r in recordings], recordings, good, limits)
    )
    if outliers is not None:
        effects.append(outliers)
        good = [g & ~s for g, s in zip(good, outliers.rows, strict=True)]
    return good, effects


def outliers_in(
    values: Sequence[FloatArray], recordings: Sequence[Recording], good: Sequence[BoolArray], limits: Thresholds
) -> SampleEffect | None:
    """Return the outliers of readings, or of what a simulation leaves of them; nothing where there are too few.

    Parameters
    ----------
    values : sequence of (N,) array
        Readings, or residuals.
    recordings, good : sequences
        What was measured, and which rows count.
    limits : Thresholds
        What decides between two findings.
    """
    least = converter_spread(recordings)
    pairs = list(zip(values, good, strict=True))
    lone = [spikes(v, g, limits.spike, least) for v, g in pairs]
    count, total = sum(int(s.sum()) for s in lone), sum(len(r) for r in recordings)
    if count < limits.least_run:
        return None
    heights = np.concatenate([np.abs(v - _neighbours(v, g))[s] for (v, g), s in zip(pairs, lone, strict=True)])
    unit = str(recordings[0].metadata.get("units", {}).get("y", ""))
    return _outliers(recordings, lone, count / total, float(np.median(heights)), unit)


def join_outliers(found: Sequence[SampleEffect]) -> SampleEffect:
    """Return outliers that were found one after the other as one effect; the last ones' size, all their shares."""
    last = found[-1]
    share = sum(one.parameters["share"].value for one in found)
    sd = float(np.sqrt(sum(one.parameters["share"].sd ** 2 for one in found)))
    return replace(
        last,
        parameters={**last.parameters, "share": replace(last.parameters["share"], value=share, sd=sd)},
        evidence=sum(one.evidence for one in found),
        windows=tuple(sorted(window for one in found for window in one.windows)),
        rows=tuple(np.logical_or.reduce(rows) for rows in zip(*(one.rows for one in found), strict=True)),
    )


def unspoiled_rows(recordings: Sequence[Recording], effects: Sequence[SampleEffect]) -> list[BoolArray]:
    """Return the rows whose reading no effect spoils."""
    good = [np.isfinite(r.y) for r in recordings]
    for one in effects:
        good = [g & ~rows for g, rows in zip(good, one.rows, strict=True)] if one.rows else good
    return good


def _saturation(
    recordings: Sequence[Recording], rows: Sequence[BoolArray], levels: dict[str, float], unit: str
) -> SampleEffect:
    return SampleEffect(
        name="sensor.saturation",
        equation="y = min(max(z, low), high)",
        parameters={key: Parameter(value=v, unit=unit, sd=1e-5 * abs(v)) for key, v in levels.items()},
        evidence=20.0 * sum(int(r.sum()) for r in rows),
        windows=tuple(_runs(recordings, rows)),
        rows=tuple(rows),
    )


def _neighbours(y: FloatArray, good: BoolArray) -> FloatArray:
    filled = np.interp(np.arange(y.size), np.flatnonzero(good), y[good])
    return np.asarray(0.5 * (np.roll(filled, 1) + np.roll(filled, -1)))


def _quantisation(recordings: Sequence[Recording], step: float, unit: str, limits: Thresholds) -> list[SampleEffect]:
    jitter = np.concatenate([np.diff(r.y) for r in recordings])
    share = float(np.mean(jitter == 0.0))
    noise = jitter_of(np.concatenate([r.y for r in recordings]))
    if step**2 / 12.0 < limits.material * noise**2:
        return []  # too fine to matter beside the noise
    rows = sum(len(r) for r in recordings)
    return [
        SampleEffect(
            name="sensor.quantisation",
            equation="y = step round(z / step)",
            parameters={"step": Parameter(value=step, unit=unit, sd=1e-3 * step)},
            evidence=rows * share,
        )
    ]


def _runs(recordings: Sequence[Recording], rows: Sequence[BoolArray]) -> list[tuple[int, float, float]]:
    pairs = enumerate(zip(recordings, rows, strict=True))
    return [(i, float(r.t[a]), float(r.t[min(b, len(r) - 1)])) for i, (r, mark) in pairs for a, b in runs_of(mark)]


def _dropout(recordings: Sequence[Recording], frozen: Sequence[BoolArray], share: float) -> SampleEffect:
    windows = _runs(recordings, frozen)
    rows = sum(int(f.sum()) for f in frozen)
    return SampleEffect(
        name="sensor.dropout",
        equation="y repeats its last value while a sample is missing",
        parameters={
            "share": Parameter(value=share, unit="-", sd=float(np.sqrt(share / sum(len(r) for r in recordings)))),
            "rows": Parameter(value=rows / max(len(windows), 1), unit="-"),
        },
        evidence=20.0 * rows,
        windows=tuple(windows),
        rows=tuple(frozen),
    )


def _outliers(
    recordings: Sequence[Recording], lone: Sequence[BoolArray], share: float, height: float, unit: str
) -> SampleEffect:
    return SampleEffect(
        name="sensor.outliers",
        equation="y = z + spikes of either sign at single rows",
        parameters={
            "share": Parameter(value=share, unit="-", sd=float(np.sqrt(share / sum(len(r) for r in recordings)))),
            "size": Parameter(value=height, unit=unit),
        },
        evidence=40.0 * sum(int(s.sum()) for s in lone),
        windows=tuple(_runs(recordings, lone)),
        rows=tuple(lone),
    )
