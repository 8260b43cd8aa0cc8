"""The control loop around a rig: sampling, sensor electronics, controller, held command, and what gets recorded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sim.conceal.physics import FREE, N_STATES, Floats, Physics, advance, chain_output, command_at, command_static

OPEN_LOOP, PI, PD, RELAY = range(4)


class Law(NamedTuple):
    """Controller as it runs (which need not be the one that is stated)."""

    kind: int
    K: float = 0.0
    T_I: float = 1.0
    T_d: float = 0.0
    half_amplitude: float = 0.0
    hysteresis: float = 0.0
    inserted_rows: int = 0
    bias: float = 0.0
    low: float = -np.inf
    high: float = np.inf


class Sampling(NamedTuple):
    """Row times and everything random that the sampling adds, one value per row (the burn-in included)."""

    Ts: float
    t: Floats  # instant at which the row is really taken, s
    noise: Floats  # measurement noise, units of y
    lost: Floats  # 1 where the measurement is lost and the last one stays
    spike: Floats  # units of y


@njit(cache=True)
def interpolate(values: Floats, k: int, back: float) -> float:
    """Return a sequence some rows before row k, linear between rows.

    Parameters
    ----------
    values : (N,) array
        The sequence, known up to row k.
    k : int
        The row of now.
    back : float
        How many rows before it.
    """
    position = max(k - back, 0.0)
    i = int(position)
    if i >= k:
        return float(values[k])
    return float(values[i] + (position - i) * (values[i + 1] - values[i]))


@njit(cache=True)
def measure(k: int, clean: Floats, command: float, sampling: Sampling, last: float, p: Physics) -> float:
    """Return row k as the sensor's electronics give it.

    Parameters
    ----------
    k : int
        The row.
    clean : (N,) array
        The chain's output about its offset, known up to row k.
    command : float
        Of now.
    sampling : Sampling
        Stamps and errors of every row.
    last : float
        The reading before.
    p : Physics
        Truth of the rig.
    """
    t = sampling.t[k]
    back = p.clock_error * max(t, 0.0) / sampling.Ts
    y = interpolate(clean, k, back)
    if p.echo_gain != 0.0:
        y += p.echo_gain * interpolate(clean, k, back + p.echo_delay / sampling.Ts)
    y += p.crosstalk * command
    y += p.sensor_second_order * y * y
    if y < p.sensor_fold:
        y = 2.0 * p.sensor_fold - y
    y += p.sensor_rate * max(t, 0.0)
    y = min(min(y, p.sensor_high) + sampling.noise[k], p.reading_high) + sampling.spike[k]
    if p.sensor_quantum > 0.0:
        y = p.sensor_quantum * np.round(y / p.sensor_quantum)
    if sampling.lost[k] > 0.0:
        return last
    return float(y + p.y_offset)


@njit(cache=True)
def control(
    k: int, r: float, y: float, dither: float, memory: Floats, side: Floats, law: Law, Ts: float, sign: float
) -> float:
    """Return the command of one row of the control law.

    Parameters
    ----------
    k : int
        The row.
    r, y : float
        Set-point and reading.
    dither : float
        Added to the command.
    memory : (3,) array
        Integral, last y, filtered slope; changed in place.
    side : (N,) array
        The relay's past; changed in place.
    law : Law
        The control law.
    Ts : float
        Sample time [s].
    sign : float
        Of the plant's gain.
    """
    if law.kind == OPEN_LOOP:
        return dither
    error = r - y
    if law.kind == PI:
        memory[0] += law.K * error * Ts / law.T_I
        u = law.bias + law.K * error + memory[0] + dither
    elif law.kind == PD:
        keep = np.exp(-5.0 * Ts / max(law.T_d, 1e-9)) if law.T_d > 0.0 else 0.0
        memory[2] = keep * memory[2] + (1.0 - keep) * (y - memory[1]) / Ts
        memory[1] = y
        u = law.bias + law.K * (error - law.T_d * memory[2]) + dither
    else:
        now = side[k - 1] if k > 0 else 1.0
        if sign * error > law.hysteresis:
            now = 1.0
        elif sign * error < -law.hysteresis:
            now = -1.0
        side[k] = now
        u = dither + law.half_amplitude * side[max(k - law.inserted_rows, 0)]
    return float(min(max(u, law.low), law.high))


@njit(cache=True)
def run_loop(
    p: Physics, law: Law, sampling: Sampling, r: Floats, dither: Floats, substeps: int, start: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Run the loop over all rows.

    Returns the command, the measurement, the noise-free chain output and the share of each row spent at an event
    (stuck, stopped, limited) that begins there.
    """
    N = len(r)
    Ts = sampling.Ts
    h = Ts / substeps
    state, work = start.copy(), np.zeros((4, N_STATES))
    u, y, clean, acts = np.zeros(N), np.zeros(N), np.zeros(N), np.zeros(N)
    effective, switch = np.zeros(N), np.full(N, np.inf)
    memory, side = np.zeros(3), np.zeros(N)
    memory[1] = r[0]
    ramp = np.zeros(3)
    direction, mode, pending, last_effective, held = 1.0, FREE, 0, 0.0, r[0]
    sign = np.sign(p.K)
    for k in range(N):
        clean[k] = chain_output(state, p)
        y[k] = measure(k, clean, u[max(k - 1, 0)] - p.u_offset, sampling, held, p)
        held = y[k]
        u[k] = control(k, r[k], y[k], dither[k], memory, side, law, Ts, sign)
        last_effective = command_static(u[k] - p.u_offset, last_effective, p)
        effective[k] = last_effective
        t = sampling.t[k]
        swing = p.modulated_delay * np.sin(2.0 * np.pi * p.modulation_hertz * t)
        switch[k] = max(t + p.delay + swing, switch[k - 1] if k > 0 else -np.inf)
        if abs(u[k] - p.u_offset) > p.command_limit:
            acts[k] = 1.0
        end = sampling.t[k + 1] if k + 1 < N else t + Ts
        while t < end:
            while pending <= k and switch[pending] <= t + 1e-12:  # commands that have arrived by now
                ramp[0], ramp[1], ramp[2] = command_at(t, ramp, p), effective[pending], t
                pending += 1
            until = min(end, switch[pending]) if pending <= k else end
            direction, mode = advance(t, until, h, state, ramp, direction, mode, p, work)
            if mode != FREE:
                acts[k] = 1.0
            t = until
    return u, y, clean, acts
