"""Starting values for the delay fit without being given any: instrumental variables on a grid of delays.

The record is averaged into bins. For windows of several lengths and every delay of a grid, the modulated equation
(-1)^n I_{y,f^(n)} = sum (-1)^i a_i I_{y,f^(i)} + b I_{u_h,f} + d I_{1,f} is solved with the modulated input's own
derivatives as instruments: unlike least squares this is not biased by noise on y, whatever its colour. Each
solution is then valued by its output error, and the best few are fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.delay.data import DelayData
from autotune.identification.delay.instruments import solve_shapes, stabilise
from autotune.identification.delay.modulating import SinePower
from autotune.identification.delay.output_error import Point, Structure, minimise, solve_linear

_BINS = 600
_WINDOWS = (1 / 4, 1 / 10, 1 / 25)  # lengths, in records
_STRIDES = 8  # window positions per window length
_CANDIDATES = 8
_FITTED = 3
_ENERGY_LOST = 0.05  # of u within the bins: above, shorter sections are searched in finer bins
_REFINEMENT = 6
_SCANNED = 41
_SCANNED_DELAYS = 3.0  # how far: times the delay found,
_SCANNED_SHARE = 0.1  # and a share of the record


@dataclass(frozen=True, kw_only=True, eq=False)
class _Bins:
    """The record on a uniform grid, for the modulated integrals."""

    dt: float
    u: FloatArray
    y: FloatArray


def average_bins(data: DelayData, bins: int) -> DelayData:
    """Return the record averaged into bins: u exactly over each, held; y at the mean of its stamps.

    Parameters
    ----------
    data : DelayData
        Record.
    bins : int
        Number of bins between the first and the last stamp.

    Returns
    -------
    DelayData
        The same where the record has fewer rows than bins. An average over a bin of length T differs from the value
        at its middle by T^2/24 of the second derivative; averages of jittered stamps are interpolated to the middle.
    """
    if data.ty.size <= bins and data.tu.size <= 2 * bins:
        return data
    step = (data.ty[-1] - data.ty[0]) / (data.ty.size - 1)
    rows = max(1, -(-data.ty.size // bins))
    width = rows * step
    first = data.ty[0] - np.floor((data.ty[0] - data.tu[0]) / width + 1e-9) * width
    edges = np.arange(first, max(data.tu[-1], data.ty[-1] + step) + 1e-9 * width, width)
    widths = np.diff(data.tu)
    area = 0.5 * (data.u[1:] + data.u[:-1]) * widths if data.linear else data.u[:-1] * widths
    integral = np.concatenate([[0.0], np.cumsum(area)])
    u = np.diff(np.interp(edges, data.tu, integral)) / width
    if np.max(np.abs(data.ty - data.ty[0] - step * np.arange(data.ty.size))) < 1e-6 * step:
        full = data.ty.size // rows
        ty = data.ty[: full * rows].reshape(full, rows).mean(axis=1)
        y = data.y[: full * rows].reshape(full, rows).mean(axis=1)
    else:
        which = np.searchsorted(edges, data.ty, side="right") - 1
        counts = np.bincount(which)
        some = counts > 0
        middle = np.bincount(which, data.ty)[some] / counts[some]
        ty = (edges[:-1] + 0.5 * width)[data.ty[0] <= edges[:-1] + 0.5 * width]
        ty = ty[ty <= data.ty[-1]]
        y = np.interp(ty, middle, np.bincount(which, data.y)[some] / counts[some])
    return replace(data, tu=edges[:-1], u=u, ty=ty, y=y, linear=False)


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A fitted point, and the number of rows per bin it was found with."""

    point: Point
    rows_per_bin: int


def search(data: DelayData, structure: Structure, *, max_delay_s: float) -> list[Candidate]:
    """Return fitted candidates, found on the whole record in bins and, where u is faster, on finer sections of it.

    Parameters
    ----------
    data : DelayData
        The whole record.
    structure : Structure
        Order and free parameters.
    max_delay_s : float
        Largest delay considered [s].

    Returns
    -------
    list of Candidate
        Distinct minima of the output error, by residual variance level by level.

    Raises
    ------
    IdentificationError
        No delay up to the largest gives a model with a finite response.
    """
    rows_per_bin = max(1, -(-data.ty.size // _BINS))
    found: list[Candidate] = []
    while True:
        section = data if rows_per_bin * _BINS >= data.ty.size else _section(data, rows_per_bin * _BINS)
        coarse = average_bins(section, _BINS)
        points = _search_bins(coarse, structure, min(max_delay_s, 0.5 * section.duration_s))
        found += [Candidate(point=point, rows_per_bin=rows_per_bin) for point in points]
        if rows_per_bin == 1 or _energy_lost(section, coarse) < _ENERGY_LOST:
            break
        rows_per_bin = max(1, rows_per_bin // _REFINEMENT)
    if not found:
        raise IdentificationError(
            f"no delay up to {max_delay_s:g} s gives a model of order {structure.order} with a finite response",
            where=data.name,
            remedy="give a larger --max-delay, a longer record, or a lower order",
        )
    return found


def scan(data: DelayData, structure: Structure, best: Point, *, max_delay_s: float) -> Point:
    """Fit the coefficients at every delay of a grid, outwards from a point, and return the lowest minimum.

    Parameters
    ----------
    data : DelayData
        Record, in bins where it is long.
    structure : Structure
        Order and free parameters.
    best : Point
        Where to begin.
    max_delay_s : float
        Largest delay considered [s].

    Returns
    -------
    Point
        On the rows that every delay of the grid can explain. The sum of squares over h has kinks where a step of u
        passes a row, and a minimum beyond each, which no step downhill leaves.
    """
    reach = min(max_delay_s, max(_SCANNED_DELAYS * best.h, _SCANNED_SHARE * data.duration_s))
    usable = data.usable_from(reach)
    if usable.ty.size < 3 * structure.parameters:
        return best
    begin = solve_linear(usable, structure, best.a, min(best.h, reach))
    grid = reach * np.linspace(0.0, 1.0, _SCANNED) ** 2
    points = [begin]
    for side in (grid[grid < begin.h][::-1], grid[grid > begin.h]):
        at = begin
        for h in side:
            start = solve_linear(usable, structure, at.a, float(h))
            if not np.isfinite(start.cost):
                break
            at = minimise(
                usable,
                structure,
                start,
                max_delay_s=reach,
                iterations=4,
                tolerance=0.1,
                held=2 * structure.order + 2,
            )
            points.append(at)
    points.sort(key=lambda point: point.h)
    lowest = sorted(_local_minima(points), key=lambda point: point.cost)[:_FITTED]
    fitted = [minimise(usable, structure, start, max_delay_s=reach, tolerance=1e-2) for start in lowest]
    return min(fitted, key=lambda point: point.cost, default=begin)


def _section(data: DelayData, rows: int) -> DelayData:
    """Return the rows of y where u moves most, with the whole past of u."""
    held = np.searchsorted(data.tu, data.ty, side="right") - 1  # rows of u, of which there may be more than of y
    u = data.u[held]
    energy = np.concatenate([[0.0], np.cumsum((u - u.mean()) ** 2)])
    starts = np.arange(0, energy.size - rows, max(1, rows // 4))
    first = int(starts[np.argmax(energy[starts + rows] - energy[starts])]) if starts.size else 0
    ty, y = data.ty[first : first + rows], data.y[first : first + rows]
    begin, end = int(held[first]), int(held[first : first + rows][-1]) + 1
    keep = slice(max(0, 2 * begin - end), end)
    before = data.before if keep.start == 0 else None
    return replace(data, tu=data.tu[keep], u=data.u[keep], ty=ty, y=y, before=before)


def _energy_lost(data: DelayData, coarse: DelayData) -> float:
    """Return which share of u's variance the bins have averaged away."""
    total = float(np.var(data.u))
    return 1.0 - float(np.var(coarse.u)) / total if total > 0 else 0.0


def _search_bins(coarse: DelayData, structure: Structure, max_delay_s: float) -> list[Point]:
    grid = _uniform(coarse)
    candidates: list[Point] = []
    for share in _WINDOWS:
        length = round(share * grid.y.size)
        if length < 4 * (structure.order + 1):
            continue
        found = [
            solve_linear(coarse.usable_from(h), structure, a, h)
            for h, a in _estimate_by_instruments(grid, structure, length, coarse, max_delay_s)
        ]
        candidates += _local_minima(found)
    candidates = sorted((c for c in candidates if np.isfinite(c.cost)), key=lambda c: c.variance)
    apart_s = max(2.0 * grid.dt, 0.01 * coarse.duration_s)
    roughly = [
        fitted
        for candidate in _distinct(candidates, _CANDIDATES, apart_s)
        if (fitted := _fit(coarse, structure, candidate, max_delay_s, iterations=3)) is not None
    ]
    roughly.sort(key=lambda point: point.variance)
    best = _distinct(roughly, _FITTED, 2.0 * grid.dt)
    fully = [point for start in best if (point := _fit(coarse, structure, start, max_delay_s, iterations=30))]
    return sorted(fully, key=lambda point: point.variance)


def _fit(data: DelayData, structure: Structure, start: Point, max_delay_s: float, iterations: int) -> Point | None:
    """Fit on the rows that a delay somewhat above the start's can explain; None where too few remain."""
    limit = min(start.h * 1.25 + 0.05 * max_delay_s, max_delay_s)
    usable = data.usable_from(limit)
    if usable.ty.size < 3 * structure.parameters:
        return None
    start = solve_linear(usable, structure, start.a, start.h)
    return minimise(usable, structure, start, max_delay_s=limit, tolerance=1e-2, iterations=iterations)


def _uniform(data: DelayData) -> _Bins:
    """Return u and y on one grid; bins without a row are interpolated, which only starting values see."""
    dt = (data.tu[-1] - data.tu[0]) / (data.tu.size - 1)
    grid = data.tu[0] + dt * (np.arange(data.tu.size) + 0.5)
    inside = (grid >= data.ty[0] - dt) & (grid <= data.ty[-1] + dt)
    y = np.where(inside, np.interp(grid, data.ty, data.y), np.nan)
    held = np.clip(np.searchsorted(data.tu, grid, side="right") - 1, 0, None)
    return _Bins(dt=dt, u=data.u[held], y=y)


def _estimate_by_instruments(
    grid: _Bins, structure: Structure, length: int, data: DelayData, max_delay_s: float
) -> list[tuple[float, tuple[float, ...]]]:
    """Return (h, a) by instrumental variables for every delay of a grid an eighth of a window apart."""
    n = structure.order
    window = SinePower(m=n + 2)
    s = (np.arange(length) + 0.5) / length
    kernels = np.array([window.derivative(i, s) / (length * grid.dt) ** i for i in range(n + 1)])
    first = int(np.argmax(np.isfinite(grid.y)))  # rows before are the input's past
    stride = max(1, length // _STRIDES)
    y_windows = np.lib.stride_tricks.sliding_window_view(grid.y, length)
    u_windows = np.lib.stride_tricks.sliding_window_view(grid.u, length)
    starts = np.arange(first, y_windows.shape[0], stride)
    starts = starts[np.isfinite(y_windows[starts].sum(axis=1))]
    Y = y_windows[starts] @ kernels.T
    U = u_windows @ kernels.T
    shifts = np.arange(0, int(max_delay_s / grid.dt) + 1, stride)
    a, valid = solve_shapes(
        Y, U, starts, shifts, data.before is None, structure.integrator, structure.offset, kernels[0].sum()
    )
    return [
        (float(shift * grid.dt), tuple(float(value) for value in stabilise(row, data.duration_s)))
        for shift, row, good in zip(shifts, a, valid, strict=True)
        if good
    ]


def _local_minima(points: list[Point]) -> list[Point]:
    costs = np.array([np.inf, *(point.variance for point in points), np.inf])
    return [
        point
        for i, point in enumerate(points)
        if np.isfinite(point.cost) and costs[i + 1] <= costs[i] and costs[i + 1] <= costs[i + 2]
    ]


def _distinct(points: list[Point], count: int, apart_s: float) -> list[Point]:
    chosen: list[Point] = []
    for point in points:
        if all(abs(point.h - other.h) > apart_s for other in chosen):
            chosen.append(point)
        if len(chosen) == count:
            break
    return chosen
