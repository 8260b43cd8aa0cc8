"""Continuous-time equations of the three rigs with any effect in them, integrated with event handling.

The rig is a chain: held command, static command effects, transport delay, actuator lag, plant, sensor lag, sensor.
Between two events the state follows a classical Runge-Kutta step; a speed that reaches zero under dry friction and a
position that reaches a stop are located by bisection, and the step goes on from there in the new mode.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# states of the chain
EXTRA_LAG, ACTUATOR, SPEED, POSITION, FLEX, FLEX_RATE, PRESLIDE, CREEP, SENSOR, EXTRA_SENSOR = range(10)
N_STATES = 10
BISECTIONS = 40
FREE, STUCK, STOPPED = 0, 1, 2


class Physics(NamedTuple):
    """Truth of one rig; every effect is absent at its default. Input-equivalent quantities are in units of u."""

    integrating: float  # 1: speed and position (ball, servo); 0: one first-order lag (process)
    K: float
    tau_actuator: float
    tau_plant: float
    tau_sensor: float
    delay: float
    u_offset: float
    y_offset: float
    # actuator, on the command about its offset
    command_offset: float = 0.0
    command_second_order: float = 0.0
    command_quantum: float = 0.0
    quantum_origin: float = 0.0  # deviation at which one of its levels lies
    dead_zone: float = 0.0
    backlash: float = 0.0
    stiction: float = 0.0
    command_limit: float = np.inf
    rate_limit: float = np.inf
    extra_lag: float = 0.0
    lag_rising_factor: float = 1.0
    gain_rate: float = 0.0
    # plant
    coulomb: float = 0.0
    breakaway: float = 0.0
    stribeck_speed: float = 1.0
    drag: float = 0.0
    cubic: float = 0.0
    gain_slope: float = 0.0
    stop: float = np.inf
    stop_sign: float = 1.0
    head: float = 0.0
    radiation: float = 0.0
    absolute_temperature: float = 0.0
    leak: float = 0.0
    torque: float = 0.0
    torque_wave_number: float = 1.0
    torque_phase: float = 0.0
    preslide_level: float = 0.0
    preslide_displacement: float = 1.0
    flex_omega: float = 0.0
    flex_damping: float = 0.05
    # sensor, on the output about its offset
    extra_sensor_lag: float = 0.0
    sensor_second_order: float = 0.0
    sensor_fold: float = -np.inf
    sensor_high: float = np.inf  # where the sensor ends, before its noise
    reading_high: float = np.inf  # where the converter ends, after the noise
    sensor_rate: float = 0.0
    sensor_quantum: float = 0.0
    # environment
    load_step: float = 0.0
    load_start: float = 0.0
    load_end: float = np.inf
    load_amplitude: float = 0.0
    load_hertz: float = 0.0
    load_phase: float = 0.0
    load_chirp: float = 0.0
    load_rate: float = 0.0
    # timing
    clock_error: float = 0.0
    # beyond any catalogue
    echo_gain: float = 0.0
    echo_delay: float = 0.0
    switching_gain: float = 0.0
    switching_period: float = 1.0
    modulated_lag: float = 0.0
    modulated_stiffness: float = 0.0
    modulation_hertz: float = 0.0
    modulated_delay: float = 0.0
    crosstalk: float = 0.0
    creep_fraction: float = 0.0
    creep_time: float = 1.0


@njit(cache=True)
def command_static(du: float, before: float, p: Physics) -> float:
    """Return what an actuator's static and memory effects make of one new command.

    Parameters
    ----------
    du : float
        The command about its offset.
    before : float
        What the actuator put out until now.
    p : Physics
        Truth of the rig.
    """
    e = du + p.command_offset + p.command_second_order * du * du
    if p.command_quantum > 0.0:
        e = p.quantum_origin + p.command_quantum * np.round((e - p.quantum_origin) / p.command_quantum)
    if p.dead_zone > 0.0:
        e = np.sign(e) * max(abs(e) - p.dead_zone, 0.0)
    e = min(max(e, -p.command_limit), p.command_limit)
    if p.backlash > 0.0:  # play: the output moves only when a flank is touched
        e = min(max(before, e - p.backlash), e + p.backlash)
    if p.stiction > 0.0 and abs(e - before) <= p.stiction:  # sticks until the command has moved by the band
        e = before
    return e


@njit(cache=True)
def load(t: float, p: Physics) -> float:
    """Load on the plant in units of the command.

    Parameters
    ----------
    t : float
        Time since the first row [s].
    p : Physics
        Truth of the rig.
    """
    w = p.load_rate * max(t, 0.0)
    if p.load_start <= t < p.load_end:
        w += p.load_step
    if p.load_amplitude != 0.0:
        w += p.load_amplitude * np.sin(2.0 * np.pi * (p.load_hertz + 0.5 * p.load_chirp * t) * t + p.load_phase)
    return w


@njit(cache=True)
def drive(t: float, s: Floats, p: Physics) -> float:
    """Everything that pushes the plant except its own damping and dry friction, in units of K times the command.

    Parameters
    ----------
    t : float
        Time since the first row [s].
    s : (10,) array
        State.
    p : Physics
        Truth of the rig.
    """
    x = s[POSITION]
    gain = 1.0 + p.gain_rate * max(t, 0.0) + p.gain_slope * x
    if p.switching_gain != 0.0 and np.floor(t / p.switching_period) % 2 == 1:
        gain += p.switching_gain
    f = gain * s[ACTUATOR] + load(t, p)
    if p.integrating > 0.0:
        f -= p.cubic * x**3 + p.preslide_level * s[PRESLIDE]
        if p.torque != 0.0:
            f -= p.torque * np.sin(p.torque_wave_number * x + p.torque_phase)
        if p.modulated_stiffness != 0.0:
            f -= p.modulated_stiffness * x * np.sin(2.0 * np.pi * p.modulation_hertz * t)
    return float(p.K * f)


@njit(cache=True)
def loss(v: float, p: Physics) -> float:
    """Damping of an integrating rig's speed, or outflow and heat loss of a process.

    Parameters
    ----------
    v : float
        Speed, or level about the operating point.
    p : Physics
        Truth of the rig.
    """
    if p.head > 0.0:  # square-root outflow with the head at the operating point, same slope there
        return float(2.0 * p.head * (np.sqrt(max(1.0 + v / p.head, 0.0)) - 1.0))
    r = v + p.drag * abs(v) * v
    if p.radiation > 0.0:
        T = p.absolute_temperature
        r += p.radiation * ((T + v) ** 4 - T**4 - 4.0 * T**3 * v)
    return r


@njit(cache=True)
def derivative(t: float, s: Floats, e: float, direction: float, mode: int, p: Physics, out: Floats) -> None:
    """Write the time derivative of the chain's state.

    Parameters
    ----------
    t : float
        Time since the first row [s].
    s : (10,) array
        State.
    e : float
        What the actuator is asked for.
    direction : float
        Sign that dry friction opposes.
    mode : int
        Free, stuck or stopped.
    p : Physics
        Truth of the rig.
    out : (10,) array
        Takes the derivative.
    """
    out[:] = 0.0
    w = e
    if p.extra_lag > 0.0:
        out[EXTRA_LAG] = (e - s[EXTRA_LAG]) / p.extra_lag
        w = s[EXTRA_LAG]
    tau = p.tau_actuator * (p.lag_rising_factor if w > s[ACTUATOR] else 1.0)
    out[ACTUATOR] = (w - s[ACTUATOR]) / tau
    tau_plant = p.tau_plant
    if p.modulated_lag != 0.0:
        tau_plant *= 1.0 + p.modulated_lag * np.sin(2.0 * np.pi * p.modulation_hertz * t)
    v = s[SPEED]
    if mode == FREE:
        friction = 0.0
        if p.breakaway > 0.0:
            friction = direction * (p.coulomb + (p.breakaway - p.coulomb) * np.exp(-((v / p.stribeck_speed) ** 2)))
        out[SPEED] = (drive(t, s, p) - p.K * friction * np.sign(p.K) - loss(v, p)) / tau_plant
    z = v
    if p.integrating > 0.0:
        out[POSITION] = 0.0 if mode == STOPPED else v - p.leak * s[POSITION]
        out[PRESLIDE] = (v - abs(v) * s[PRESLIDE]) / p.preslide_displacement
        z = s[POSITION]
    if p.flex_omega > 0.0:
        out[FLEX] = s[FLEX_RATE]
        out[FLEX_RATE] = p.flex_omega**2 * (z - s[FLEX]) - 2.0 * p.flex_damping * p.flex_omega * s[FLEX_RATE]
        z = s[FLEX]
    if p.creep_fraction != 0.0:
        out[CREEP] = (z - s[CREEP]) / p.creep_time
        z = (1.0 - p.creep_fraction) * z + p.creep_fraction * s[CREEP]
    if p.tau_sensor > 0.0:
        out[SENSOR] = (z - s[SENSOR]) / p.tau_sensor
        z = s[SENSOR]
    if p.extra_sensor_lag > 0.0:
        out[EXTRA_SENSOR] = (z - s[EXTRA_SENSOR]) / p.extra_sensor_lag


@njit(cache=True)
def chain_output(s: Floats, p: Physics) -> float:
    """Give what reaches the sensor's electronics, about the output offset.

    Parameters
    ----------
    s : (10,) array
        State.
    p : Physics
        Truth of the rig.
    """
    if p.extra_sensor_lag > 0.0:
        return float(s[EXTRA_SENSOR])
    if p.tau_sensor > 0.0:
        return float(s[SENSOR])
    z = s[POSITION] if p.integrating > 0.0 else s[SPEED]
    if p.flex_omega > 0.0:
        z = s[FLEX]
    if p.creep_fraction != 0.0:
        z = (1.0 - p.creep_fraction) * z + p.creep_fraction * s[CREEP]
    return float(z)


@njit(cache=True)
def _rk4(t: float, h: float, s: Floats, ramp: Floats, direction: float, mode: int, p: Physics, work: Floats) -> Floats:
    """One classical Runge-Kutta step; ``ramp`` = (value at start, target, start time) of the command."""
    k1, k2, k3, k4 = work[0], work[1], work[2], work[3]
    derivative(t, s, command_at(t, ramp, p), direction, mode, p, k1)
    e = command_at(t + 0.5 * h, ramp, p)
    derivative(t + 0.5 * h, s + 0.5 * h * k1, e, direction, mode, p, k2)
    derivative(t + 0.5 * h, s + 0.5 * h * k2, e, direction, mode, p, k3)
    derivative(t + h, s + h * k3, command_at(t + h, ramp, p), direction, mode, p, k4)
    out: Floats = s + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return out


@njit(cache=True)
def command_at(t: float, ramp: Floats, p: Physics) -> float:
    """Command after the rate limit: from the value it had towards the target, never faster than the limit."""
    if p.rate_limit == np.inf:
        return float(ramp[1])
    reach = p.rate_limit * (t - ramp[2])
    return float(ramp[0] + min(max(ramp[1] - ramp[0], -reach), reach))


@njit(cache=True)
def crossing(s: Floats, direction: float, mode: int, p: Physics) -> float:
    """Event function: positive while the present mode lasts.

    Parameters
    ----------
    s : (10,) array
        State.
    direction : float
        Sign that dry friction opposes.
    mode : int
        Free, stuck or stopped.
    p : Physics
        Truth of the rig.
    """
    moves = s[POSITION] if p.integrating > 0.0 else s[SPEED]
    to_stop = p.stop_sign * (p.stop - moves) if p.stop != np.inf else np.inf
    if mode == FREE and p.breakaway > 0.0:
        return float(min(direction * s[SPEED], to_stop))
    return float(to_stop)


@njit(cache=True)
def _leaves(t: float, s: Floats, mode: int, p: Physics) -> bool:
    """Whether a stuck or stopped body starts to move."""
    d = drive(t, s, p)
    if mode == STUCK:
        return bool(abs(d) > abs(p.K) * p.breakaway)
    if p.integrating > 0.0:
        return bool(p.stop_sign * d < -abs(p.K) * p.breakaway)
    return bool(p.stop_sign * (d - loss(s[SPEED], p)) < 0.0)


@njit(cache=True)
def settle(t: float, s: Floats, direction: float, mode: int, p: Physics) -> tuple[float, int]:
    """Mode and direction just after an event; the state is put exactly on the event.

    Parameters
    ----------
    t : float
        Time since the first row [s].
    s : (10,) array
        State, changed in place.
    direction : float
        Sign that dry friction opposed before.
    mode : int
        The mode before.
    p : Physics
        Truth of the rig.
    """
    if mode != FREE:
        if not _leaves(t, s, mode, p):
            return direction, mode
        return float(np.sign(drive(t, s, p))), FREE
    body = POSITION if p.integrating > 0.0 else SPEED
    if p.stop != np.inf and p.stop_sign * (p.stop - s[body]) <= 1e-12 * (1.0 + abs(p.stop)):
        s[body] = p.stop
        if p.integrating > 0.0:
            s[SPEED] = 0.0
        return direction, STOPPED
    if p.breakaway > 0.0 and direction * s[SPEED] <= 1e-12:
        s[SPEED] = 0.0
        if _leaves(t, s, STUCK, p):
            return float(np.sign(drive(t, s, p))), FREE
        return direction, STUCK
    return direction, FREE


@njit(cache=True)
def advance(
    t: float, end: float, h: float, s: Floats, ramp: Floats, direction: float, mode: int, p: Physics, work: Floats
) -> tuple[float, int]:
    """Integrate the state in place from t to end in steps of at most h, locating every event on the way.

    Parameters
    ----------
    t, end : float
        From when until when [s].
    h : float
        Longest step [s].
    s : (10,) array
        State, changed in place.
    ramp : (3,) array
        Value at the start, target, and start time of the command.
    direction : float
        Sign that dry friction opposes.
    mode : int
        Free, stuck or stopped.
    p : Physics
        Truth of the rig.
    work : (4, 10) array
        Room to work in.
    """
    while end - t > 1e-12 * (1.0 + abs(end)):
        step = min(h, end - t)
        if mode != FREE:
            direction, mode = settle(t, s, direction, mode, p)
        after = _rk4(t, step, s, ramp, direction, mode, p, work)
        if mode == FREE and crossing(after, direction, mode, p) < 0.0:
            low, high = 0.0, step
            for _ in range(BISECTIONS):
                middle = 0.5 * (low + high)
                if crossing(_rk4(t, middle, s, ramp, direction, mode, p, work), direction, mode, p) < 0.0:
                    high = middle
                else:
                    low = middle
            after = _rk4(t, high, s, ramp, direction, mode, p, work)
            for i in range(s.size):
                s[i] = after[i]
            t += high
            direction, mode = settle(t, s, direction, mode, p)
            continue
        for i in range(s.size):  # entry by entry: an assigned slice is compiled with the text of its error, for seconds
            s[i] = after[i]
        t += step
    return direction, mode
