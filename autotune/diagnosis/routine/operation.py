"""Recordings of a loop in operation, cut into windows that are compared and stretches that are left out together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from autotune.arrays import FloatArray, IntArray, is_constant
from autotune.diagnosis.routine.thresholds import RoutineThresholds
from autotune.errors import InputError
from autotune.recording import Recording

#: Values beyond this have squares of squares that no number holds.
_LARGEST = 1e70


@dataclass(frozen=True, kw_only=True, eq=False)
class Operation:
    """A loop's recordings on one even grid, one after the other.

    Attributes
    ----------
    dt_s : float
        Step of the grid [s].
    t, u, y : (N,) array
        Time from each recording's first row [s], command, measurement; y may hold NaN.
    r : (N,) array or None
        Set-point, where every recording has it.
    starts : (R,) array of int
        First row of every recording.
    period_rows : float
        Dominant period [rows], NaN where no line stands out.
    windows : (W, 2) array of int
        First row of each window and the row after its last.
    stretch_of : (W,) array of int
        Stretch that a window belongs to: stretches are left out whole.
    names : tuple of str
        Of the recordings.
    u_unit, y_unit : str
        Units of u and y, as the sidecar of the first recording has them; empty where it has none.
    seen : float
        Share of the recorded time that is looked at; less than 1 where the recordings are long.
    """

    dt_s: float
    t: FloatArray
    u: FloatArray
    y: FloatArray
    r: FloatArray | None
    starts: IntArray
    period_rows: float
    windows: IntArray
    stretch_of: IntArray
    names: tuple[str, ...]
    u_unit: str = ""
    y_unit: str = ""
    seen: float = 1.0

    @property
    def stretches(self) -> int:
        """How many stretches there are."""
        return int(self.stretch_of[-1]) + 1

    def rows_of(self, recording: int) -> slice:
        """Return the rows of a recording."""
        ends = np.append(self.starts[1:], self.u.size)
        return slice(int(self.starts[recording]), int(ends[recording]))


def operation_of(recordings: Sequence[Recording], limits: RoutineThresholds) -> Operation:
    """Return recordings of one loop, made even, thinned to what their oscillation needs, and cut.

    Raises
    ------
    InputError
        Too few rows, u or y that never moves, values beyond 1e70, gaps in u, or recordings of different sample times.
    """
    even = [_even(recording, limits) for recording in recordings]
    steps = np.array([recording.sample_time_s for recording in even])
    if np.ptp(steps) > 0.02 * steps[0]:
        raise InputError(
            f"sample times of {steps.min():g} s and {steps.max():g} s",
            where=", ".join(recording.name for recording in even),
            remedy="give recordings of one loop at one sample time, or one recording at a time",
        )
    has_r = all("r" in recording.extra and np.isfinite(recording["r"]).all() for recording in even)
    followed = has_r and any(float(np.ptp(recording["r"])) > 0.0 for recording in even)
    period = _period([recording.u for recording in even], [recording.y for recording in even], followed)
    few = sum(len(recording) for recording in even) <= limits.thinned_from or not np.isfinite(period)
    thin = 1 if few else max(1, int(period / limits.most_rows_per_period))
    even = [_thinned(recording, thin) for recording in even]
    spanned_s = sum(recording.duration_s for recording in even)
    even = [_liveliest(recording, limits.most_rows // len(even)) for recording in even]
    period = period / thin
    u, y = (np.concatenate([recording[name] for recording in even]) for name in ("u", "y"))
    starts = np.cumsum([0, *(len(recording) for recording in even[:-1])]).astype(np.int64)
    windows, stretch_of = _windows([len(recording) for recording in even], period, limits)
    return Operation(
        dt_s=float(steps[0]) * thin,
        t=np.concatenate([recording.t - recording.t[0] for recording in even]),
        u=u,
        y=y,
        r=np.concatenate([recording["r"] for recording in even]) if has_r else None,
        starts=starts,
        period_rows=period,
        windows=windows,
        stretch_of=stretch_of,
        names=tuple(recording.name for recording in even),
        u_unit=_unit_of(recordings[0], "u"),
        y_unit=_unit_of(recordings[0], "y"),
        seen=sum(recording.duration_s for recording in even) / spanned_s,
    )


def _unit_of(recording: Recording, signal: str) -> str:
    units = recording.metadata.get("units", {})
    unit = units.get(signal, "") if isinstance(units, Mapping) else ""
    return unit if isinstance(unit, str) else ""


def _even(recording: Recording, limits: RoutineThresholds) -> Recording:
    if len(recording) < limits.least_rows:
        raise InputError(
            f"{len(recording)} rows", where=recording.name,
            remedy=f"a routine record needs at least {limits.least_rows} rows, best ten periods of an oscillation",
        )  # fmt: skip
    bad = ~np.isfinite(recording.u)
    if bad.any():
        raise InputError(
            f"u is missing in {int(bad.sum())} row(s), first at t = {recording.t[int(np.argmax(bad))]:g} s",
            where=recording.name, remedy="give a stretch in which every command was recorded",
        )  # fmt: skip
    if is_constant(recording.u):
        raise InputError(
            f"u is constant ({recording.u[0]:g}): a valve that is not moved shows nothing", where=recording.name,
            remedy="check the column, or give a record of the loop in automatic mode",
        )  # fmt: skip
    readings = recording.y[np.isfinite(recording.y)]
    if readings.size == 0 or is_constant(readings):
        raise InputError(
            f"y is constant ({readings[0]:g})" if readings.size else "y has no reading", where=recording.name,
            remedy="check the column and the sensor: what never answers shows nothing of the valve",
        )  # fmt: skip
    largest = float(max(np.max(np.abs(recording.u)), np.max(np.abs(readings))))
    if largest > _LARGEST:
        raise InputError(
            f"values up to {largest:g}", where=recording.name, remedy="check the columns and their units"
        )  # fmt: skip
    return recording if recording.is_uniform else recording.resampled(recording.sample_time_s)


def _thinned(recording: Recording, every: int) -> Recording:
    """Return every so many-th row: a position that the valve passed between them is not seen any more."""
    return recording if every == 1 else recording.resampled(every * recording.sample_time_s)


def _liveliest(recording: Recording, most: int) -> Recording:
    """Return the part of at most so many rows in which the command travels furthest; thinner rows would miss turns."""
    if len(recording) <= most:
        return recording
    travelled = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(recording.u)))])
    firsts = np.arange(0, len(recording) - most + 1, max(1, most // 4))
    first = int(firsts[np.argmax(travelled[firsts + most - 1] - travelled[firsts])])
    return recording.between(
        float(recording.t[first]), float(recording.t[first + most - 1]) + 0.5 * recording.sample_time_s
    )


def _period(us: Sequence[FloatArray], ys: Sequence[FloatArray], followed: bool) -> float:
    """Return the period [rows] at which u and y have most power together, NaN where no cross power is in both.

    Parameters
    ----------
    us, ys : sequence of (N,) array
        The same signal of every recording; the longest is looked at.
    followed : bool
        Whether the set-point moves: then the slow part of both is its, and their rates are looked at.
    """
    longest = int(np.argmax([u.size for u in us]))
    u, y = us[longest], ys[longest]
    y = np.where(np.isfinite(y), y, np.nanmean(y))
    n = u.size
    crossed = np.ones(4 * n // 2 + 1)
    for x in (u, y):
        crossed = crossed * np.abs(np.fft.rfft(np.hanning(n) * without_trend(x), 4 * n))
    if followed:
        crossed = crossed * np.arange(crossed.size) ** 2
    least = 4 * 3  # at least three periods in the record
    if not crossed[least:].max() > 0.0:
        return float("nan")
    peak = least + int(np.argmax(crossed[least:]))
    around = crossed[peak - 1 : peak + 2]
    if around.size == 3 and 0.0 < around[0] <= around[1]:  # a line between the grid's: a parabola through the three
        before, top, after = np.log(np.maximum(around, 1e-300))
        return float(4 * n / (peak + 0.5 * (after - before) / max(2.0 * top - before - after, 1e-12)))
    return float(4 * n / peak)


def without_trend(x: FloatArray) -> FloatArray:
    """Return a signal (N,) without the parabola that fits it best."""
    trend = np.vander(np.linspace(-1.0, 1.0, x.size), 3)
    return np.asarray(x - trend @ np.linalg.lstsq(trend, x, rcond=None)[0])


def _windows(sizes: Sequence[int], period: float, limits: RoutineThresholds) -> tuple[IntArray, IntArray]:
    """Return windows of some periods, and the stretch of each: neighbours go together where there are many."""
    total = sum(sizes)
    wanted = limits.periods_per_window * period if np.isfinite(period) else total / limits.most_stretches
    longest = total / limits.least_stretches
    length = int(np.clip(min(wanted, longest), limits.least_window_rows, total))
    windows, first = [], 0
    for size in sizes:
        count = max(1, size // length)
        edges = first + np.linspace(0, size, count + 1).astype(np.int64)
        windows += list(pairwise(edges))
        first += size
    share = np.arange(len(windows)) * min(limits.most_stretches, len(windows)) // len(windows)
    return np.array(windows, dtype=np.int64), share.astype(np.int64)
