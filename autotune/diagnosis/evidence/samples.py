"""What can be seen in the samples alone: repeated values, steps of a converter, spikes, stamps that are not true.

These effects change single readings and leave the chain as it is. They are looked for first, and the rows they spoil
are left out of every fit.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.models import Parameter
from autotune.recording import Recording

#: Distance from a level, in steps, at which a reading lies on it, and the share of readings that do.
ON_STEP, REGULAR = 0.05, 0.97
#: Distance of two values, as a share of the largest, that is how numbers are written.
TINY = 1e-4


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
    windows : tuple of (recording, t0, t1)
        When it acts; empty for always.
    rows : tuple of (N,) bool array
        Rows that it spoils and that no fit sees; empty for all or none.
    """

    name: str
    equation: str
    parameters: Mapping[str, Parameter]
    evidence: float
    windows: tuple[tuple[int, float, float], ...] = ()
    rows: tuple[BoolArray, ...] = ()


def converter_step(y: FloatArray) -> float:
    """Return the step of the converter that all readings are multiples of, 0 where there is none.

    Readings behind a converter take few different values whose distances are multiples of the smallest one; readings
    that were only rounded when they were written take many.
    """
    values = np.unique(y[np.isfinite(y)])
    if values.size < 3:
        return 0.0
    gaps = np.diff(values)
    gaps = gaps[gaps > TINY * np.max(gaps)]
    step = float(np.median(gaps[gaps <= 1.5 * np.min(gaps)]))
    multiples = gaps / step
    regular = float(np.mean(np.abs(multiples - np.round(multiples)) < ON_STEP)) > REGULAR
    return step if regular and step > 0.02 * jitter_of(y) else 0.0


def jitter_of(y: FloatArray) -> float:
    """Return a robust standard deviation of what changes from row to row beyond a straight line."""
    d = np.diff(y[np.isfinite(y)], 2)
    return float(np.sqrt(np.mean(np.minimum(d**2, np.quantile(d**2, 0.99))) / 6.0)) if d.size else 0.0


def frozen_rows(y: FloatArray, least_run: int = Thresholds.least_run) -> BoolArray:
    """Return the rows that repeat the reading before them in runs of at least so many equal readings."""
    same = np.append([False], np.diff(y) == 0.0)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int64), [0]])))
    frozen = np.zeros(y.size, dtype=bool)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= least_run - 1:
            frozen[first:last] = True
    return frozen


def held_share(recordings: Sequence[Recording]) -> float:
    """Return the share of all values that stay for more than one row: most of a slow converter's, few of dropouts'."""
    lengths = [np.diff(np.flatnonzero(np.concatenate([[True], np.diff(r.y) != 0.0, [True]]))) for r in recordings]
    return float(np.mean(np.concatenate(lengths) > 1))


def spikes(y: FloatArray, good: BoolArray, sds: float = Thresholds.spike) -> BoolArray:
    """Return the rows that stand alone out of the mean of their neighbours by so many robust standard deviations."""
    found = np.zeros(y.size, dtype=bool)
    if y.size < 8:
        return found
    filled = np.interp(np.arange(y.size), np.flatnonzero(good), y[good])
    d = np.zeros(y.size)
    d[1:-1] = filled[1:-1] - 0.5 * (filled[:-2] + filled[2:])
    spread = 1.4826 * float(np.median(np.abs(d[1:-1])))
    if spread == 0.0:
        return found
    # the neighbours of a spike of height A show -A/2: a spike is the largest of the three
    size = np.abs(d)
    peak = (size > sds * spread) & (size >= np.roll(size, 1)) & (size >= np.roll(size, -1))
    opposed = np.minimum(-np.roll(d, 1) * np.sign(d), -np.roll(d, -1) * np.sign(d)) > 0.2 * size
    found[peak & opposed & good] = True
    return found


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
        Dropouts, outliers and converter steps found.
    """
    good = [np.isfinite(r.y) for r in recordings]
    unit = str(recordings[0].metadata.get("units", {}).get("y", ""))
    effects: list[SampleEffect] = []
    step = converter_step(np.concatenate([r.y for r in recordings]))
    if step > 0.0:
        # behind a converter equal readings are no dropout, and a spike is measured in steps
        return good, _quantisation(recordings, step, unit, limits) if "sensor.quantisation" not in without else []
    clipped, levels = _clipped(recordings, limits)
    if levels and "sensor.saturation" not in without:
        effects.append(_saturation(recordings, clipped, levels, unit))
        good = [g & ~c for g, c in zip(good, clipped, strict=True)]
    frozen = [frozen_rows(r.y, limits.least_run) & ~c for r, c in zip(recordings, clipped, strict=True)]
    count = sum(int(f.sum()) for f in frozen)
    total = sum(len(r) for r in recordings)
    if (
        count >= max(limits.least_frozen_rows, limits.least_frozen_share * total)
        and held_share(recordings) < limits.most_held
        and "sensor.dropout" not in without
    ):
        effects.append(_dropout(recordings, frozen, count / total))
        good = [g & ~f for g, f in zip(good, frozen, strict=True)]
    lone = [spikes(r.y, g, limits.spike) for r, g in zip(recordings, good, strict=True)]
    count = sum(int(s.sum()) for s in lone)
    if count >= limits.least_spikes and "sensor.outliers" not in without:
        heights = np.concatenate(
            [np.abs(r.y - _neighbours(r.y, g))[s] for r, g, s in zip(recordings, good, lone, strict=True)]
        )
        effects.append(_outliers(recordings, lone, count / total, float(np.median(heights)), unit))
        good = [g & ~s for g, s in zip(good, lone, strict=True)]
    return good, effects


def _clipped(recordings: Sequence[Recording], limits: Thresholds) -> tuple[list[BoolArray], dict[str, float]]:
    """Return the rows that stand at the readings' largest or smallest value, where that value is an end stop.

    Continuous readings hardly ever take their extreme value twice; a converter's end takes it again and again, or once
    for a time while no reading is repeated anywhere else.
    """
    y = np.concatenate([r.y for r in recordings])
    ends = (float(np.nanmin(y)), float(np.nanmax(y)))
    elsewhere = any(bool(np.any(frozen_rows(r.y, limits.least_run) & ~np.isin(r.y, ends))) for r in recordings)
    rows = [np.zeros(len(r), dtype=bool) for r in recordings]
    levels: dict[str, float] = {}
    for key, level in zip(("low", "high"), ends, strict=True):
        at = [r.y == level for r in recordings]
        runs = sum(int(np.sum(a[1:] & ~a[:-1]) + a[0]) for a in at)
        if sum(int(a.sum()) for a in at) >= limits.least_clipped and (runs >= 2 or not elsewhere):
            levels[key] = level
            rows = [a | b for a, b in zip(rows, at, strict=True)]
    return rows, levels


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
    if share < limits.least_equal_share or step**2 / 12.0 < limits.least_rounding * noise**2:
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
    found = []
    for i, (r, mark) in enumerate(zip(recordings, rows, strict=True)):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], mark.astype(np.int64), [0]])))
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            found.append((i, float(r.t[a]), float(r.t[min(b, len(r) - 1)])))
    return found


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
