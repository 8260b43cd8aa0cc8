"""The compiled integration of a tape along a recording's rows.

Between two rows, and between the delayed changes of inputs, the right-hand side is smooth but for switched terms.
Their modes are held within a step, so that the method keeps its order; a step over which a switching function
changes sign is cut at the crossing. See :mod:`autotune.equations.switching` for what becomes of modes there, and
:mod:`autotune.equations.steps` for the methods.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from autotune.arrays import FloatArray, IntArray
from autotune.equations.in_place import COMPILED, in_place
from autotune.equations.steps import next_step, trial
from autotune.equations.switching import begin_locating, crossing, field_in_row, located, settle
from autotune.equations.tape_ops import evaluate
from autotune.equations.work import CROSSINGS, ROW, STEP, STEPS, Tape, Work, begin, copy, halve, new_work

#: Why a window ended: as asked; a derivative that is no number; more steps or a larger state than is sensible.
DONE, NOT_A_NUMBER, TOO_MANY_STEPS = 0, 1, 2
MOST_STEPS = 20_000  # between two rows
MOST_ON_AVERAGE = 200  # between two rows, over a window: else one fit of a chattering model would take hours
SPARE_STEPS = 400_000  # may be taken ahead of that average: a few hard places are carried through
MOST_CROSSINGS = 100  # located between two rows; further ones are taken at the end of their steps
_LOCATED = 1e-9  # of the time between rows: how closely a crossing is located
_LARGEST = 1e15  # a state beyond runs away


@in_place(inline="always")
def _advance(p: Tape, w: Work, x: FloatArray, t: float, end: float, span: float, tolerance: float) -> int:
    """Carry x from t to end, in place; span is the time between rows. Returns why it ended."""
    if p.switches.size > 0:
        settle(p, w, x, t)
    else:
        w.memory[ROW] = 0.0
        field_in_row(p, w, x, t)
    new_point = True
    locating, low, high = False, 0.0, 0.0  # while a crossing is located: a step before it and one beyond it
    side, slow, width = 0, 0, 0.0  # where the last one tried lay, how often the bracket did not halve, and from what
    close = _LOCATED * span
    while end - t > 1e-12 * span:
        h = min(w.memory[STEP], end - t) if w.memory[STEP] > 0.0 else end - t
        if end - t - h < 0.1 * h:
            h = end - t
        if locating:
            h = located(w, low, high, close, side, slow >= 2) if high - low > close else high
            slow = 0 if slow >= 2 else slow
        w.memory[STEPS] += 1.0
        if w.memory[STEPS] > MOST_STEPS:
            return TOO_MANY_STEPS
        error = trial(p, w, x, t, h, tolerance, new_point)
        new_point = False
        switched = p.switches.size > 0 and w.memory[CROSSINGS] < MOST_CROSSINGS
        crossed = switched and (error <= 1.0 or np.isnan(error)) and crossing(p, w)
        if not error <= 1.0 and not crossed:
            next_step(w, error, h)
            locating = False
            if w.memory[STEP] < 1e-13 * span:
                return NOT_A_NUMBER
            continue
        if switched:
            if crossed and not locating:
                low, high, locating, side, slow = 0.0, h, True, 0, 0
                if high - low > close:
                    begin_locating(p, w, x, t)
                    continue
            elif locating and h < high:
                # false position with Illinois' remedy: the end that stays counts half
                width = high - low
                if crossed:
                    high = h
                    copy(w.over, w.beyond)
                    if side == 1:
                        halve(w.before)
                else:
                    low = h
                    copy(w.over, w.before)
                    if side == -1:
                        halve(w.beyond)
                side = 1 if crossed else -1
                slow = slow + 1 if high - low > 0.5 * width else 0
                if not crossed or high - low > close:
                    continue
        t += h
        for i in range(p.n):
            x[i], w.K[0, i] = w.y[i], w.K[6, i]
            w.seen[i] = max(w.seen[i], abs(x[i]))
            if not abs(x[i]) < _LARGEST:
                return NOT_A_NUMBER
        new_point = True
        if locating:
            w.memory[CROSSINGS] += 1.0
        else:
            next_step(w, error, h)
        if locating or (p.switches.size > 0 and w.memory[CROSSINGS] >= MOST_CROSSINGS):
            locating = False
            settle(p, w, x, t)
    return DONE


@in_place(inline="always")
def _inputs(
    p: Tape, w: Work, times: FloatArray, columns: FloatArray, delays: FloatArray, at: IntArray, now: float, close: float
) -> float:
    """Bring every input's row up to now, and return when the next one changes."""
    following = np.inf
    last = times.size - 1
    w.since[0] = now - times[0]
    for j in range(p.linear.size):
        while at[j] < last and times[at[j] + 1] + delays[j] <= now + close:
            at[j] += 1
        k = at[j]
        w.base[j], w.ramp[j] = columns[k, j], 0.0
        if k < last:
            following = min(following, times[k + 1] + delays[j])
            begun = now - (times[k] + delays[j])
            if p.linear[j] and begun > -close:
                w.ramp[j] = (columns[k + 1, j] - columns[k, j]) / (times[k + 1] - times[k])
                w.base[j] += w.ramp[j] * begun
            elif p.linear[j]:  # the delayed column has not begun: its first value holds
                following = min(following, times[k] + delays[j])
    return following


@in_place(inline="always")
def _to_next_row(
    p: Tape, w: Work, x: FloatArray, times: FloatArray, columns: FloatArray, delays: FloatArray, at: IntArray,
    row: int, close: float, tolerance: float,
) -> tuple[int, float]:  # fmt: skip
    """Carry x from a row to the next through all changes of inputs; returns why it ended and when."""
    t, following = times[row], times[row + 1]
    span = following - t
    w.memory[STEPS], w.memory[CROSSINGS] = 0.0, 0.0
    while following - t > close:
        change = _inputs(p, w, times, columns, delays, at, t, close)
        end = following if change > following - close else change
        ended = _advance(p, w, x, t - times[0], end - times[0], span, tolerance)
        if ended != DONE:
            return ended, t
        w.memory[ROW] = 0.0
        field_in_row(p, w, x, end - times[0])
        t = end
    return DONE, following


@in_place
def _row_before(times: FloatArray, t: float) -> int:
    """Return the last row that comes before a time, -1 where there is none."""
    low, high = 0, times.size
    while low < high:
        middle = (low + high) // 2
        if times[middle] < t:
            low = middle + 1
        else:
            high = middle
    return low - 1


@in_place
def _integrate(
    p: Tape, w: Work, times: FloatArray, columns: FloatArray, delays: FloatArray, start: int, stop: int, x0: FloatArray,
    tolerance: float, most: float, spare: float, out: FloatArray, ends: FloatArray, status: FloatArray, window: int,
    x: FloatArray, at: IntArray,
) -> None:  # fmt: skip
    """Integrate one window; ``x`` and ``at`` are room for the state and for every input's row."""
    close = 1e-9 * (times[-1] - times[0]) / max(times.size - 1, 1)
    begin(p, w, x0, window, x)
    t = times[start]
    for j in range(p.linear.size):
        at[j] = max(_row_before(times, t - delays[j] - close), 0)
    # a row's reading sees the inputs as they were before its command acts
    _inputs(p, w, times, columns, delays, at, t - 3.0 * close, close)
    settle(p, w, x, t - times[0])
    status[window, 0], status[window, 1] = DONE, t
    for row in range(start, stop):
        evaluate(p.code, p.dynamic, p.code.shape[0], w.r, False)
        for q in range(p.outputs.size):
            out[q, row] = w.r[p.outputs[q]]
        if row + 1 >= times.size:
            break
        ended, t = _to_next_row(p, w, x, times, columns, delays, at, row, close, tolerance)
        status[window, 2] += w.memory[STEPS]
        spare += most - w.memory[STEPS]
        if ended == DONE and spare < 0.0:
            ended = TOO_MANY_STEPS
        if ended != DONE:
            status[window, 0], status[window, 1] = ended, t
            break
    for i in range(p.n):
        ends[window, i] = x[i]


@njit(**COMPILED)
def run(
    p: Tape, template: FloatArray, parameters: FloatArray, times: FloatArray, columns: FloatArray, delays: FloatArray,
    starts: IntArray, stops: IntArray, x0: FloatArray, tolerance: float, most: float, spare: float,
    out: FloatArray, ends: FloatArray, status: FloatArray,
) -> None:  # fmt: skip
    """Integrate every window and write outputs at its rows, its end state, and how it ended.

    ``most`` bounds the steps between two rows on average, all but ``spare`` of a window's. ``out`` is (q, N);
    ``ends`` (W, n) receives the state at each window's stop row (or at the last row); ``status`` (W, 3) the reason and
    the time of the end, and the steps taken.

    Parameters
    ----------
    p : Tape
        The program, n states, m inputs, q outputs.
    template : array
        Registers with the program's constants.
    parameters : (P,) array
        In their own units.
    times : (N,) array
        Stamps of the rows [s].
    columns : (N, m) array
        The inputs at the rows.
    delays : (m,) array
        Dead time of each input [s].
    starts, stops : (W,) array of int
        First row of every window, and the row before which it ends.
    x0 : (W, n) array
        Start states.
    tolerance : float
        Relative error of a step.
    most, spare : float
        Most steps between two rows on average, all but the spare ones of a window.
    out : (q, N) array
        Receives the outputs.
    ends : (W, n) array
        Receives the state at each window's stop row, or at the last row.
    status : (W, 3) array
        Receives the reason and the time of the end, and the steps taken.
    """
    w = new_work(p, template, parameters)
    x, at = np.zeros(p.n), np.zeros(p.linear.size, dtype=np.int64)
    for window in range(starts.size):
        _integrate(
            p, w, times, columns, delays, starts[window], stops[window], x0, tolerance, most, spare, out, ends, status,
            window, x, at,
        )  # fmt: skip


@njit(**COMPILED)
def look(
    p: Tape, template: FloatArray, parameters: FloatArray, states: FloatArray, inputs: FloatArray, t: float
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives and outputs at points of states and inputs.

    Parameters
    ----------
    p : Tape
        The program, n states, m inputs, q outputs.
    template : array
        Registers with the program's constants.
    parameters : (P,) array
        In their own units.
    states : (K, n) array
        At K points.
    inputs : (K, m) array
        At the same.
    t : float
        Time [s].

    Returns
    -------
    tuple of array
        Derivatives, (K, n), and outputs, (K, q).
    """
    w = new_work(p, template, parameters)
    points = states.shape[0]
    found, y, x = np.zeros((points, p.n)), np.zeros((points, p.outputs.size)), np.zeros(p.n)
    for i in range(points):
        begin(p, w, states, i, x)
        for j in range(p.linear.size):
            w.base[j] = inputs[i, j]
        settle(p, w, x, t)
        evaluate(p.code, p.dynamic, p.code.shape[0], w.r, False)
        for j in range(p.n):
            found[i, j] = w.K[0, j]
        for q in range(p.outputs.size):
            y[i, q] = w.r[p.outputs[q]]
    return found, y
