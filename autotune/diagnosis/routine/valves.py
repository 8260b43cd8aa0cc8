"""Whether a faulty valve explains what no linear loop can: a test whose null is the same loop, linear.

The best one-step prediction of y in a linear loop is a linear function of the past of y and of u, whatever the
controller and the load are: a regression, which is consistent in a closed loop. A faulty valve shows where the past of
its position predicts y better than the past of the command does; its band is not known, so the best of a grid is
taken. How much the best of the grid gains by chance has no table (the band does not exist in a linear loop) and is
counted: the linear prediction with its own errors, each with a random sign, is searched in the same way many times.
What it gains there is also what a gain is measured from, not zero: the command knows what the controller read between
the rows and before the past that is seen, so that in a linear loop even the best valve may predict worse than it.
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
from scipy.stats import f

from autotune.arrays import FloatArray, IntArray
from autotune.diagnosis.routine.kernels import half_cycles, valve_position
from autotune.diagnosis.routine.operation import Operation
from autotune.diagnosis.routine.past import Past, basis_of, lags_of, means_of, past_of
from autotune.diagnosis.routine.thresholds import RoutineThresholds
from autotune.errors import InputError

#: Bands up to nearly the command's range, slip jumps as a share of the band, where a valve stood at first.
_BANDS, _WIDEST = 24, 0.98
_JUMPS, _BEGINS = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0), (-0.8, 0.0, 0.8)


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
        By how much the prediction by the valve's position is better, of the logarithm of the squared error, beyond
        what the best of all valves gains in the same loop with a linear one once in twenty times, and beyond what the
        same position explains a period late.
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
    records hold steps that no valve made. A load that steps between constant levels at irregular times cannot be told
    from a valve whose slips keep time with it; one that swings regularly is told by what it was a period ago.
    """
    past, random = past_of(operation, limits), np.random.default_rng(0)
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
    gain = float(_log_ratio(linear @ linear, squared[best].sum(), past.left @ past.left))
    by_chance = _log_ratio(total - by_command, total - gained, total)
    half_cycle = half_cycles(means_of(operation, past.every, operation.u), limits.least_band * span)
    drawn = _resampled(squared, half_cycle[past.rows], valves, limits.resamplings, random)
    position = position_of(operation, valves[best])
    brought = float(np.quantile(by_chance, 1.0 - limits.unlikely)) + _periodic(past, position, limits.unlikely)
    return ValveComparison(
        decrease=gain - brought,
        chance=float((1 + np.sum(by_chance >= gain)) / (1 + by_chance.size)),
        reversals=_turns(position, operation), valve=valves[best], band=_interval(valves[best].S, drawn[:, 0], span),
        jump=_interval(valves[best].J, drawn[:, 1], span), sticks=float(np.mean(drawn[:, 1] > 0.0)), span=span,
        t=(past.rows * past.every).astype(np.float64) * operation.dt_s, linear=linear, faulty=errors[best],
        position=position,
    )  # fmt: skip


def _periodic(past: Past, position: FloatArray, unlikely: float) -> float:
    """Return what the distance of a position from the command one period ago explains: of the logarithm of the error.

    A load that swings from outside is as well told by a valve that is a period late; one that sticks is not.

    Parameters
    ----------
    past : Past
        Rows that are predicted.
    position : (R,) array
        Position of a valve on the rows of the operation [u].
    unlikely : float
        What is explained by chance with this probability is none, by the F-test of a regression.
    """
    of, period = past.of, past.of.period_rows
    late = past.rows * past.every >= (period + past.order * past.every if np.isfinite(period) else np.inf)
    known = past.beside(of.u)
    ago = basis_of(lags_of(means_of(of, past.every, _late(position - of.u, of)), past.rows, past.order), past.own)
    without = np.column_stack([past.own, known])[late]
    both = np.column_stack([without, ago[late]])
    added, freedom = ago.shape[1], int(late.sum()) - both.shape[1]
    if added == 0 or freedom < past.order:
        return 0.0
    errors = [past.left[late] - x @ np.linalg.lstsq(x, past.left[late], rcond=None)[0] for x in (without, both)]
    sizes = np.array([e @ e for e in errors])
    by_chance = np.log1p(added / freedom * f.ppf(1.0 - unlikely, added, freedom))
    return max(float(_log_ratio(sizes[:1], sizes[1:], past.left @ past.left)[0] - by_chance), 0.0)


def _late(x: FloatArray, of: Operation) -> FloatArray:
    """Return a signal one period late in every recording; its first value holds until then."""
    rows = round(of.period_rows) if np.isfinite(of.period_rows) else 0
    parts = [x[of.rows_of(i)] for i in range(of.starts.size)]
    return np.concatenate([np.pad(part, (min(rows, part.size), 0), mode="edge")[: part.size] for part in parts])


def _turns(position: FloatArray, operation: Operation) -> int:
    """Return how often a position changes its direction, rest between two moves aside."""
    moves = (np.diff(position[operation.rows_of(i)]) for i in range(operation.starts.size))
    return sum(int(np.sum(np.diff(np.sign(one[one != 0.0])) != 0.0)) for one in moves)


def position_of(operation: Operation, valve: Valve) -> FloatArray:
    """Return a valve's position under the recorded command [u], (R,) array."""
    static, sliding = 0.5 * (valve.S + valve.J), 0.5 * (valve.S - valve.J)
    return np.asarray(valve_position(operation.u, operation.starts, static, sliding, valve.runs_on, valve.begins))


def _null(past: Past, space: FloatArray, linear: FloatArray, count: int, random: np.random.Generator) -> FloatArray:
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
