"""Where equations rest, and how large their states are: the same answers whatever units a model is written in."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from autotune.arrays import FloatArray
from autotune.equations.simulate import Compiled, Drive, derivatives, simulate

#: What of a state's size, or of its answer to the command, is rounding.
_ROUNDING = 1e-9
#: How much more the reading counts than rest where both cannot be had.
_READING = 1e3


def stated_starts(compiled: Compiled) -> FloatArray:
    """Return the start value that the file states for each state, NaN where it is to be estimated, shape (n,)."""
    known = {one.name: one.start for one in compiled.model.states}
    values = [known.get(name) for name in compiled.states]
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def input_sizes(compiled: Compiled, inputs: FloatArray) -> FloatArray:
    """Return how large inputs typically are: their values or offsets, 1 where both are 0.

    Parameters
    ----------
    compiled : Compiled
        The model, m inputs.
    inputs : (m,) array
        Their values.
    """
    sizes = np.maximum(np.abs(inputs), [abs(one.offset) for one in compiled.model.inputs])
    return np.where(sizes > 0.0, sizes, 1.0)


def typical_sizes(
    compiled: Compiled, parameters: FloatArray, inputs: FloatArray, states: FloatArray, kick: FloatArray | None = None
) -> tuple[FloatArray, float]:
    """Return how large each state is in its own unit, and the time in which the fastest of them moves by as much.

    Parameters
    ----------
    compiled, parameters
        The model.
    inputs, states : (m,), (n,) arrays
        Where.
    kick : (m,) array, optional
        Change of the inputs that tells a size where nothing moves; by default :func:`input_sizes`.

    Returns
    -------
    sizes : (n,) array
        What a state is and how far it moves from there; where that is nothing, how far a change of the inputs moves it.
        0 for a state that nothing moves.
    time_s : float
        The time [s].

    Notes
    -----
    Each state makes one of Euler's steps when something first moves it: that reaches all, and scales with their units.
    """
    kicked = _kicked(inputs, input_sizes(compiled, inputs) if kick is None else kick)
    time_s, sizes = 1.0, np.abs(states)
    for _ in range(3):
        moves = _first_moves(compiled, parameters, inputs, states, time_s)
        sizes = _unless_rounding(
            np.maximum(np.abs(states), moves), _first_moves(compiled, parameters, kicked, states, time_s)
        )
        rate = _fastest_rate(compiled, parameters, inputs, states, sizes)
        if not rate > 0.0:
            break
        time_s = 1.0 / rate
    return sizes, time_s


def _kicked(inputs: FloatArray, kick: FloatArray) -> FloatArray:
    """Return inputs further from zero."""
    return inputs + np.copysign(kick, inputs)


def _first_moves(
    compiled: Compiled, parameters: FloatArray, inputs: FloatArray, states: FloatArray, time_s: float
) -> FloatArray:
    """Return how far each state gets in the first of Euler's steps that moves it."""
    moves = np.zeros(states.size)
    for _ in range(states.size):
        slopes = derivatives(compiled, parameters, (states + moves)[None, :], inputs[None, :])[0][0]
        new = np.where((moves == 0.0) & np.isfinite(slopes), time_s * slopes, 0.0)
        if not np.any(new):
            break
        moves = moves + new
    return np.abs(moves)


def _unless_rounding(sizes: FloatArray, answer: FloatArray) -> FloatArray:
    """Return sizes, in place of those that are rounding against what a change of the inputs makes of a state this."""
    return np.where(sizes > _ROUNDING * answer, sizes, answer)


def _fastest_rate(
    compiled: Compiled, parameters: FloatArray, inputs: FloatArray, states: FloatArray, sizes: FloatArray
) -> float:
    """Return the largest rate at which a change of all states by their sizes would undo itself [1/s]."""
    points = np.concatenate([states[None, :], states + np.diag(sizes)])
    slopes = derivatives(compiled, parameters, points, np.tile(inputs, (points.shape[0], 1)))[0]
    with np.errstate(invalid="ignore"):  # equations may have no value there: a gap of zero under a magnet
        moves = np.nansum(np.abs(slopes[1:] - slopes[0]), axis=0)
    felt = (sizes > 0.0) & np.isfinite(moves)
    return float(np.max(moves[felt] / sizes[felt], initial=0.0))


def rest_state(compiled: Compiled, parameters: FloatArray, inputs: FloatArray, y: float) -> FloatArray:
    """Return the state nearest to rest that reads y under inputs.

    Parameters
    ----------
    compiled, parameters
        The model.
    inputs : (m,) array
        What drives it.
    y : float
        The reading; NaN leaves it out.

    Returns
    -------
    (n,) array
        States that the file gives a start are left there.

    Notes
    -----
    Least squares from a few starts, in the states' own sizes; of several rests (a pendulum hangs or stands) the one
    nearest to zero is found.
    """
    given = stated_starts(compiled)
    free = np.flatnonzero(~np.isfinite(given))
    base = np.where(np.isfinite(given), given, 0.0)
    if free.size == 0:
        return base
    sizes, _ = typical_sizes(compiled, parameters, inputs, base)
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    seen, off = _in_reading(compiled, parameters, inputs, base, sizes, y)
    seen[~np.isin(np.arange(base.size), free)] = 0.0
    largest = float(np.max(np.abs(seen), initial=0.0))
    if abs(off) > largest > 0.0:
        # no state is as large as the reading says: those that it shows are
        sizes = np.where(np.abs(seen) > _ROUNDING * largest, sizes * abs(off) / largest, sizes)
        seen = np.where(np.abs(seen) > _ROUNDING * largest, seen * abs(off) / largest, seen)
    towards = off * seen / max(float(seen @ seen), 1e-300)
    moves = _weighed_moves(compiled, parameters, inputs, base, sizes, base + sizes * towards)
    reading = max(float(np.max(np.abs(seen), initial=0.0)), abs(off)) or 1.0

    def point(z: FloatArray) -> FloatArray:
        x = base.copy()
        x[free] += sizes[free] * z
        return x

    def misses(z: FloatArray) -> FloatArray:
        slopes, outputs = derivatives(compiled, parameters, point(z)[None, :], inputs[None, :])
        wrong = (outputs[0, 0] - y) / reading if np.isfinite(y) else 0.0
        found = np.append(slopes[0] / moves, _READING * wrong)
        return np.where(np.isfinite(found), np.clip(found, -1e12, 1e12), 1e12)

    tries = [np.zeros(free.size), towards[free], np.ones(free.size)]
    # MINPACK's conditions know no units, and it may begin where nothing is missed; its slopes count as evaluations
    calls = 60 * (free.size + 1)
    results = [least_squares(misses, z, method="lm", x_scale=np.maximum(np.abs(z), 1.0), max_nfev=calls) for z in tries]
    least = 1e-12 * max(0.5 * float(np.sum(misses(z) ** 2)) for z in tries) + 1e-300
    best = min(results, key=lambda result: (round(float(np.log10(result.cost + least)), 1), float(result.x @ result.x)))
    return point(np.asarray(best.x, dtype=np.float64))


def _weighed_moves(
    compiled: Compiled, parameters: FloatArray, inputs: FloatArray, base: FloatArray, sizes: FloatArray,
    reading: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return the slopes, (n,) [1/s], that weigh as much as one another where a rest and the reading cannot be had both.

    What each state does in a second; all of them so much larger that the state with the reading counts for more.
    """
    kicked = _kicked(inputs, input_sizes(compiled, inputs))
    moves = _unless_rounding(
        _first_moves(compiled, parameters, inputs, base, 1.0), _first_moves(compiled, parameters, kicked, base, 1.0)
    )
    moves = np.where(moves > 0.0, moves, sizes)
    slopes = derivatives(compiled, parameters, reading[None, :], inputs[None, :])[0][0]
    ratios = np.abs(slopes) / moves
    return moves * float(np.max(ratios[np.isfinite(ratios)], initial=1.0))


def _in_reading(
    compiled: Compiled, parameters: FloatArray, inputs: FloatArray, states: FloatArray, sizes: FloatArray, y: float
) -> tuple[FloatArray, float]:
    """Return what the size of each state makes of the reading, (n,), and how far this is from y, 0 where y is NaN."""
    points = np.concatenate([states[None, :], states + np.diag(sizes)])
    outputs = derivatives(compiled, parameters, points, np.tile(inputs, (points.shape[0], 1)))[1][:, 0]
    seen = np.nan_to_num(outputs[1:] - outputs[0], nan=0.0, posinf=0.0, neginf=0.0)
    off = float(y - outputs[0])
    return seen, off if np.isfinite(off) else 0.0


def state_scales(compiled: Compiled, parameters: FloatArray, drive: Drive, start: FloatArray) -> FloatArray:
    """Return how large each state typically is: what a change of it is measured by.

    Parameters
    ----------
    compiled : Compiled
        n states.
    parameters : (P,) array
        In their own units.
    drive : Drive
        The recording's inputs.
    start : (n,) array
        State at the first row.

    Returns
    -------
    (n,) array
        Sizes, in the states' units.
    """
    probe = np.linspace(0, drive.t.size - 1, min(drive.t.size, 400)).astype(np.int64)[:-1]
    states = np.repeat(start[None, :], probe.size, axis=0)
    run = simulate(compiled, parameters, drive, states, starts=probe, stops=probe + 1)
    ends = run.ends[np.all(np.isfinite(run.ends), axis=1)]
    whole = simulate(compiled, parameters, drive, start[None, :])
    size = np.maximum(np.abs(start), np.abs(whole.ends[0]) if whole.is_complete else 0.0)
    if ends.size:
        slopes = np.max(np.abs(ends - start), axis=0) / float(np.median(np.diff(drive.t)))
        # a fast state comes nowhere near what its slope would make of it in a second
        size = np.maximum(size, np.where(size > 0.0, np.minimum(slopes, 1e6 * size), slopes))
    largest = np.max(np.abs(drive.inputs), axis=0, initial=0.0)
    answer, _ = typical_sizes(compiled, parameters, drive.inputs[0], start, input_sizes(compiled, largest))
    size = _unless_rounding(size, answer)
    return np.where(size > 0.0, size, 1.0)
