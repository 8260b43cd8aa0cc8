"""Whether a faulty valve explains what no linear loop can: a test whose null is the same loop, linear.

The best one-step prediction of y in a linear loop is a linear function of the past of y and of u, whatever the
controller and the load are: a regression, which is consistent in a closed loop. A faulty valve shows where the past of
its position predicts y better than the past of the command does; its band is not known, so the best of a grid is
taken. How much the best of the grid gains by chance has no table (the band does not exist in a linear loop) and is
counted: the linear prediction with its own errors, each with a random sign, is searched in the same way many times.
A sine of the dominant period is in both predictions: what swings a loop from outside is not predictable from a short
past with noise on it, and would be laid to a valve that keeps time with it.

Nothing is cut into stretches: every slip of the valve that the linear prediction misses and the valve's does not adds
to the evidence, and rest between slips adds nothing.

References
----------
Hansen, Inference when a nuisance parameter is not identified under the null hypothesis, Econometrica 64, 1996.
Ljung, System Identification, 2nd ed. 1999, section 13.4: prediction errors in a closed loop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.routine.kernels import half_cycles, valve_position
from autotune.diagnosis.routine.operation import Operation
from autotune.diagnosis.routine.thresholds import RoutineThresholds
from autotune.errors import InputError

#: Bands up to nearly the command's range, slip jumps as a share of the band, where a valve stood at first.
_BANDS, _WIDEST = 24, 0.98
_JUMPS, _BEGINS = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0), (-0.8, 0.0, 0.8)
#: Directions of the past below this share of the largest are rounding: a controller without noise ties u to y.
_ROUNDING = 1e-7


class Valve(NamedTuple):
    """A valve: dead and stick band S [u], slip jump J [u], whether it runs on, where it begins as a share of S."""

    S: float
    J: float
    runs_on: bool
    begins: float


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, kw_only=True, eq=False)
class ValveComparison:
    """The best faulty valve against a linear one.

    Attributes
    ----------
    decrease : float
        Logarithm of the squared error of the linear prediction over that of the prediction by the valve's position.
    chance : float
        Probability that the best of all valves gains as much in the same loop with a linear one.
    reversals : int
        Turns of the best valve's position: what has not turned has shown nothing of its band.
    valve : Valve
        The best one.
    band, jump : Interval
        S and J [u]; resampled over the half cycles between the reversals.
    sticks : float
        Share of the resamplings in which a valve that sticks (J > 0) is the best.
    span : float
        Range of the command without its rarest rows [u].
    t : (N,) array
        Times of the predicted rows from the first recording's start, later recordings after it [s].
    linear, faulty : (N,) array
        Errors of the two predictions [y].
    position : (R,) array
        Position of the best valve on the rows of the operation [u].
    """

    decrease: float
    chance: float
    reversals: int
    valve: Valve
    band: Interval
    jump: Interval
    sticks: float
    span: float
    t: FloatArray
    linear: FloatArray
    faulty: FloatArray
    position: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Past:
    """Rows of y that are predicted, and what a level, a sine and y's own past say of them.

    Attributes
    ----------
    of : Operation
        The recordings.
    every : int
        Rows of the operation in each mean.
    order : int
        Means that a prediction sees.
    rows : (N,) array of int
        Means that are predicted.
    own : (N, K) array
        Orthonormal basis of the levels, a sine of the dominant period and y's own past.
    left : (N,) array
        What the basis leaves of y.
    """

    of: Operation
    every: int
    order: int
    rows: IntArray
    own: FloatArray
    left: FloatArray

    def beside(self, x: FloatArray) -> FloatArray:
        """Return an orthonormal basis of what the past of a signal adds, (N, order) array or less."""
        lags = _lags(_means(self.of, self.every, x), self.rows, self.order)
        return _basis(lags, self.own)


def compare_valves(
    operation: Operation, limits: RoutineThresholds, progress: Callable[[float], None] = lambda share: None
) -> ValveComparison:
    """Compare predictions by the position of the best faulty valve with the linear ones.

    Parameters
    ----------
    operation : Operation
        The recordings.
    limits : RoutineThresholds
        Least band, order and rows of the predictions, resamplings.
    progress : callable
        Told which share is done.

    Raises
    ------
    InputError
        Hardly a row of y that has a past to predict it by, or of u that is not at rest.

    Notes
    -----
    Bias: a valve whose band is less than a tenth of the command's range is not looked for; quantised or compressed
    records hold steps that no valve made. A load that is not Gaussian and swings at a constant size cannot be told
    from a valve whose slips keep time with it.
    """
    past, random = _past(operation, limits), np.random.default_rng(0)
    low, high = np.quantile(operation.u, (0.002, 0.998))
    span = float(high - low)
    if not span > 0.0:
        raise InputError(
            "u rests in all but its rarest rows: a valve that is not moved shows nothing",
            where=", ".join(operation.names), remedy="give a record of the loop in automatic mode",
        )  # fmt: skip
    valves = list(_valves(span, limits.least_band))
    space = past.beside(operation.u)
    linear = past.left - space @ (space.T @ past.left)
    null = _null(past, space, linear, limits.resamplings, random)
    errors, gained = np.empty((len(valves), linear.size)), np.zeros(limits.resamplings)
    total = np.einsum("bn,bn->b", null, null)
    by_command = ((null @ space) ** 2).sum(1)
    for number, valve in enumerate(valves):
        if number % 50 == 0:
            progress(number / len(valves))
        space = past.beside(position_of(operation, valve))
        errors[number] = past.left - space @ (space.T @ past.left)
        gained = np.maximum(gained, ((null @ space) ** 2).sum(1))
    squared = errors**2
    best = int(np.argmin(squared.sum(1)))
    decrease = float(_log_ratio(linear @ linear, squared[best].sum(), past.left @ past.left))
    by_chance = _log_ratio(total - by_command, total - gained, total)
    half_cycle = half_cycles(_means(operation, past.every, operation.u), limits.least_band * span)
    drawn = _resampled(squared, half_cycle[past.rows], valves, limits.resamplings, random)
    position = position_of(operation, valves[best])
    return ValveComparison(
        decrease=decrease, chance=float((1 + np.sum(by_chance >= decrease)) / (1 + by_chance.size)),
        reversals=_turns(position, operation), valve=valves[best], band=_interval(valves[best].S, drawn[:, 0], span),
        jump=_interval(valves[best].J, drawn[:, 1], span), sticks=float(np.mean(drawn[:, 1] > 0.0)), span=span,
        t=(past.rows * past.every).astype(np.float64) * operation.dt_s, linear=linear, faulty=errors[best],
        position=position,
    )  # fmt: skip


def _turns(position: FloatArray, operation: Operation) -> int:
    """Return how often a position changes its direction, rest between two moves aside."""
    moves = (np.diff(position[operation.rows_of(i)]) for i in range(operation.starts.size))
    return sum(int(np.sum(np.diff(np.sign(one[one != 0.0])) != 0.0)) for one in moves)


def position_of(operation: Operation, valve: Valve) -> FloatArray:
    """Return a valve's position under the recorded command [u], (R,) array."""
    static, sliding = 0.5 * (valve.S + valve.J), 0.5 * (valve.S - valve.J)
    return np.asarray(valve_position(operation.u, operation.starts, static, sliding, valve.runs_on, valve.begins))


def _past(operation: Operation, limits: RoutineThresholds) -> _Past:
    period, order = operation.period_rows, limits.order
    every = max(1, int(period / limits.predicted_per_period)) if np.isfinite(period) else 1
    lengths = np.diff(np.append(operation.starts, operation.u.size)) // every
    recording = np.repeat(np.arange(lengths.size), lengths)
    y = _means(operation, every, operation.y)
    rows = np.flatnonzero(np.arange(y.size) - (np.cumsum(lengths) - lengths)[recording] >= order)
    there = np.isfinite(y)
    rows = rows[there[rows] & (2 * _lags(there, rows, order).sum(1) >= order)]
    if rows.size < 6 * order:
        raise InputError(
            f"y can be predicted in {rows.size} place(s) only", where=", ".join(operation.names),
            remedy="give a longer record, or one in which less of y is missing",
        )  # fmt: skip
    y = y[np.maximum.accumulate(np.where(there, np.arange(y.size), int(np.argmax(there))))]  # what is missing is held
    inside = (recording[rows, None] == np.arange(lengths.size)).astype(np.float64)
    levels = _basis(inside, np.empty((rows.size, 0)))
    own = np.column_stack([levels, _basis(_sines(rows * every, inside, period), levels)])
    own = np.column_stack([own, _basis(_lags(y, rows, order), own)])
    target = y[rows] - levels @ (levels.T @ y[rows])
    return _Past(of=operation, every=every, order=order, rows=rows, own=own, left=target - own @ (own.T @ target))


def _sines(rows: IntArray, inside: FloatArray, period: float) -> FloatArray:
    """Return sine and cosine of the dominant period for every recording, whose phases differ, (N, 2 R) array."""
    if not np.isfinite(period):
        return np.empty((rows.size, 0))
    angle = 2.0 * np.pi * rows[:, None] / period
    return np.column_stack([np.cos(angle) * inside, np.sin(angle) * inside])


def _means(operation: Operation, every: int, x: FloatArray) -> FloatArray:
    """Return means of so many rows, none across the end of a recording."""
    parts = [x[operation.rows_of(i)] for i in range(operation.starts.size)]
    return np.concatenate([part[: part.size // every * every].reshape(-1, every).mean(1) for part in parts])


def _lags(x: FloatArray | BoolArray, rows: IntArray, order: int) -> FloatArray:
    return np.asarray(x[rows[:, None] - np.arange(1, order + 1)])


def _basis(columns: FloatArray, beside: FloatArray) -> FloatArray:
    """Return an orthonormal basis of what columns add to a basis; directions of rounding are left out."""
    size = np.linalg.norm(columns - columns.mean(0), axis=0) if beside.size else np.linalg.norm(columns, axis=0)
    scaled = columns / np.maximum(size, 1e-300)
    for _ in range(2):  # twice: a controller without noise ties u to y, and what is left is small
        scaled = scaled - beside @ (beside.T @ scaled)
    left, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(left[:, sizes > _ROUNDING])


def _null(past: _Past, space: FloatArray, linear: FloatArray, count: int, random: np.random.Generator) -> FloatArray:
    """Return what y's own past leaves of a linear loop's y: its prediction, and its errors of random sign."""
    fitted = past.own.shape[1] + space.shape[1]
    errors = linear * np.sqrt(linear.size / max(linear.size - fitted, 1))  # as large as before they were fitted to
    drawn = random.choice([-1.0, 1.0], size=(count, linear.size)) * errors
    drawn -= (drawn @ past.own) @ past.own.T
    return np.asarray(past.left - linear + drawn)


def _log_ratio(first: FloatArray, second: FloatArray, total: FloatArray) -> FloatArray:
    """Return the logarithm of a squared error over another; less than rounding leaves of the total counts as that."""
    least = 1e-20 * total + 1e-300
    return np.asarray(np.log(np.maximum(first, least) / np.maximum(second, least)))


def _valves(span: float, least: float) -> Iterator[Valve]:
    for share, jump in product(np.geomspace(least, _WIDEST, _BANDS), _JUMPS):
        for runs_on, begins in product((False, True) if jump else (False,), _BEGINS if share > 0.4 else (0.0,)):
            yield Valve(float(share) * span, float(share) * span * jump, runs_on, begins)


def _resampled(
    squared: FloatArray, half_cycle: IntArray, valves: list[Valve], count: int, random: np.random.Generator
) -> FloatArray:
    """Return S and J of the best valve for every resampling of the half cycles, (B, 2) array."""
    inside, number = np.unique(half_cycle, return_inverse=True)
    sums = squared @ (number[:, None] == np.arange(inside.size)).astype(np.float64)
    counts = random.multinomial(inside.size, np.full(inside.size, 1.0 / inside.size), size=count)
    best = np.argmin(sums @ counts.T, axis=0)
    return np.array([valves[int(i)][:2] for i in best])


def _interval(value: float, drawn: FloatArray, span: float) -> Interval:
    low, high = (float(q) for q in np.quantile(drawn, (0.025, 0.975)))
    step = 0.03 * span  # of the grid, on average
    return Interval(value=value, low=max(min(low, value) - step, 0.0), high=max(high, value) + step)
