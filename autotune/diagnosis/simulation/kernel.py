"""The body of the compiled simulation; the stages it calls are written from the effects' records.

Between events the linear chain is advanced exactly: a table holds exp(A h) and its integrals for the steps h = i d,
i = 0..NODES, and a step that falls between two nodes blends them. Lags much shorter than the sample time are
therefore stable and exact. Forces that depend on the state are held over a sub-step and averaged with their value at
its end (Heun); dry friction is solved implicitly, so that sticking is exact.

This file is read as text and compiled together with the stages, see :mod:`autotune.diagnosis.simulation.compiled`: the
compiler's cache would not notice a change in another file.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from autotune.arrays import FloatArray, IntArray
from autotune.diagnosis.simulation.stages import (
    MEMORIES,
    Effects,
    begin,
    clock,
    command,
    converter,
    force,
    friction,
    inlined,
    load,
    outflow,
    reading,
    sensor,
    stop,
    travel,
)

#: Nodes of the table of transition matrices.
NODES = 64
#: Columns of B: command, force at the first plant block's input, force at the last plant block's input.
INPUTS = 3
#: Rows of the taps.
PLANT_IN, SPEED, POSITION, OUTPUT, FIRST_LEVEL = range(5)
#: Columns of the returned signals: reading, speed, position (or level), plant input.
SIGNALS = 4
#: Positions in the vector of numbers, before the effects' values.
(
    STEP, DELAY, U_OFFSET, Y_OFFSET, KELVIN, LAW, GAIN, GAIN_LAST, DIRECT_IN, DIRECT_OUT, NUMBERS
) = range(11)  # fmt: skip
#: Positions in the vector of integers, before those that say which effects act.
(
    NUMBER, SIGNALS_ASKED, LINEAR_HOLD, DIRECTIONAL, ACTUATOR, SPEED_STATE, POSITION_STATE, FORCED, SMOOTH, RUBBING,
    DRAINING, STOPPED, SENSING, PLAIN, DRY, REPLAYED, TRAVELLED, ROWS, FLAGS
) = range(19)  # fmt: skip


class _Linear(NamedTuple):
    """The chain within a run: transition matrices by slot and the node each is for, taps, and how steps are split."""

    M: FloatArray
    known: FloatArray
    taps: FloatArray
    numbers: FloatArray
    flags: IntArray


class _Work(NamedTuple):
    """Vectors of the state's length that every sub-step uses again."""

    x: FloatArray
    free: FloatArray
    column: FloatArray
    end: FloatArray


@inlined
def _blend(table: FloatArray, node: float, slot: int, linear: _Linear) -> None:
    """Write a step's transition matrix into a slot, unless it is there from a step of the same length."""
    M, known = linear.M, linear.known
    if abs(node - known[slot]) < 1e-8:
        return
    known[slot] = node
    i = int(node + 1e-6)
    part = node - i if node - i > 1e-6 else 0.0
    j = min(i + 1, NODES)
    for row in range(M.shape[1]):
        for k in range(M.shape[2]):
            M[slot, row, k] = table[i, row, k] + part * (table[j, row, k] - table[i, row, k])


@inlined
def _advance(M: FloatArray, slot: int, x: FloatArray, w: float, out: FloatArray) -> None:
    """Write the state after one step under the command alone; two states, which most plants have, without a loop."""
    n = x.size
    if n == 2:
        first, second = x[0], x[1]
        out[0] = M[slot, 0, 2] * w + M[slot, 0, 0] * first + M[slot, 0, 1] * second
        out[1] = M[slot, 1, 2] * w + M[slot, 1, 0] * first + M[slot, 1, 1] * second
        return
    for row in range(n):
        total = M[slot, row, n] * w
        for k in range(n):
            total += M[slot, row, k] * x[k]
        out[row] = total


@inlined
def _tap(taps: FloatArray, row: int, x: FloatArray) -> float:
    if x.size == 2:
        return float(taps[row, 0] * x[0] + taps[row, 1] * x[1])
    total = 0.0
    for k in range(x.size):
        total += taps[row, k] * x[k]
    return total


@inlined
def _state_force(x: FloatArray, w: float, t: float, linear: _Linear, effects: Effects) -> float:
    """Return the state-dependent force for a state."""
    taps, numbers = linear.taps, linear.numbers
    plant_in = _tap(taps, PLANT_IN, x) + numbers[DIRECT_IN] * w
    v, position, level = _tap(taps, SPEED, x), _tap(taps, POSITION, x), _tap(taps, FIRST_LEVEL, x)
    return float(force(plant_in, v, position, level, t, linear.flags[NUMBER], effects))


@inlined
def _rubbed(work: _Work, taps: FloatArray, effects: Effects) -> float:
    """Return the dry friction that opposes motion: what stops the speed, at most the friction's level."""
    level = friction(_tap(taps, SPEED, work.x), effects)
    per_force = _tap(taps, SPEED, work.column)
    if per_force == 0.0:
        return 0.0
    needed = -_tap(taps, SPEED, work.free) * (1.0 / per_force)
    return float(min(max(needed, -level), level))


@inlined
def _push(slot: int, w: float, t: float, dt: float, linear: _Linear, work: _Work, effects: Effects) -> None:
    """Add to the force-free step what the forces do: Heun for smooth ones, implicit for dry friction."""
    M, taps, flags = linear.M, linear.taps, linear.flags
    x, free, column, end = work.x, work.free, work.column, work.end
    n = x.size
    push = load(t + 0.5 * dt, flags[NUMBER], effects)
    total = push
    for i in range(n):
        column[i] = M[slot, i, n + 1]
    if flags[SMOOTH]:
        before = _state_force(x, w, t, linear, effects)
        for i in range(n):
            end[i] = free[i] + column[i] * (before + push)
        travel(_tap(taps, POSITION, end) - _tap(taps, POSITION, x), dt, effects)
        after = _state_force(end, w, t, linear, effects)
        total += 0.5 * (before + after)
    for i in range(n):
        free[i] += column[i] * total
    if flags[RUBBING]:
        rubbed = _rubbed(work, taps, effects)
        for i in range(n):
            free[i] += column[i] * rubbed
    if flags[DRAINING]:
        added = outflow(_tap(taps, POSITION, x), _tap(taps, FIRST_LEVEL, x), effects)
        for row in range(n):
            free[row] += M[slot, row, n + 2] * added


@inlined
def _rub(slot: int, w: float, pieces: int, linear: _Linear, x: FloatArray, effects: Effects) -> None:
    """Advance two states on which dry friction acts alone: the sums of the general way, not written down in between."""
    M, taps = linear.M, linear.taps
    first, second = x[0], x[1]
    column = M[slot, 0, 3], M[slot, 1, 3]
    speed = taps[SPEED, 0], taps[SPEED, 1]
    per_force = speed[0] * column[0] + speed[1] * column[1]
    stops = 1.0 / per_force if per_force != 0.0 else 0.0
    for _ in range(pieces):
        free = M[slot, 0, 2] * w + M[slot, 0, 0] * first + M[slot, 0, 1] * second
        other = M[slot, 1, 2] * w + M[slot, 1, 0] * first + M[slot, 1, 1] * second
        rubbed = 0.0
        if per_force != 0.0:
            level = friction(speed[0] * first + speed[1] * second, effects)
            rubbed = min(max(-(speed[0] * free + speed[1] * other) * stops, -level), level)
        first = free + column[0] * rubbed
        second = other + column[1] * rubbed
    x[0], x[1] = first, second


@inlined
def _stop(x: FloatArray, linear: _Linear, effects: Effects) -> None:
    """Hold the position where a stop holds it."""
    p, v = linear.flags[POSITION_STATE], linear.flags[SPEED_STATE]
    x[p], speed = stop(x[p], x[v] if v >= 0 else 0.0, effects)
    if v >= 0:
        x[v] = speed


@inlined
def _held(driven: FloatArray, j: int, begin_s: float, dt: float, linear: _Linear) -> float:
    """Return the command in the middle of a sub-step: as held, or on the straight line to the next row's."""
    value = driven[1, j]
    if linear.flags[LINEAR_HOLD] and j + 1 < driven.shape[1]:
        share = (begin_s + 0.5 * dt - linear.numbers[DELAY] - driven[0, j]) / (driven[0, j + 1] - driven[0, j])
        value += min(max(share, 0.0), 1.0) * (driven[1, j + 1] - driven[1, j])
    return float(value)


@inlined
def _arrival(t: FloatArray, k: int, linear: _Linear, effects: Effects) -> float:
    """Return when a row's command arrives at the chain; never for the row after the last."""
    if k >= t.size:
        return math.inf
    return float(t[0] + clock(t[k] - t[0], effects) + linear.numbers[DELAY])


@njit(cache=True, nogil=True)
def run(
    driven: FloatArray,
    rows: IntArray,
    states: FloatArray,
    tables: FloatArray,
    taps: FloatArray,
    numbers: FloatArray,
    flags: IntArray,
) -> FloatArray:
    """Simulate a recording's rows, the state restarted at given rows.

    Parameters
    ----------
    driven : (2, N) array
        Time stamps [s] and commands.
    rows : (3, W) int array
        Rows where windows start, increasing, rows before which they end, and where in the output they begin; what lies
        between them there stays NaN.
    states : (2, W, n) array
        State at the first of those rows; receives the state at the last of them.
    tables : (2, NODES+1, n, n+INPUTS) array
        Transition tables for a step; two of them where the actuator's lag depends on its direction.
    taps : (5, n) array
        How signals are read from the state, see :mod:`autotune.diagnosis.simulation.chain`.
    numbers, flags : arrays
        See the positions above; then the effects' values, and which of them act.

    Returns
    -------
    (signals, rows) array
        Reading, speed, position and plant input at each row, or the reading alone.
    """
    t, u = driven[0], driven[1]
    N, n = t.size, states.shape[2]
    out = np.full((flags[SIGNALS_ASKED], flags[ROWS]), np.nan)
    linear = _Linear(np.empty((4, n, n + INPUTS)), np.full(4, -1.0), taps, numbers, flags)
    work = _Work(np.empty(n), np.empty(n), np.empty(n), np.empty(n))
    M, x, free = linear.M, work.x, work.free
    memory, began = np.zeros(MEMORIES + 1), np.zeros(MEMORIES + 1)
    carried = np.full(MEMORIES + 1, u[0] - numbers[U_OFFSET])
    effects = Effects(numbers, flags[FLAGS:], memory)
    before = Effects(numbers, flags[FLAGS:], carried)
    u_offset, y_offset, step = numbers[U_OFFSET], numbers[Y_OFFSET], numbers[STEP]
    per_step, per_node = 1.0 / step, NODES / step  # a division takes as long as all else that a row of a chain needs
    past = 0
    for window in range(rows.shape[1]):
        first, last = rows[0, window], rows[1, window]
        for i in range(n):  # entry by entry: an assigned slice is compiled with the text of its error, for seconds
            x[i] = states[0, window, i]
        # the command in force at the window's start, dead time counted, and when the next one arrives
        j = first
        while j > 0 and _arrival(t, j, linear, effects) > t[first] + 1e-6 * step:
            j -= 1
        comes = _arrival(t, j + 1, linear, effects)
        while comes <= t[first] + 1e-6 * step:
            j += 1
            comes = _arrival(t, j + 1, linear, effects)
        w = u[j] - u_offset
        # some effects remember all commands before the window
        while flags[REPLAYED] and past <= j:
            command(converter(u[past], 0.0, before) - u_offset, u_offset, 0.0, 0.0, flags[NUMBER], before)
            past += 1
        begin(w, window > 0 and (flags[TRAVELLED] or rows[1, window - 1] == first), carried, effects)
        at, beyond = rows[2, window] - first, last
        if flags[TRAVELLED]:
            # some effects remember how the plant moved: on through the rows that lie between windows
            again = window > 0 and rows[0, window - 1] == first
            for i in range(memory.size):
                if again:
                    memory[i] = began[i]
                began[i] = memory[i]
            if window + 1 < rows.shape[1]:
                beyond = max(last, rows[0, window + 1])
        for k in range(first, beyond):
            if k < last:
                z = _tap(taps, OUTPUT, x) + numbers[DIRECT_OUT] * w
                since = t[k] - t[0]
                if flags[SENSING]:
                    through = numbers[LAW] * (_tap(taps, PLANT_IN, x) + numbers[DIRECT_IN] * w)
                    out[0, at + k] = reading(sensor(z, since, through, effects) + y_offset, since, effects)
                else:
                    out[0, at + k] = z + y_offset
                if out.shape[0] > 1:
                    out[1, at + k] = _tap(taps, SPEED, x)
                    out[2, at + k] = _tap(taps, POSITION, x)
                    out[3, at + k] = _tap(taps, PLANT_IN, x) + numbers[DIRECT_IN] * w
            elif k == last:
                for i in range(n):
                    states[1, window, i] = x[i]
            if k + 1 >= N:
                break
            now = t[k]
            while now < t[k + 1] - 1e-9 * step:
                while comes <= now + 1e-6 * step:
                    j += 1
                    comes = _arrival(t, j + 1, linear, effects)
                until = t[k + 1]
                if now < comes < until:
                    until = comes
                dt = until - now
                pieces = max(1, math.ceil(dt * per_step - 1e-6))
                if pieces > 1:
                    dt /= pieces
                node = min(dt * per_node, float(NODES))
                slot = 0 if now == t[k] else 1
                _blend(tables[0], node, slot, linear)
                if flags[DIRECTIONAL]:
                    _blend(tables[1], node, slot + 2, linear)
                if flags[PLAIN]:
                    w = u[j] - u_offset
                    for _ in range(pieces):
                        _advance(M, slot, x, w, free)
                        for i in range(n):
                            x[i] = free[i]
                    now = until
                    continue
                if flags[DRY]:
                    w = u[j] - u_offset
                    _rub(slot, w, pieces, linear, x, effects)
                    now = until
                    continue
                for piece in range(pieces):
                    begin_s = now + piece * dt
                    absolute = converter(_held(driven, j, begin_s, dt, linear), begin_s - t[0], effects)
                    w = command(absolute - u_offset, u_offset, dt, begin_s - t[0], flags[NUMBER], effects)
                    use = slot + 2 if flags[DIRECTIONAL] and w < x[flags[ACTUATOR]] else slot
                    _advance(M, use, x, w, free)
                    if flags[FORCED]:
                        _push(use, w, begin_s - t[0], dt, linear, work, effects)
                    for i in range(n):
                        x[i] = free[i]
                    if flags[STOPPED]:
                        _stop(x, linear, effects)
                now = until
        if beyond == last:
            for i in range(n):
                states[1, window, i] = x[i]
    return out
