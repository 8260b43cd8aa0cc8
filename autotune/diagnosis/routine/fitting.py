"""The best valve and plant on any choice of stretches, and what they are worth on the others."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, TypeAlias

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.diagnosis.routine.candidates import BAND, LEAST_BAND, Bench, Point, gain_of, squared_error

#: What a valve may be: linear, with play (J = 0), sticking (J > 0).
Family: TypeAlias = Literal["linear", "play", "stiction"]

#: Coarse grid in the fine grid's steps: bands of 2 to 98 % of the command's range, J/S, where a wide band begins.
_BANDS = (0, 35, 70, 110, 150, 196, 232, 272, 302, 323, 340, 357, 368, 378, 386, 391)
_JUMPS = (4, 10, 20, 30, 40)
_WIDE, _BEGINS, _ALL_BEGINS = 230, (-0.9, 0.0, 0.9), (-0.9, -0.6, -0.3, 0.0, 0.3, 0.6, 0.9)
#: Second lags in steps of the grid, lags tried.
_SECONDS, _LAGS = (0, 2), 10
#: Coarse candidates that are zoomed into, and zooms around each: steps of band, J, lag.
_ZOOMED = 3
#: Candidates, with their dead times, that are compared in each resampling.
_RESAMPLED = 4000
_ZOOMS = ((16, 6, 5), (8, 3, 3), (4, 2, 2), (2, 1, 1), (1, 1, 1))


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A candidate with its numbers.

    Attributes
    ----------
    at : Point
        Place on the grid.
    delay : int
        Index of the dead time.
    gain : float
        [y unit/u unit], or per second where the lag is longer than the windows.
    error : float
        Squared error on what was fitted.
    """

    at: Point
    delay: int
    gain: float
    error: float


def best_of(bench: Bench, points: Iterable[Point], weights: FloatArray) -> Fitted:
    """Return the best candidate over stretches of given weights, over every dead time.

    Parameters
    ----------
    bench : Bench
        With the recordings.
    points : iterable of Point
        What is compared.
    weights : (M,) array
        How often a stretch counts; 0 leaves it out.
    """
    best: Fitted | None = None
    for at in points:
        sums = np.einsum("dmi,m->id", bench.sums(at), weights)
        errors = squared_error(*sums)
        delay = int(np.argmin(errors))
        if best is None or errors[delay] < best.error:
            gain = gain_of(float(sums[0, delay]), float(sums[1, delay]))
            best = Fitted(at=at, delay=delay, gain=gain, error=float(errors[delay]))
    assert best is not None
    return best


def band_step(share: float) -> int:
    """Return the step of the grid at a share of the command's range."""
    return max(0, round(math.log(share / LEAST_BAND) / math.log(BAND)))


def coarse(bench: Bench, family: Family, least_band: int = 0) -> list[Point]:
    """Return the coarse grid of a family over commands and lags, with bands from a step of the fine grid on."""
    rows = float(np.median(np.diff(bench.of.windows, axis=1)))
    longest = int(np.log(6.0 * rows) / np.log(1.08))  # three windows: an integrating plant
    lags = [(-1, 0)] + [(int(lag), second) for lag in np.linspace(4, longest, _LAGS) for second in _seconds(family)]
    if family == "linear":
        return [Point(lag=lag, second=second) for lag, second in lags]
    jumps = (0,) if family == "play" else _JUMPS
    valves = [
        (band, jump, runs_on, begins)
        for band, jump, runs_on in product(
            (b for b in _BANDS if b >= least_band), jumps, (False,) if family == "play" else (False, True)
        )
        for begins in (_BEGINS if band > _WIDE else (0.0,))
    ]
    return [Point(*valve, lag, second) for valve, (lag, second) in product(valves, lags)]


def _seconds(family: Family) -> tuple[int, ...]:
    # the linear rival has the second lag where the valve has its band: as many numbers, and none to spare
    return (0, 1, 2, 3, 4) if family == "linear" else _SECONDS


def fit(bench: Bench, family: Family, weights: FloatArray, least_band: int = 0) -> Fitted:
    """Return the best candidate of a family over stretches of given weights: coarse grid, then zooms around it.

    Parameters
    ----------
    bench : Bench
        With the recordings.
    family : str
        ``linear``, ``play`` or ``stiction``.
    weights : (M,) array
        How often a stretch counts; 0 leaves it out.
    least_band : int
        Smallest band, in steps of the grid.

    Notes
    -----
    The squared error has local minima in the bands, hence the grid; a minimum narrower than a tenth of the range of
    the command can be missed.
    """
    found: list[Fitted] = []
    for start in _starts(bench, coarse(bench, family, least_band), weights):
        best = start
        for zoom in _ZOOMS:
            best = best_of(bench, _around(best.at, zoom, least_band), weights)
        found.append(best)
    return min(found, key=lambda one: one.error)


def _starts(bench: Bench, points: list[Point], weights: FloatArray) -> list[Fitted]:
    """Return the best candidates of the coarse grid, no two of them of one band and kind of motion."""
    errors = squared_error(*(bench.stacked(points) @ weights)).min(1)
    chosen: list[Point] = []
    for number in np.argsort(errors):
        at = points[number]
        if all((at.band, at.runs_on) != (one.band, one.runs_on) for one in chosen):
            chosen.append(at)
        if len(chosen) == _ZOOMED:
            break
    return [best_of(bench, (at,), weights) for at in chosen]


def _around(at: Point, zoom: tuple[int, int, int], least_band: int) -> list[Point]:
    band, jump, lag = zoom
    bands = [-1] if at.band < 0 else [max(at.band + i * band, least_band) for i in (-1, 0, 1)]
    jumps = [0] if at.jump == 0 else [int(np.clip(at.jump + i * jump, 1, 40)) for i in (-1, 0, 1)]
    lags = [-1, 0, 5] if at.lag < 0 else [max(at.lag + i * lag, -1) for i in (-1, 0, 1)]
    steps = product(sorted(set(bands)), sorted(set(jumps)), sorted(set(lags)))
    return [at._replace(band=b, jump=j, lag=k) for b, j, k in steps]


@dataclass(frozen=True, kw_only=True, eq=False)
class LeftOut:
    """A family's free runs on stretches that were not fitted.

    Attributes
    ----------
    errors : (M,) array
        Squared error on every stretch, fitted to the others.
    fits : tuple of Fitted
        The candidate that was fitted to the others, for every stretch.
    """

    errors: FloatArray
    fits: tuple[Fitted, ...]


def left_out(bench: Bench, family: Family, least_band: int = 0) -> LeftOut:
    """Return the free run of a family on every stretch, fitted to the others."""
    errors, fits = np.empty(bench.of.stretches), []
    for number in range(errors.size):
        weights = np.ones(errors.size)
        weights[number] = 0.0
        found = fit(bench, family, weights, least_band)
        # where a valve stood when the recording began is no number of the valve: like the load, it is free
        starts = _other_starts(found.at)
        sums = np.array([bench.sums(at)[found.delay, number] for at in starts])
        squared = sums[:, 2] - 2.0 * found.gain * sums[:, 1] + found.gain**2 * sums[:, 0]
        errors[number] = float(squared.min())
        fits.append(replace(found, at=starts[int(np.argmin(squared))]))
    return LeftOut(errors=errors, fits=tuple(fits))


def _other_starts(at: Point) -> list[Point]:
    return [at] if at.band < 0 else [at._replace(begins=begins) for begins in (at.begins, *_ALL_BEGINS)]


def resampled_bands(bench: Bench, family: Family, around: Fitted, counts: IntArray) -> FloatArray:
    """Return S and J [u] of the best candidate for every resampling of the stretches.

    Candidates are the coarse grid and a fine one around the best.

    Parameters
    ----------
    bench : Bench
        With the recordings.
    family : str
        ``play`` or ``stiction``.
    around : Fitted
        Best candidate over all stretches.
    counts : (B, M) array of int
        How often each stretch was drawn.

    Returns
    -------
    bands : (B, 2) array
    """
    at = around.at
    fine = [
        at._replace(band=max(at.band + band, 0), jump=jump, lag=max(at.lag + lag, -1))
        for band, lag in product(range(-24, 25, 3), (-8, -4, 0, 4, 8))
        for jump in ({0} if at.jump == 0 else {int(np.clip(at.jump + j, 1, 40)) for j in (-8, -4, 0, 4, 8)})
    ]
    points = list(dict.fromkeys([*coarse(bench, family), *fine]))
    stacked = bench.stacked(points)
    errors = squared_error(*stacked.sum(3))
    # the best over all stretches at its best dead times: no other wins a resampling
    number, delay = np.unravel_index(np.argsort(errors, axis=None)[:_RESAMPLED], errors.shape)
    drawn = squared_error(*(stacked[:, number, delay] @ counts.T.astype(np.float64)))
    best = number[np.argmin(drawn, axis=0)]
    return np.array([bench.valve(points[int(i)])[:2] for i in best])
