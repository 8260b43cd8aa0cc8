"""Control loops with a control valve, as an operator records them: set-point, controller output and process value.

A PI controller in % drives a valve, the valve a plant of one or two lags and a dead time, or an integrating one; load
and sensor disturb it. The valve is linear or has one of the published faults::

    play       the stem follows u - w with a gap of the full width S
    choudhury  (S, J) of Choudhury et al.: sticks when u stops or turns, slips by J, then runs (S - J)/2 behind u
    he         He et al.: sticks at every sample; |u - w| must exceed f_S = (S + J)/2, it then rests (S - J)/2 behind
    friction   a stem on a spring with static and sliding friction, integrated in small steps (Karnopp)

Nothing is shared with any code that looks for these faults in a recording.

References
----------
Choudhury, Thornhill and Shah, Modelling valve stiction, Control Engineering Practice 13, 2005.
He, Wang, Pottmann and Qin, A curve fitting method for detecting valve stiction, Ind. Eng. Chem. Res. 46, 2007.
Karnopp, Computer simulation of stick-slip friction, J. Dyn. Syst. Meas. Control 107, 1985.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ValveKind: TypeAlias = Literal["linear", "play", "choudhury", "he", "friction"]

_KINDS: dict[str, int] = {"linear": 0, "play": 1, "choudhury": 2, "he": 3, "friction": 4}
_STEPS = 20  # of the plant and the stem within a cycle of the controller


@dataclass(frozen=True, kw_only=True)
class ValveLoop:
    """A loop of PI controller, valve and plant; commands in % of the valve's span.

    Attributes
    ----------
    valve : str
        Its fault, see the module.
    S, J : float
        Dead band plus stick band, and slip jump [%].
    gain : float
        Of the plant [y unit/%], or [y unit/%/s] where it integrates; its sign is the loop's.
    lag_s, second_lag_s : float
        Time constants [s]; an integrating plant has the second one alone.
    dead_time_s : float
        Dead time [s].
    integrating : bool
        Whether the first lag is an integrator.
    K, Ti_s : float
        Controller in ISA standard form, u = K (e + 1/Ti int e).
    cycle_s : float
        Of the controller [s].
    """

    valve: ValveKind = "linear"
    S: float = 0.0
    J: float = 0.0
    gain: float = 1.0
    lag_s: float = 10.0
    second_lag_s: float = 0.0
    dead_time_s: float = 2.0
    integrating: bool = False
    K: float = 1.0
    Ti_s: float = 10.0
    cycle_s: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """What acts on the loop from outside, row by row of the controller's cycle.

    Attributes
    ----------
    setpoint : (N,) array
        Set-point, as a deviation from the operating point [y unit].
    load : (N,) array
        Added to the valve's position at the plant's input [%].
    noise : (N,) array
        Of the sensor [y unit].
    """

    setpoint: FloatArray
    load: FloatArray
    noise: FloatArray


def simulate_loop(loop: ValveLoop, around: Surroundings) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return controller output [%], measurement and true valve position [%] in every cycle.

    The operating point is u = 50 %, y = 0. The controller reads y, then acts; its output is held for one cycle.

    Parameters
    ----------
    loop : ValveLoop
        Plant, valve and controller.
    around : Surroundings
        Set-point, load and noise in N cycles.

    Returns
    -------
    u, y, position : (N,) array
        In %, in y's unit, and in %.
    """
    plant = (loop.gain, loop.lag_s, loop.second_lag_s, 1.0 if loop.integrating else 0.0)
    delay = round(loop.dead_time_s / loop.cycle_s * _STEPS)
    u, y, position = _simulated(
        _KINDS[loop.valve], loop.S, loop.J, plant, delay, loop.K, loop.Ti_s, loop.cycle_s,
        around.setpoint, around.load, around.noise,
    )  # fmt: skip
    return u, y, position


def ultimate_gain(loop: ValveLoop) -> tuple[float, float]:
    """Return the controller gain at which the loop, with its Ti, begins to swing, and its frequency [rad/s].

    The smallest frequency at which the phase of the loop is -180 deg, by bisection on its unwrapped phase; the held
    command counts as half a cycle of dead time.
    """

    def phase(omega: float) -> float:
        lag = -math.pi / 2 if loop.integrating else -math.atan(omega * loop.lag_s)
        dead = omega * (loop.dead_time_s + 0.5 * loop.cycle_s)
        return lag - math.atan(omega * loop.second_lag_s) - dead - math.pi / 2 + math.atan(omega * loop.Ti_s)

    omegas = np.geomspace(1e-5, math.pi / loop.cycle_s, 4000)
    below = np.flatnonzero(np.array([phase(w) for w in omegas]) <= -math.pi)
    first = below[np.argmax(below > 0)]
    low, high = float(omegas[max(first - 1, 0)]), float(omegas[first])
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if phase(middle) > -math.pi else (low, middle)
    first_order = loop.gain / (high if loop.integrating else math.hypot(1.0, high * loop.lag_s))
    size = abs(first_order) / math.hypot(1.0, high * loop.second_lag_s) * math.hypot(1.0, 1.0 / (high * loop.Ti_s))
    return math.copysign(1.0 / size, loop.gain), high


@njit(cache=True)
def _choudhury(u: float, before: float, state: FloatArray, S: float, J: float) -> float:
    """Return the position; state: position, u when it came to rest, direction, last change of u, whether it rests."""
    change = u - before
    turned = change * state[3] < 0.0 or change == 0.0
    if turned and state[4] == 0.0:
        state[1], state[4] = before, 1.0
    if state[4] == 1.0:
        # same direction: the slip jump alone must be overcome; other direction: the dead band as well
        moved = u - state[1]
        if abs(moved) > S or (moved * state[2] > 0.0 and abs(moved) > J):
            state[4] = 0.0
            state[2] = 1.0 if moved > 0.0 else -1.0
    if state[4] == 0.0:
        if change != 0.0:
            state[2] = 1.0 if change > 0.0 else -1.0
        state[0] = u - 0.5 * state[2] * (S - J)
    if change != 0.0:
        state[3] = change
    return float(state[0])


@njit(cache=True)
def _stem(u: float, stem: FloatArray, S: float, J: float, h: float) -> float:
    """Return the stem's position after a step; stem: position, speed. Its spring and damper settle within a second."""
    static, sliding, mass, damping = 0.5 * (S + J), 0.5 * (S - J), 0.01, 0.25
    force = u - stem[0]
    if stem[1] == 0.0:
        if abs(force) <= static:
            return float(stem[0])
        stem[1] = math.copysign(1e-9, force)
    direction = 1.0 if stem[1] > 0.0 else -1.0
    speed = (stem[1] + h / mass * (force - sliding * direction)) / (1.0 + h * damping / mass)
    if speed * direction <= 0.0:
        stem[1] = 0.0
    else:
        stem[1] = speed
        stem[0] += h * speed
    return float(stem[0])


@njit(cache=True)
def _valve(kind: int, u: float, before: float, state: FloatArray, S: float, J: float) -> float:
    """Return the position of a valve that acts once in a cycle."""
    if kind == 1:
        state[0] = min(max(state[0], u - 0.5 * S), u + 0.5 * S)
    elif kind == 2:
        return float(_choudhury(u, before, state, S, J))
    elif kind == 3:
        away = u - state[0]
        if abs(away) > 0.5 * (S + J):
            state[0] = u - math.copysign(0.5 * (S - J), away)
    else:
        state[0] = u
    return float(state[0])


@njit(cache=True)
def _simulated(
    kind: int, S: float, J: float, plant: tuple[float, float, float, float], delay: int, K: float, Ti: float,
    cycle: float, setpoint: FloatArray, load: FloatArray, noise: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    gain, lag, second, integrating = plant
    n, h = setpoint.size, cycle / _STEPS
    u, y, position = np.empty(n), np.empty(n), np.empty(n)
    pipe = np.full(delay + 1, 0.0)
    keep = math.exp(-h / lag) if lag > 0.0 else 0.0
    keep_second = math.exp(-h / second) if second > 0.0 else 0.0
    state = np.array([50.0, 50.0, 1.0, 0.0, 0.0])
    stem = np.array([50.0, 0.0])
    first, level, integral, before, at = 0.0, 0.0, 0.0, 50.0, 0
    for k in range(n):
        y[k] = level + noise[k]
        error = setpoint[k] - y[k]
        wanted = 50.0 + K * error + integral + K * error * cycle / Ti
        u[k] = min(max(wanted, 0.0), 100.0)
        if u[k] == wanted:  # no wind-up
            integral += K * error * cycle / Ti
        if kind != 4:
            position[k] = _valve(kind, u[k], before, state, S, J)
        for _ in range(_STEPS):
            if kind == 4:
                position[k] = _stem(u[k], stem, S, J, h)
            pipe[at] = position[k] - 50.0 + load[k]
            at = (at + 1) % pipe.size
            driven = gain * pipe[at]
            first = first + h * driven if integrating else keep * first + (1.0 - keep) * driven
            level = keep_second * level + (1.0 - keep_second) * first
        before = u[k]
    return u, y, position
