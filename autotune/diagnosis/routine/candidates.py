"""Valve and plant together: combinations on a grid, each summed by stretches, so that any stretch can be left out.

The command is recorded, so valve and plant are driven by a known input: the candidate's response x runs free over the
whole record. In each window y is compared with ``K x + c + d t`` and, for lags, the decay of a start that is not known;
the three are what load and history may do there, the same for every candidate. The squared error of any set of windows
is then ``sum yy - (sum xy)^2 / sum xx``: the fit over any choice of stretches, and the error on the others, come from
the same sums. All values lie on one fine grid, so that what was once summed is not summed again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from autotune.arrays import FloatArray, IntArray
from autotune.diagnosis.routine.kernels import add_lag, keep_of, lagged, valve_position, window_sums
from autotune.diagnosis.routine.operation import Operation

#: The fine grid: factor between bands and the smallest one as a share of the command's range; step of J/S; factor
#: between lags and the smallest one in rows; step of the second lag's share of the first.
BAND, LEAST_BAND, _JUMP, _LAG, _LEAST_LAG, _SECOND = 1.01, 0.02, 0.025, 1.08, 0.5, 0.25
#: Dead times at most.
_DELAYS = 48


class Valve(NamedTuple):
    """A valve: dead and stick band S [u], slip jump J [u], whether it runs on, where it begins; S = 0 is linear."""

    S: float = 0.0
    J: float = 0.0
    runs_on: bool = False
    begins: float = 0.0


class Lag(NamedTuple):
    """A plant's shape: lag [s], second lag [s]; an integrating plant has a lag longer than the windows."""

    lag_s: float = 0.0
    second_s: float = 0.0


class Point(NamedTuple):
    """Place on the fine grid: band (-1: linear valve), J in steps of S, runs on, start, lag (-1: none), second lag."""

    band: int = -1
    jump: int = 0
    runs_on: bool = False
    begins: float = 0.0
    lag: int = -1
    second: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """An operation with the sums of every candidate that was asked for.

    Attributes
    ----------
    of : Operation
        The recordings.
    delays : (D,) array of int
        Dead times [rows] at which every candidate is summed.
    whitens : (A,) array
        Filter that makes the noise white, applied to response and measurement before they are summed; (1,) for free
        runs as they are.
    """

    of: Operation
    delays: IntArray
    whitens: FloatArray = field(default_factory=lambda: np.ones(1))
    _stacks: dict[tuple[Point, ...], FloatArray] = field(default_factory=dict, repr=False)
    _sums: dict[Point, FloatArray] = field(default_factory=dict, repr=False)
    _positions: dict[tuple[int, int, bool, float], FloatArray] = field(default_factory=dict, repr=False)
    _compared: dict[tuple[int, int], tuple[FloatArray, FloatArray, FloatArray]] = field(
        default_factory=dict, repr=False
    )

    @property
    def span(self) -> float:
        """Range of the command without its rarest rows [u]."""
        low, high = np.quantile(self.of.u, (0.002, 0.998))
        return float(high - low)

    def valve(self, at: Point) -> Valve:
        """Return the valve of a place."""
        if at.band < 0:
            return Valve()
        band = self.span * LEAST_BAND * BAND**at.band
        return Valve(band, band * _JUMP * at.jump, at.runs_on, at.begins)

    def lag(self, at: Point) -> Lag:
        """Return the lags of a place."""
        lag = 0.0 if at.lag < 0 else self.of.dt_s * _LEAST_LAG * _LAG**at.lag
        return Lag(lag, lag * _SECOND * at.second)

    def sums(self, at: Point) -> FloatArray:
        """Return sums of x x, x y and y y over every stretch at every dead time, (D, M, 3) array."""
        if at not in self._sums:
            operation = self.of
            basis, y, yy = self._comparison(at)
            x = self._filtered(self.response(at))
            sums = np.empty((self.delays.size, operation.windows.shape[0], 3))
            sums[:, :, :2] = window_sums(x, y, basis, operation.windows, operation.firsts, self.delays)
            sums[:, :, 2] = yy
            edges = np.flatnonzero(np.diff(operation.stretch_of, prepend=-1))
            self._sums[at] = np.add.reduceat(sums, edges, axis=1)
        return self._sums[at]

    def stacked(self, points: Sequence[Point]) -> FloatArray:
        """Return the sums of many candidates, (3, P, D, M) array; kept for the list that was asked for last."""
        key = tuple(points)
        if key not in self._stacks:
            self._stacks.clear()
            whole = np.empty((3, len(points), self.delays.size, self.of.stretches))
            for number, at in enumerate(points):
                whole[:, number] = np.moveaxis(self.sums(at), 2, 0)
            self._stacks[key] = whole
        return self._stacks[key]

    def position(self, at: Point) -> FloatArray:
        """Return the valve's position over the whole record [u], (N,) array."""
        key = (at.band, at.jump, at.runs_on, at.begins)
        if key not in self._positions:
            valve = self.valve(at)
            static, sliding = 0.5 * (valve.S + valve.J), 0.5 * (valve.S - valve.J)
            self._positions[key] = valve_position(
                self.of.u, self.of.starts, static, sliding, valve.runs_on, valve.begins
            )
        return self._positions[key]

    def response(self, at: Point) -> FloatArray:
        """Return the response of the plant of gain one, without dead time, (N,) array."""
        lag = self.lag(at)
        y = lagged(self.position(at), self.of.starts, keep_of(self.of.dt_s, lag.lag_s))
        if lag.second_s > 0.0:
            y = add_lag(y, self.of.starts, keep_of(self.of.dt_s, lag.second_s))
        return np.asarray(y)

    def free_run(self, at: Point, delay: int, gain: float) -> FloatArray:
        """Return the candidate's output, with what load and history do in each window, (N,) array; NaN outside."""
        operation = self.of
        basis = _basis(self.of, self.lag(at), 0)
        x = gain * delayed(self.response(at), operation, int(self.delays[delay]))
        left = np.full(x.size, np.nan)
        for first, end in operation.windows:
            q = basis[:, first:end]
            rows = q[0] != 0.0
            if rows.sum() > 3:
                difference = np.where(rows, operation.y[first:end] - x[first:end], 0.0)
                left[first:end] = np.where(rows, x[first:end] + q.T @ (q @ difference), np.nan)
        return left

    def _filtered(self, x: FloatArray) -> FloatArray:
        if self.whitens.size == 1:
            return x
        parts = [x[self.of.rows_of(i)] for i in range(self.of.starts.size)]
        return np.concatenate([np.asarray(lfilter(self.whitens, [1.0], part)) for part in parts])

    def _comparison(self, at: Point) -> tuple[FloatArray, FloatArray, FloatArray]:
        key = (at.lag, at.second)
        if key not in self._compared:
            basis = _basis(self.of, self.lag(at), self.whitens.size - 1)
            measured = self._filtered(self.of.y)
            y, yy = np.zeros(self.of.u.size), np.zeros(self.of.windows.shape[0])
            for w, (first, end) in enumerate(self.of.windows):
                q = basis[:, first:end]
                rows = q[0] != 0.0
                if rows.any():
                    part = np.where(rows, measured[first:end], 0.0)
                    part = np.where(rows, part - part[rows].mean(), 0.0)
                    y[first:end] = np.where(rows, part - q.T @ (q @ part), 0.0)
                    yy[w] = float(y[first:end] @ y[first:end])
            self._compared[key] = basis, y, yy
        return self._compared[key]


def bench_of(operation: Operation) -> Bench:
    """Return a bench whose dead times reach half the dominant period, or a quarter of the windows."""
    length = float(np.median(np.diff(operation.windows, axis=1)))
    longest = 0.5 * operation.period_rows if np.isfinite(operation.period_rows) else 0.25 * length
    count = min(_DELAYS, int(longest) + 1)
    return Bench(of=operation, delays=np.unique(np.round(np.linspace(0.0, longest, count)).astype(np.int64)))


def replace_filter(bench: Bench, whitens: FloatArray) -> Bench:
    """Return a bench of the same recordings whose sums are taken behind a filter."""
    return Bench(of=bench.of, delays=bench.delays, whitens=whitens)


def whitening(bench: Bench, residual: FloatArray, order: int) -> FloatArray:
    """Return the filter that makes a residual white, (order + 1,) array: Yule and Walker's equations.

    Parameters
    ----------
    bench : Bench
        With the windows that the residual is taken in.
    residual : (N,) array
        NaN where it is not known.
    order : int
        Of the autoregression.
    """
    covariance = np.zeros(order + 1)
    for first, end in bench.of.windows:
        part = np.nan_to_num(residual[first:end])
        covariance += np.array([float(part[k:] @ part[: part.size - k]) for k in range(order + 1)])
    if not covariance[0] > 0.0:
        return np.ones(1)
    covariance[0] *= 1.0 + 1e-6
    return np.concatenate([[1.0], -solve_toeplitz(covariance[:-1], covariance[1:])])


def delayed(x: FloatArray, operation: Operation, rows: int) -> FloatArray:
    """Return a response later by so many rows; before them it is the first value of its recording."""
    late = np.empty_like(x)
    for number in range(operation.starts.size):
        part = operation.rows_of(number)
        values = x[part]
        late[part] = np.concatenate([np.full(min(rows, values.size), values[0]), values[: max(values.size - rows, 0)]])
    return late


def squared_error(xx: FloatArray, xy: FloatArray, yy: FloatArray) -> FloatArray:
    """Return the least squared error over the gain, from sums of any shape."""
    return np.asarray(yy - np.where(xx > 1e-12, xy**2 / np.maximum(xx, 1e-12), 0.0))


def gain_of(xx: float, xy: float) -> float:
    """Return the gain of the least squared error."""
    return xy / xx if xx > 1e-12 else 0.0


def _basis(operation: Operation, lag: Lag, skipped: int) -> FloatArray:
    """Return what load and history can do in each window: constant, slope, decay; orthonormal, (3, N) array.

    The first rows of every window may be skipped: a filter of that length passes the three on, but not their jumps
    from window to window.
    """
    basis = np.zeros((3, operation.u.size))
    for first, end in operation.windows:
        known = np.isfinite(operation.y[first:end])
        if skipped:  # as far as a filter carries a reading that is not a number
            known = np.convolve(~known, np.ones(skipped + 1))[: known.size] == 0
            known[:skipped] = False
        t = np.arange(end - first, dtype=np.float64)[known]
        if t.size < 8:
            continue
        columns = [np.ones(t.size), t - t.mean()]
        if lag.lag_s > 0.5 * operation.dt_s:
            # a decay slower than a third of the window cannot be told from the slope
            columns.append(np.exp(-t * operation.dt_s / min(lag.lag_s, 0.3 * operation.dt_s * t.size)))
        q = np.linalg.qr(np.column_stack(columns))[0]
        basis[: q.shape[1], first + np.flatnonzero(known)] = q.T
    return basis
