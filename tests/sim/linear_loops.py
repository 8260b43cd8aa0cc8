"""Loops in operation without any fault, drawn at random: what is said of their valves is false.

Plants of one or two lags or an integrator with dead time, a PI from sluggish to lively; the disturbance is white,
coloured, a random walk or swings; some commands run into a limit, some readings are quantised, and a historian keeps
every row or one in so many.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.signal import lfilter

from tests.sim.valve_loop import FloatArray

Disturbance: TypeAlias = Literal["white", "coloured", "walk", "swings"]
DISTURBANCES: tuple[Disturbance, ...] = ("white", "coloured", "walk", "swings")
#: Rows that settle before the record begins.
_SETTLES = 300


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearLoop:
    """A recorded loop.

    Attributes
    ----------
    disturbance : str
        What drives it.
    limited, quantised : bool
        Whether its command ran into a limit, and whether its readings have steps.
    dt_s : float
        Between recorded rows [s].
    u, y : (N,) array
        Command and measurement.
    """

    disturbance: Disturbance
    limited: bool
    quantised: bool
    dt_s: float
    u: FloatArray
    y: FloatArray


def linear_loop(seed: int) -> LinearLoop:
    """Return a loop: the disturbance, the limit and the steps of the readings take turns, the rest is drawn."""
    random = np.random.default_rng((seed, 29))
    disturbance = DISTURBANCES[seed % 4]
    limited, quantised = seed // 4 % 2 == 1, seed // 8 % 2 == 1
    rows, every = int(random.choice([300, 750, 2000])), int(random.choice([1, 1, 3, 10]))
    lag, delay = _between(random, 2.0, 60.0), int(random.integers(1, 12))
    second, integrates = (random.uniform(0.1, 0.9) * lag if random.random() < 0.5 else 0.0), random.random() < 0.3
    # SIMC with a closed loop from four times as slow to lively (Skogestad 2003)
    slowness = delay * _between(random, 0.7, 4.0) + second
    gain = lag / (slowness + delay)
    reset = 4.0 * (slowness + delay) if integrates else min(lag, 4.0 * (slowness + delay))
    pushed = _drawn_disturbance(random, disturbance, rows * every + _SETTLES, 6.0 * (slowness + delay))
    noise = _between(random, 0.01, 0.3) * random.normal(size=pushed.size)
    at_input = random.random() < 0.5
    limit = 0.7 * float(np.std(pushed)) if limited else np.inf
    u, y = _run((lag, second, delay, integrates), (gain, reset, limit), pushed, noise, at_input=at_input)
    u, y = u[_SETTLES::every], y[_SETTLES::every]
    if quantised:
        u, y = (x if np.ptp(x) == 0.0 else np.round(x / (step := np.ptp(x) / 400.0)) * step for x in (u, y))
    dt_s = every * float(random.choice([0.2, 1.0, 10.0]))
    return LinearLoop(disturbance=disturbance, limited=limited, quantised=quantised, dt_s=dt_s, u=u, y=y)


def _between(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def _drawn_disturbance(random: np.random.Generator, kind: Disturbance, rows: int, period: float) -> FloatArray:
    pushed: FloatArray = random.normal(size=rows)
    if kind == "coloured":
        keep = random.uniform(0.5, 0.98)
        pushed = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], pushed)
    elif kind == "walk":
        pushed = 0.1 * np.cumsum(pushed)
    elif kind == "swings":
        swing = period * _between(random, 0.8, 6.0)
        phase = 2.0 * np.pi * np.arange(rows) / swing + random.choice([0.0, 0.1]) * np.cumsum(pushed)
        pushed = np.sin(phase) + 0.1 * pushed
    return pushed


def _run(
    plant: tuple[float, float, int, bool], controller: tuple[float, float, float], pushed: FloatArray,
    noise: FloatArray, *, at_input: bool,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return u and y, row by row: the controller reads y, then acts; its integral stops at the limit."""
    (lag, second, delay, integrates), (gain, reset, limit) = plant, controller
    keep, keep_second = np.exp(-1.0 / lag), np.exp(-1.0 / second) if second else 0.0
    u, y = np.zeros(noise.size), np.zeros(noise.size)
    x = z = total = 0.0
    for k in range(noise.size):
        acts = (u[k - delay] if k >= delay else 0.0) + (pushed[k] if at_input else 0.0)
        x = x + acts / lag if integrates else keep * x + (1.0 - keep) * acts
        z = keep_second * z + (1.0 - keep_second) * x
        y[k] = z + noise[k] + (0.0 if at_input else pushed[k])
        total -= gain / reset * y[k]
        wanted = total - gain * y[k]
        u[k] = min(max(wanted, -limit), limit)
        total += u[k] - wanted
    return u, y
