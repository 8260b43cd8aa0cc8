"""What can be seen in the samples alone: repeated values, steps of a converter, spikes, stamps that are not true.

These effects change single readings and leave the chain as it is. They are looked for first, and the rows they spoil
are left out of every fit.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.effects import kind_of
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.models import Parameter
from autotune.recording import Recording

#: Distance from a level, in steps, at which a reading lies on it, and the share of readings that do.
_ON_STEP, _REGULAR = 0.05, 0.97
#: Distance of two values, as a share of the largest, that is how numbers are written.
_TINY = 1e-4
_ENDS = (("low", -np.inf), ("high", np.inf))


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
    gaps = gaps[gaps > _TINY * np.max(gaps)]
    step = float(np.median(gaps[gaps <= 1.5 * np.min(gaps)]))
    multiples = gaps / step
    regular = float(np.mean(np.abs(multiples - np.round(multiples)) < _ON_STEP)) > _REGULAR
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


def is_material(effect: SampleEffect, result: Fit, data: Data) -> bool:
    """Whether what single samples show matters beside what a free run leaves of a rig.

    A converter's step does where its rounding is a tenth of the residual's variance, a spoiled reading where it is far
    farther from the simulation than others: a plant at rest repeats its reading as well, and a slow converter does.
    """
    good = [g & np.isfinite(e) for g, e in zip(data.good, result.residuals, strict=True)]
    squares = [np.square(r.y - s[:, 0]) for r, s in zip(data.recordings, result.signals, strict=True)]
    usual = float(np.mean(np.concatenate([q[g] for q, g in zip(squares, good, strict=True)])))
    if kind_of(effect.name).steps:
        return effect.parameters["step"].value ** 2 / 12.0 > data.thresholds.material * usual
    if not effect.rows or not any(rows.any() for rows in effect.rows):
        return True
    spoiled = np.concatenate([q[rows] for q, rows in zip(squares, effect.rows, strict=True)])
    spoiled = spoiled[np.isfinite(spoiled)]
    return bool(spoiled.size) and float(np.mean(spoiled)) > data.thresholds.spoiled * usual


def improves(effect: SampleEffect, result: Fit, data: Data) -> bool:
    """Whether a simulation is nearer to readings that were not fitted with what their samples show.

    Parameters
    ----------
    effect : SampleEffect
        What the samples show.
    result : Fit
        The simulation, in which it does not act.
    data : Data
        What that was fitted to: rows that the effect spoils do not count there.

    Notes
    -----
    A reading that is repeated is the one before it, exactly. A clipped one is its limit. A spike stands out of
    the residual too: the simulation does not explain it. A converter's step is found in one half
    of the readings and predicts the values of the other.
    """
    limits, kind = data.thresholds, kind_of(effect.name)
    simulated = [s[:, 0] for s in result.signals]
    if kind.steps:
        return _step_predicts(data)
    if not effect.rows or not any(rows.any() for rows in effect.rows):
        return True
    left = [r.y[rows] - s[rows] for r, s, rows in zip(data.recordings, simulated, effect.rows, strict=True)]
    off = np.concatenate(left)
    off = off[np.isfinite(off)]
    if kind.is_simulated:  # limits: the simulation goes beyond them, or noise does
        low, high = (effect.parameters[key].value if key in effect.parameters else bound for key, bound in _ENDS)
        ends = [np.clip(s[rows], low, high) for s, rows in zip(simulated, effect.rows, strict=True)]
        clipped = np.concatenate([r.y[rows] - e for r, e, rows in zip(data.recordings, ends, effect.rows, strict=True)])
        return float(np.nansum(clipped**2)) <= float(np.sum(off**2))
    if kind.uneven:
        return _stand_out(effect, [r.y - s for r, s in zip(data.recordings, simulated, strict=True)], limits)
    return float(np.sum(off**2)) > 0.0


def _stand_out(effect: SampleEffect, residuals: Sequence[FloatArray], limits: Thresholds) -> bool:
    """Whether spikes stand out of the residual too, beside their neighbours: what the simulation explains does not."""
    alone = [e[1:-1] - 0.5 * (e[:-2] + e[2:]) for e in residuals]
    usual = np.concatenate([d[~rows[1:-1]] for d, rows in zip(alone, effect.rows, strict=True)])
    spikes_of = np.concatenate([d[rows[1:-1]] for d, rows in zip(alone, effect.rows, strict=True)])
    spread = 1.4826 * float(np.nanmedian(np.abs(usual)))
    return bool(np.nanmedian(np.abs(spikes_of)) > limits.least_outlier * spread)


def _step_predicts(data: Data) -> bool:
    """Whether the values of every half of the readings are apart by multiples of the step found in the other."""
    y = np.concatenate([r.y[np.isfinite(r.y)] for r in data.recordings])
    halves = y[: y.size // 2], y[y.size // 2 :]
    for known, unknown in (halves, halves[::-1]):
        step, gaps = converter_step(known), np.diff(np.unique(unknown))
        if step == 0.0 or not gaps.size:
            return False
        multiples = gaps[gaps > _TINY * np.max(gaps)] / step
        if not float(np.mean(np.abs(multiples - np.round(multiples)) < _ON_STEP)) > _REGULAR:
            return False
    return True


def is_nearer(effect: SampleEffect, result: Fit, share: float) -> bool:
    """Whether a simulation with an effect leaves less than a share of the squared error; beside noise none does."""
    kind = kind_of(effect.name)
    if not kind.steps:
        return kind.is_simulated
    step = effect.parameters["step"].value
    pairs = zip([s[:, 0] for s in result.signals], result.residuals, strict=True)
    rounded = np.concatenate([s + e - step * np.round(s / step) for s, e in pairs])
    return float(np.nansum(rounded**2)) < share * float(np.nansum(np.concatenate(result.residuals) ** 2))
