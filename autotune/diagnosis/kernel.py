"""Compiled free-run simulation of a linear chain with the catalogue's effects in it.

Between events the linear chain is advanced exactly: a table holds exp(A h) and its integrals for the steps h = i d,
i = 0..NODES, and a step that falls between two nodes blends them. Lags much shorter than the sample time are
therefore stable and exact. Forces that depend on the state are held over a sub-step and averaged with their value at
its end (Heun); dry friction is solved implicitly, so that sticking is exact.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from autotune.arrays import FloatArray, IntArray

#: Nodes of the table of transition matrices.
NODES = 64
#: Columns of B: command, force at the first plant block's input, force at the last plant block's input.
INPUTS = 3
#: Rows of the taps.
PLANT_IN, SPEED, POSITION, OUTPUT, FIRST_LEVEL = range(5)
#: Columns of the returned signals.
SIGNALS = 4

# Slots of the vector of effect parameters. A slot that is not switched on is not read.
(
    A_QUANTUM, A_QUANTUM_ORIGIN, A_BACKLASH, A_STICTION, A_SLIP, A_DEAD_ZONE, A_SECOND, A_THIRD, A_LOW, A_HIGH, A_RATE,
    A_DRIFT, A_FALL,
    COULOMB, BREAKAWAY, STRIBECK_SPEED, DRAG, CUBIC, POSITION_GAIN, STOP_LOW, STOP_HIGH, SQRT_1, SQRT_2,
    HYSTERESIS, HYSTERESIS_WIDTH, RADIATION, RADIATION_ZERO, LEAK, SINE, SINE_PERIOD, SINE_PHASE,
    S_LOW, S_HIGH, S_QUANTUM, S_SECOND, S_THIRD, S_ABSOLUTE, S_DRIFT,
    CLOCK,
    STEP, STEP_TIME, STEP_END, STEP_RECORDING, PERIODIC_SIN, PERIODIC_COS, PERIODIC_FREQUENCY, DRIFTING,
) = range(47)  # fmt: skip
SLOTS = 47

# Positions in the vector of structure integers.
I_ACTUATOR, I_SPEED, I_POSITION, I_LEVELS = range(4)

#: For what runs in every step and allocates nothing: counting references to its arrays took nine tenths of the time.
_inlined = njit(cache=True, nogil=True, forceinline=True, _nrt=False)


@njit(cache=True, nogil=True)
def transition_table(A: FloatArray, B: FloatArray, step: float) -> FloatArray:
    """Return exp(A i d) and its integrals times B for i = 0..NODES, d = step/NODES, shape (NODES+1, n, n+INPUTS)."""
    n = A.shape[0]
    m = n + B.shape[1]
    scaled = np.zeros((m, m))
    scaled[:n, :n] = A * (step / NODES)
    scaled[:n, n:] = B * (step / NODES)
    norm = 0.0
    for i in range(m):
        norm = max(norm, np.sum(np.abs(scaled[i])))
    halvings = 0
    while norm > 0.25:
        norm *= 0.5
        halvings += 1
    scaled /= 2.0**halvings
    term = np.eye(m)
    one = np.eye(m)
    for k in range(1, 9):
        term = term @ scaled / k
        one += term
    for _ in range(halvings):
        one = one @ one
    table = np.zeros((NODES + 1, n, m))
    power = np.eye(m)
    for i in range(NODES + 1):
        table[i] = power[:n]
        power = power @ one
    return table


@_inlined
def _actuator(
    u: float, offset: float, dt: float, time: float, E: FloatArray, on: IntArray, memory: FloatArray
) -> float:
    """Return what the first block receives for a command, effects of the actuator applied in their physical order."""
    if on[A_QUANTUM]:
        origin = E[A_QUANTUM_ORIGIN]
        u = origin + E[A_QUANTUM] * math.floor((u - origin) / E[A_QUANTUM] + 0.5)
    w = u - offset
    if on[A_BACKLASH]:
        half = 0.5 * E[A_BACKLASH]
        memory[0] = min(max(memory[0], w - half), w + half)
        w = memory[0]
    if on[A_STICTION]:
        if abs(w - memory[1]) > E[A_STICTION]:
            memory[1] = w - math.copysign(E[A_STICTION] - E[A_SLIP], w - memory[1]) if on[A_SLIP] else w
        w = memory[1]
    if on[A_DEAD_ZONE]:
        w = w - min(max(w, -E[A_DEAD_ZONE]), E[A_DEAD_ZONE])
    if on[A_SECOND]:
        w += E[A_SECOND] * w * w
    if on[A_THIRD]:
        w += E[A_THIRD] * w * w * w
    if on[A_LOW]:
        w = max(w, E[A_LOW] - offset)
    if on[A_HIGH]:
        w = min(w, E[A_HIGH] - offset)
    if on[A_RATE]:
        before = memory[2]
        reach = E[A_RATE] * dt
        memory[2] = before + min(max(w - before, -reach), reach)
        w = 0.5 * (before + memory[2])
    if on[A_DRIFT]:
        w *= 1.0 + E[A_DRIFT] * time
    return w


@_inlined
def _load(time: float, recording: int, E: FloatArray, on: IntArray) -> float:
    """Return the environment's force at the plant's input at a time of a recording."""
    load = 0.0
    here = E[STEP_RECORDING] < 0 or recording == int(E[STEP_RECORDING])
    if on[STEP] and here and E[STEP_TIME] <= time < E[STEP_END]:
        load += E[STEP]
    if on[PERIODIC_SIN]:
        angle = 2.0 * math.pi * E[PERIODIC_FREQUENCY] * time
        load += E[PERIODIC_SIN] * math.sin(angle) + E[PERIODIC_COS] * math.cos(angle)
    if on[DRIFTING]:
        load += E[DRIFTING] * time
    return load


@_inlined
def _root_excess(x: float, level: float) -> float:
    """Return x - q(x) for q(x) = 2 X0 (sqrt(1 + x/X0) - 1): what a square-root outflow lacks against a linear one."""
    return x - 2.0 * level * (math.sqrt(max(1.0 + x / level, 0.0)) - 1.0)


@_inlined
def _force(
    plant_in: float, v: float, x: float, y_offset: float, gain: float, hysteresis: float, E: FloatArray, on: IntArray
) -> float:
    """Return the state-dependent force at the first plant block's input, in that input's unit."""
    force = 0.0
    if on[DRAG]:
        force -= E[DRAG] * v * abs(v) / gain
    if on[CUBIC]:
        force -= E[CUBIC] * x * x * x
    if on[POSITION_GAIN]:
        force += E[POSITION_GAIN] * x * plant_in
    if on[SINE]:
        force -= E[SINE] * math.sin(2.0 * math.pi * (x + y_offset) / E[SINE_PERIOD] + E[SINE_PHASE])
    if on[HYSTERESIS]:
        force -= E[HYSTERESIS] * hysteresis
    if on[RADIATION]:
        # what the fourth power adds to the linear loss that the plant's own lag stands for
        zero = E[RADIATION_ZERO]
        force -= E[RADIATION] * ((zero + x) ** 4 - zero**4 - 4.0 * zero**3 * x) / gain
    if on[LEAK]:
        force -= E[LEAK] * x / gain
    return force


@_inlined
def _sensor(z: float, y_offset: float, time: float, E: FloatArray, on: IntArray) -> float:
    """Return the reading for the last block's output z, effects of the sensor applied in their physical order."""
    if on[S_SECOND]:
        z += E[S_SECOND] * z * z
    if on[S_THIRD]:
        z += E[S_THIRD] * z * z * z
    if on[S_DRIFT]:
        z += E[S_DRIFT] * time
    reading = z + y_offset
    if on[S_ABSOLUTE]:
        reading = E[S_ABSOLUTE] + abs(reading - E[S_ABSOLUTE])
    if on[S_LOW]:
        reading = max(reading, E[S_LOW])
    if on[S_HIGH]:
        reading = min(reading, E[S_HIGH])
    if on[S_QUANTUM]:
        reading = E[S_QUANTUM] * math.floor(reading / E[S_QUANTUM] + 0.5)
    return reading


@_inlined
def _blend(table: FloatArray, node: float, slot: int, known: FloatArray, M: FloatArray) -> None:
    """Write a step's transition matrix into a slot, unless it is there from a step of the same length."""
    if abs(node - known[slot]) < 1e-8:
        return
    known[slot] = node
    i = int(node + 1e-6)
    part = node - i if node - i > 1e-6 else 0.0
    j = min(i + 1, NODES)
    for row in range(M.shape[1]):
        for k in range(M.shape[2]):
            M[slot, row, k] = table[i, row, k] + part * (table[j, row, k] - table[i, row, k])


@_inlined
def _advance(M: FloatArray, slot: int, x: FloatArray, w: float, out: FloatArray) -> None:
    """Write the state after one step under the command alone."""
    n = x.size
    for row in range(n):
        total = M[slot, row, n] * w
        for k in range(n):
            total += M[slot, row, k] * x[k]
        out[row] = total


@_inlined
def _tap(taps: FloatArray, row: int, x: FloatArray) -> float:
    total = 0.0
    for k in range(x.size):
        total += taps[row, k] * x[k]
    return total


@_inlined
def _friction(free: float, per_force: float, v: float, E: FloatArray, on: IntArray) -> float:
    """Return the dry friction force that opposes motion: what stops the speed, at most the friction level."""
    level = E[COULOMB]
    if on[BREAKAWAY]:
        ratio = v / E[STRIBECK_SPEED]
        level += (E[BREAKAWAY] - level) * math.exp(-ratio * ratio)
    if per_force == 0.0:
        return 0.0
    needed = -free / per_force
    return float(min(max(needed, -level), level))


@_inlined
def _stop(x: FloatArray, y_offset: float, where: IntArray, E: FloatArray, on: IntArray) -> None:
    """Hold the position inside the hard stops; a blow against a stop is inelastic."""
    p = where[I_POSITION]
    v = where[I_SPEED]
    if on[STOP_HIGH] and x[p] > E[STOP_HIGH] - y_offset:
        x[p] = E[STOP_HIGH] - y_offset
        if v >= 0 and x[v] > 0.0:
            x[v] = 0.0
    if on[STOP_LOW] and x[p] < E[STOP_LOW] - y_offset:
        x[p] = E[STOP_LOW] - y_offset
        if v >= 0 and x[v] < 0.0:
            x[v] = 0.0


@_inlined
def _state_force(
    x: FloatArray, w: float, hysteresis: float, gains: FloatArray, y_offset: float, taps: FloatArray, E: FloatArray,
    on: IntArray,
) -> float:  # fmt: skip
    """Return the state-dependent force for a state, a square-root outflow of the first level included."""
    plant_in = _tap(taps, PLANT_IN, x) + gains[2] * w
    force = _force(plant_in, _tap(taps, SPEED, x), _tap(taps, POSITION, x), y_offset, gains[0], hysteresis, E, on)
    if on[SQRT_1]:
        force += _root_excess(_tap(taps, FIRST_LEVEL, x), E[SQRT_1]) / gains[0]
    return float(force)


@_inlined
def _push(
    M: FloatArray, slot: int, w: float, load: float, smooth: bool, gains: FloatArray, y_offset: float, taps: FloatArray,
    E: FloatArray, on: IntArray, x: FloatArray, free: FloatArray, column: FloatArray, end: FloatArray,
    memory: FloatArray,
) -> None:  # fmt: skip
    """Add to the force-free step what the forces do: Heun for smooth ones, implicit for dry friction."""
    n = x.size
    force = load
    for i in range(n):
        column[i] = M[slot, i, n + 1]
    if smooth:
        before = _state_force(x, w, memory[3], gains, y_offset, taps, E, on)
        for i in range(n):
            end[i] = free[i] + column[i] * (before + load)
        if on[HYSTERESIS]:
            travel = (_tap(taps, POSITION, end) - _tap(taps, POSITION, x)) / E[HYSTERESIS_WIDTH]
            memory[3] = min(max(memory[3] + travel - abs(travel) * memory[3], -1.0), 1.0)
        after = _state_force(end, w, memory[3], gains, y_offset, taps, E, on)
        force += 0.5 * (before + after)
    for i in range(n):
        free[i] += column[i] * force
    if on[COULOMB]:
        friction = _friction(_tap(taps, SPEED, free), _tap(taps, SPEED, column), _tap(taps, SPEED, x), E, on)
        for i in range(n):
            free[i] += column[i] * friction
    if on[SQRT_2]:
        # the lower tank gets the upper one's true outflow and gives a square-root one itself
        excess = _root_excess(_tap(taps, POSITION, x), E[SQRT_2]) / gains[1]
        excess -= _root_excess(_tap(taps, FIRST_LEVEL, x), E[SQRT_1]) if on[SQRT_1] else 0.0
        for row in range(n):
            free[row] += M[slot, row, n + 2] * excess


@njit(cache=True, nogil=True)
def run(
    t: FloatArray,
    u: FloatArray,
    linear_hold: bool,
    starts: IntArray,
    stops: IntArray,
    x0: FloatArray,
    recording: int,
    delay: float,
    u_offset: float,
    y_offset: float,
    rising: FloatArray,
    falling: FloatArray,
    step: float,
    taps: FloatArray,
    gains: FloatArray,
    where: IntArray,
    E: FloatArray,
    on: IntArray,
    forced: int,
    out: FloatArray,
    ends: FloatArray,
) -> None:
    """Simulate a recording's rows, the state restarted at given rows.

    Parameters
    ----------
    t, u : (N,) array
        Time stamps [s] and commands.
    linear_hold : bool
        Whether u runs straight between rows instead of being held.
    starts : (W,) int array
        Rows where a window starts, increasing.
    stops : (W,) int array
        Rows before which they end; rows outside all windows are not written.
    x0 : (W, n) array
        State at each of those rows.
    recording : int
        Number of the recording, for loads that act in one of them.
    delay, u_offset, y_offset : float
        Dead time [s] and operating-point offsets.
    rising, falling : (NODES+1, n, n+INPUTS) array
        Transition tables for a step; two of them where the actuator's lag depends on its direction.
    step : float
        Longest sub-step [s].
    taps, gains, where : arrays
        How signals are read from the state, see :mod:`autotune.diagnosis.chain`.
    E, on : (SLOTS,) arrays
        Effect parameters and which of them act.
    forced : int
        Whether any effect acts as a force at the plant's input.
    out : (SIGNALS, N) or (1, N) array
        Receives reading, speed, position and plant input at each row, or the reading alone.
    ends : (W, n) array
        Receives the state at the next window's first row, for the last window at the last row.
    """
    N = t.size
    n = x0.shape[1]
    x = np.empty(n)
    free = np.empty(n)
    column = np.empty(n)
    end = np.empty(n)
    memory = np.zeros(4)
    # transition matrices of a row's first and further steps, and of those under a falling actuator
    M, known = np.empty((4, n, n + INPUTS)), np.full(4, -1.0)
    smooth = on[DRAG : POSITION_GAIN + 1].any() or on[SQRT_1] or on[HYSTERESIS : SINE_PHASE + 1].any()
    stopped = on[STOP_HIGH] or on[STOP_LOW]
    sensing = on[S_LOW : S_DRIFT + 1].any()
    plain = not (forced or linear_hold or on[:S_LOW].any())
    # when each command arrives at the chain
    acts = t[0] + (t - t[0]) * (1.0 + (E[CLOCK] if on[CLOCK] else 0.0)) + delay
    node_length = step / NODES
    remembering = on[A_BACKLASH] or on[A_STICTION]
    carried, past = np.full(4, u[0] - u_offset), 0
    for window in range(starts.size):
        first = starts[window]
        last = stops[window]
        x[:] = x0[window]
        # the command in force at the window's start, dead time counted
        j = first
        while j > 0 and acts[j] > t[first] + 1e-9:
            j -= 1
        while j + 1 < N and acts[j + 1] <= t[first] + 1e-9:
            j += 1
        w = u[j] - u_offset
        # play and stiction remember all commands before the window
        while remembering and past <= j:
            _actuator(u[past], u_offset, 0.0, 0.0, E, on, carried)
            past += 1
        if window == 0 or stops[window - 1] != first:  # else a rate limit and hysteresis go on where they were
            memory[2] = w
            memory[3] = 0.0
        memory[:2] = w
        if remembering:
            memory[:2] = carried[:2]
        for k in range(first, last):
            z = _tap(taps, OUTPUT, x) + gains[3] * w
            out[0, k] = _sensor(z, y_offset, t[k] - t[0], E, on) if sensing else z + y_offset
            if out.shape[0] > 1:
                out[1, k] = _tap(taps, SPEED, x)
                out[2, k] = _tap(taps, POSITION, x)
                out[3, k] = _tap(taps, PLANT_IN, x) + gains[2] * w
            if k + 1 >= N:
                break
            now = t[k]
            while now < t[k + 1] - 1e-9 * step:
                while j + 1 < N and acts[j + 1] <= now + 1e-6 * step:
                    j += 1
                until = t[k + 1]
                if j + 1 < N and now < acts[j + 1] < until:
                    until = acts[j + 1]
                pieces = max(1, math.ceil((until - now) / step - 1e-6))
                dt = (until - now) / pieces
                node = min(dt / node_length, float(NODES))
                slot = 0 if now == t[k] else 1
                _blend(rising, node, slot, known, M)
                if on[A_FALL]:
                    _blend(falling, node, slot + 2, known, M)
                if plain:
                    w = u[j] - u_offset
                    for _ in range(pieces):
                        _advance(M, slot, x, w, free)
                        x[:] = free
                    now = until
                    continue
                for piece in range(pieces):
                    begin = now + piece * dt
                    command = u[j]
                    if linear_hold and j + 1 < N:
                        share = (begin + 0.5 * dt - delay - t[j]) / (t[j + 1] - t[j])
                        command += min(max(share, 0.0), 1.0) * (u[j + 1] - u[j])
                    w = _actuator(command, u_offset, dt, begin - t[0], E, on, memory)
                    use = slot + 2 if on[A_FALL] and w < x[where[I_ACTUATOR]] else slot
                    _advance(M, use, x, w, free)
                    if forced:
                        load = _load(begin + 0.5 * dt - t[0], recording, E, on)
                        _push(M, use, w, load, smooth, gains, y_offset, taps, E, on, x, free, column, end, memory)
                    x[:] = free
                    if stopped:
                        _stop(x, y_offset, where, E, on)
                now = until
        ends[window] = x
