"""Loops in operation with a known cause: drawn at random, simulated, and recorded as a historian would.

| kind | what is so |
|---|---|
| stiction, play | the valve's fault; load and noise besides |
| tight_noise | gain 2 to 12 % below the limit of stability; set-point at rest, noise and load ring it |
| tight_steps | the same with steps of the set-point |
| outside | a sine of the load, 1.3 to 5 of the loop's own periods |
| wandering | the same with a phase that wanders: another loop's ringing |
| quiet, steps | a healthy loop, with the set-point at rest and with steps |
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tests.sim.valve_loop import FloatArray, Surroundings, ValveKind, ValveLoop, simulate_loop, ultimate_gain

CaseKind: TypeAlias = Literal[
    "stiction", "play", "tight_noise", "tight_steps", "outside", "wandering", "quiet", "steps"
]
KINDS: tuple[CaseKind, ...] = (
    "stiction", "play", "tight_noise", "tight_steps", "outside", "wandering", "quiet", "steps",
)  # fmt: skip
#: How another loop may swing this one.
Shape: TypeAlias = Literal["triangle", "square", "saw"]
SHAPES: tuple[Shape, ...] = ("triangle", "square", "saw")
_STICKING: tuple[ValveKind, ...] = ("choudhury", "he", "friction")


@dataclass(frozen=True, kw_only=True, eq=False)
class ValveCase:
    """A recorded loop and what is true of it.

    Attributes
    ----------
    kind : str
        See the module.
    loop : ValveLoop
        The loop.
    dt_s : float
        Between recorded rows; the controller may be faster [s].
    r, u, y, position : (N,) array
        Set-point, controller output [%], measurement, true valve position [%].
    """

    kind: CaseKind
    loop: ValveLoop
    dt_s: float
    r: FloatArray
    u: FloatArray
    y: FloatArray
    position: FloatArray

    @property
    def clear(self) -> bool:
        """Whether a faulty valve turned at least ten times and moved by its band: otherwise y holds nothing of it."""
        moved = np.diff(self.position)
        signs = np.sign(moved[np.abs(moved) > 1e-9])
        return bool(np.sum(np.diff(signs) != 0) >= 10 and np.ptp(self.position) >= self.loop.S)


def valve_case(kind: CaseKind, seed: int, rows: int = 2000) -> ValveCase:
    """Return a loop of a kind, drawn at random.

    Parameters
    ----------
    kind : str
        See the module.
    seed : int
        Of the case.
    rows : int
        Recorded rows, 12 to 60 in the loop's own period.
    """
    random = np.random.default_rng((seed, KINDS.index(kind)))
    loop, limit, omega = _plant(random)
    period = 2.0 * math.pi / omega
    every = max(1, round(period / random.uniform(12.0, 60.0)))
    n = rows * every
    # what one percent of the valve does to y within the loop's own period
    size = abs(loop.gain) * (period if loop.integrating else 1.0)
    margin = random.uniform(1.02, 1.12) if kind.startswith("tight") else random.uniform(2.0, 4.0)
    loop = replace(_faulty(loop, kind, random), K=limit / margin)
    load = _wandering(random, n, 3.0 * period, _between(random, 0.1, 1.0))
    if kind in ("outside", "wandering"):
        load = load + random.uniform(2.0, 8.0) * np.sin(_phase(random, n, period, wanders=kind == "wandering"))
    setpoint = np.zeros(n)
    if kind in ("steps", "tight_steps"):
        setpoint = 5.0 * size * np.repeat(random.normal(size=rows // 100 + 1), 100 * every)[:n]
    noise = size * _between(random, 0.02, 0.3) * random.normal(size=n)
    u, y, position = simulate_loop(loop, Surroundings(setpoint=setpoint, load=load, noise=noise))
    seen = slice(0, None, every)
    return ValveCase(
        kind=kind, loop=loop, dt_s=every * loop.cycle_s, r=setpoint[seen], u=u[seen], y=y[seen],
        position=position[seen],
    )  # fmt: skip


def swung_from_outside(shape: Shape, seed: int, *, wanders: bool, rows: int = 1500) -> ValveCase:
    """Return a sound loop that another loop swings, as one with a sticking valve does: not by a sine.

    Parameters
    ----------
    shape : str
        Of the load over a period.
    seed : int
        Of the case.
    wanders : bool
        Whether the load's phase wanders.
    rows : int
        Recorded rows, 12 to 60 in the loop's own period.
    """
    random = np.random.default_rng((seed, 77))
    loop, limit, omega = _plant(random)
    own = 2.0 * math.pi / omega
    every = max(1, round(own / random.uniform(12.0, 60.0)))
    n = rows * every
    size = abs(loop.gain) * (own if loop.integrating else 1.0)
    loop = replace(loop, K=limit / random.uniform(2.0, 4.0))
    load = _wandering(random, n, 3.0 * own, _between(random, 0.1, 1.0))
    period, steps = own * _between(random, 1.3, 5.0), np.cumsum(random.normal(size=n))
    phase = 2.0 * math.pi * np.arange(n) / period + math.sqrt(2.0 * math.pi * 0.02 / period) * wanders * steps
    swing = {
        "triangle": 2.0 / math.pi * np.arcsin(np.sin(phase)), "square": np.sign(np.sin(phase)),
        "saw": 2.0 * (phase / (2.0 * math.pi) % 1.0) - 1.0,
    }[shape]  # fmt: skip
    load = load + random.uniform(2.0, 8.0) * swing
    noise = size * _between(random, 0.02, 0.3) * random.normal(size=n)
    u, y, position = simulate_loop(loop, Surroundings(setpoint=np.zeros(n), load=load, noise=noise))
    seen = slice(0, None, every)
    return ValveCase(
        kind="wandering" if wanders else "outside", loop=loop, dt_s=every * loop.cycle_s, r=np.zeros(rows), u=u[seen],
        y=y[seen], position=position[seen],
    )  # fmt: skip


def _between(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(math.log(low), math.log(high))))


def _plant(random: np.random.Generator) -> tuple[ValveLoop, float, float]:
    """Return a plant with its integral time, its limit of gain and its own frequency [rad/s]."""
    lag = _between(random, 3.0, 60.0)
    dead = lag * _between(random, 0.1, 1.5)
    gain = float(random.choice([-1.0, 1.0])) * _between(random, 0.37, 2.7)
    if random.random() < 0.2:
        loop = ValveLoop(
            gain=gain / lag, integrating=True, second_lag_s=0.3 * lag, dead_time_s=dead, Ti_s=6.0 * (dead + 0.3 * lag)
        )
    else:
        second = float(random.choice([0.0, 0.3, 0.8])) * lag
        loop = ValveLoop(
            gain=gain, lag_s=lag, second_lag_s=second, dead_time_s=dead,
            Ti_s=max(lag, 0.5 * dead) * random.uniform(0.6, 1.3),
        )  # fmt: skip
    return (loop, *ultimate_gain(loop))


def _faulty(loop: ValveLoop, kind: CaseKind, random: np.random.Generator) -> ValveLoop:
    if kind not in ("stiction", "play"):
        return loop
    band = random.uniform(2.0, 12.0)
    if kind == "play":
        return replace(loop, valve="play", S=band)
    return replace(loop, valve=_STICKING[random.integers(3)], S=band, J=band * random.uniform(0.2, 1.0))


def _wandering(random: np.random.Generator, n: int, correlation_s: float, sd: float) -> FloatArray:
    """Return a load that wanders: first-order noise."""
    keep = math.exp(-1.0 / correlation_s)
    load, state = np.empty(n), 0.0
    pushed: NDArray[np.float64] = random.normal(size=n) * sd * math.sqrt(1.0 - keep**2)
    for k in range(n):
        state = keep * state + pushed[k]
        load[k] = state
    return load


def _phase(random: np.random.Generator, n: int, own_period: float, *, wanders: bool) -> FloatArray:
    """Return the phase of a sine [rad]; one that wanders loses it in some three periods."""
    period = own_period * _between(random, 1.3, 5.0)
    phase = 2.0 * math.pi * np.arange(n) / period
    if wanders:
        phase = phase + np.cumsum(random.normal(size=n)) * math.sqrt(2.0 * math.pi * 0.05 / period)
    return np.asarray(phase)
