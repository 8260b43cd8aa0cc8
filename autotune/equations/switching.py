"""Switched terms along an integration: modes that hold within a step, crossings, and sliding on a surface.

Where both sides of a switching function's zero lead back to it (dry friction at rest, a rate limiter that has caught
up) the state slides there with Filippov's convex combination: friction sticks, exactly.

References
----------
A. F. Filippov, Differential Equations with Discontinuous Righthand Sides, Kluwer, 1988, ch. 2.
"""

from __future__ import annotations

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.in_place import in_place
from autotune.equations.native import call
from autotune.equations.tape_ops import evaluate, solve, tangents
from autotune.equations.work import ROW, Tape, Work, copy

_SURFACE = 1e-11  # of a switching function's largest value: as good as zero
_NEAR = 1e-6  # likewise, for a state that slides already


@in_place(inline="always")
def _evaluate_slopes(p: Tape, w: Work, row: int) -> None:
    r, K, slopes = w.r, w.K, p.slopes
    extended = 0 < row < 6  # rows 0 and 6 of K are ends of steps, the others stages
    if p.native != 0:
        call(p.native, r, extended)
    else:
        evaluate(p.code, p.still, p.dynamic, r, extended)
    for i in range(p.n):
        K[row, i] = r[slopes[i]]


@in_place
def _speeds_of_switches(p: Tape, w: Work) -> None:
    """Find how fast each switching function runs along the field in the filled row of K, modes fixed."""
    row = int(w.memory[ROW])
    w.d[0] = 1.0
    for i in range(p.n):
        w.d[1 + i] = w.K[row, i]
    for j in range(w.ramp.size):
        w.d[1 + p.n + j] = w.ramp[j]
    tangents(p.speeds, 0, p.speeds.shape[0], w.r, w.d)
    for k in range(p.switches.size):
        w.g_dot[k] = w.d[p.switches[k]]


@in_place(inline="always")
def field(p: Tape, w: Work, x: FloatArray, t: float, row: int) -> None:
    """Evaluate the derivatives into a row of K; modes of sliding switches keep the state on the surface.

    Parameters
    ----------
    p : Tape
        The program.
    w : Work
        What is written on.
    x : (n,) array
        State.
    t : float
        Time [s].
    row : int
        Of K.
    """
    r, base, ramp, n = w.r, w.base, w.ramp, p.n
    begun = t - w.since[0]
    r[0] = t
    for i in range(n):
        r[1 + i] = x[i]
    for j in range(base.size):
        r[1 + n + j] = base[j] + ramp[j] * begun
    count = 0
    for k in range(p.switches.size):
        if w.sliding[k]:
            r[p.modes[k]] = 0.0
            count += 1
    _evaluate_slopes(p, w, row)
    w.memory[ROW] = row
    if count > 0:
        _slide(p, w, count)


@in_place
def field_in_row(p: Tape, w: Work, x: FloatArray, t: float) -> None:
    """Do as :func:`field`, into the row that the memory names: a call, where time does not count.

    Parameters
    ----------
    p : Tape
        The program.
    w : Work
        What is written on.
    x : (n,) array
        State.
    t : float
        Time [s].
    """
    field(p, w, x, t, int(w.memory[ROW]))


@in_place
def _slide(p: Tape, w: Work, count: int) -> None:
    """Find the modes that keep sliding switches still: their speeds are linear in the modes."""
    at = int(w.memory[ROW])
    _speeds_of_switches(p, w)
    row = 0
    for k in range(p.switches.size):
        if w.sliding[k]:
            w.b[row] = -w.g_dot[k]
            row += 1
    column = 0
    for k in range(p.switches.size):
        if not w.sliding[k]:
            continue
        w.r[p.modes[k]] = 1.0
        _evaluate_slopes(p, w, at)
        _speeds_of_switches(p, w)
        w.r[p.modes[k]] = 0.0
        row = 0
        for other in range(p.switches.size):
            if w.sliding[other]:
                w.A[row, column] = w.g_dot[other] + w.b[row]
                row += 1
        column += 1
    solve(w.A, w.b, count)
    row = 0
    for k in range(p.switches.size):
        if w.sliding[k]:
            w.r[p.modes[k]] = w.b[row]
            row += 1
    _evaluate_slopes(p, w, at)


@in_place
def settle(p: Tape, w: Work, x: FloatArray, t: float) -> None:
    """Set every switch's mode for the state and inputs of now, one side or sliding, and the field in K[0].

    Parameters
    ----------
    p : Tape
        The program.
    w : Work
        What is written on.
    x : (n,) array
        State.
    t : float
        Time [s].
    """
    for _ in range(3):
        changed = False
        for k in range(p.switches.size):
            w.memory[ROW] = 5.0
            field_in_row(p, w, x, t)  # as a stage: just beyond the edge of a root its mode is not changed yet
            g, mode = w.r[p.switches[k]] - w.zero[k], w.r[p.modes[k]]
            w.largest[k] = max(w.largest[k], abs(g))
            near = abs(g) <= _NEAR * w.largest[k]
            slid = w.sliding[k]
            if slid and near and abs(mode) <= 1.0:
                continue
            w.sliding[k] = 0
            if w.crossed[k] or abs(g) <= _SURFACE * w.largest[k] or (slid and near):
                _choose(p, w, x, t, k, mode, g)
            else:
                w.r[p.modes[k]] = 1.0 if g > 0.0 else -1.0
                w.zero[k] = 0.0
            w.crossed[k] = 0
            changed = changed or slid != w.sliding[k] or (not slid and mode != w.r[p.modes[k]])
        if not changed:
            break
    w.memory[ROW] = 0.0
    field_in_row(p, w, x, t)


@in_place
def _choose(p: Tape, w: Work, x: FloatArray, t: float, k: int, before: float, g: float) -> None:
    """Set the mode of a switch whose function is at zero by where the fields of both sides lead."""
    mode = p.modes[k]
    w.memory[ROW] = 5.0
    w.r[mode] = 1.0
    field_in_row(p, w, x, t)
    _speeds_of_switches(p, w)
    above = w.g_dot[k]
    w.r[mode] = -1.0
    field_in_row(p, w, x, t)
    _speeds_of_switches(p, w)
    below = w.g_dot[k]
    if above < 0.0 < below:
        w.sliding[k] = 1
        w.zero[k] += g
    elif above == 0.0 and below == 0.0:
        w.r[mode] = p.ties[k]
    elif above >= 0.0 and below >= 0.0:
        w.r[mode] = 1.0
    elif above <= 0.0 and below <= 0.0:
        w.r[mode] = -1.0
    else:  # both sides lead away
        w.r[mode] = before if abs(before) == 1.0 else 1.0


@in_place
def crossing(p: Tape, w: Work) -> bool:
    """Return whether a mode no longer fits the registers of now, and mark which.

    Parameters
    ----------
    p : Tape
        The program.
    w : Work
        Holds the registers; the marks are written there.
    """
    found = False
    for k in range(p.switches.size):
        mode = w.r[p.modes[k]]
        if w.sliding[k]:
            w.over[k] = abs(mode) - 1.0
            out = w.over[k] > 1e-9
        else:
            g = w.r[p.switches[k]] - w.zero[k]
            w.over[k] = abs(g) if mode == 0.0 else -g if mode == 1.0 else g
            out = w.over[k] > _SURFACE * w.largest[k]
        w.crossed[k] = 1 if out else 0
        found = found or out
    return found


@in_place
def begin_locating(p: Tape, w: Work, x: FloatArray, t: float) -> None:
    """Remember how far modes are over their edges where a step ends beyond a crossing, and where it began.

    Parameters
    ----------
    p : Tape
        The program.
    w : Work
        What is written on.
    x : (n,) array
        State before the step.
    t : float
        Time before it [s].
    """
    copy(w.over, w.beyond)
    w.memory[ROW] = 5.0
    field_in_row(p, w, x, t)
    crossing(p, w)
    copy(w.over, w.before)


@in_place
def located(w: Work, low: float, high: float, close: float, side: int, halve: bool) -> float:
    """Return the step to try next between one before a crossing and one beyond it: false position, or half way.

    ``side`` says whether the last one tried lay beyond (1) or before (-1): the next is put a little to the other side
    of the estimate, so that the bracket closes from both ends.

    Parameters
    ----------
    w : Work
        Knows how far modes are over their edges at both.
    low, high : float
        Steps before and beyond the crossing [s].
    close : float
        How closely a crossing is located [s].
    side : int
        Whether the last one tried lay beyond (1) or before (-1): the next is put a little to the other side of the
        estimate, so that the bracket closes from both ends.
    halve : bool
        Whether the next one is half way.
    """
    found = 2.0 * high
    for k in range(w.over.size):
        a, b = w.before[k], w.beyond[k]
        if b > 0.0 and -a > 1e-6 * b:
            found = min(found, low - (high - low) * a / (b - a))
        elif b > 0.0 or np.isnan(b):
            halve = True
    if halve or not found < high:
        return 0.5 * (low + high)
    return min(max(found - 0.4 * side * close, low + 0.2 * close), high - 0.2 * close)
