"""What moves a rig in a recording: set-points, dithers, relays, random steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sim.conceal.loop import OPEN_LOOP, PD, PI, RELAY, Law
from sim.conceal.physics import Floats


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """Controller, set-point and dither of one recording, and what its sidecar states of the controller."""

    name: str
    law: Law
    r: Floats
    dither: Floats
    record_r: bool
    stated: dict[str, Any]


EXCITATIONS = {
    "ball_in_tube": ("pi_steps", "pi_multisine", "pi_rms", "relay"),
    "servo": ("relay", "square", "rms", "dither"),
    "process": ("relay", "prbs", "steps", "pi"),
}


def six(value: float) -> float:
    """Round to the six digits that a sidecar holds, so that the stated controller is the one that runs."""
    return float(f"{value:.6g}")


def multisine(rng: np.random.Generator, t: Floats, lines: int, low: float, high: float, rms: float) -> Floats:
    """Return sinusoids of equal amplitude and random phase at frequencies drawn evenly on a logarithmic scale.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of frequencies and phases.
    t : (N,) array
        Time stamps [s].
    lines : int
        How many sinusoids.
    low, high : float
        Range of their frequencies [Hz].
    rms : float
        Of the sum.

    Returns
    -------
    (N,) array
        The signal.
    """
    hertz = np.exp(rng.uniform(np.log(low), np.log(high), lines))
    phase = rng.uniform(0.0, 2.0 * np.pi, lines)
    return np.asarray(rms * np.sqrt(2.0 / lines) * np.sin(2.0 * np.pi * np.outer(t, hertz) + phase).sum(axis=1))


def staircase(rng: np.random.Generator, t: Floats, shortest: float, longest: float, low: float, high: float) -> Floats:
    """Piecewise constant signal: random levels held for random times.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of levels and times.
    t : (N,) array
        Time stamps [s].
    shortest, longest : float
        Range of the times [s].
    low, high : float
        Range of the levels.

    Returns
    -------
    (N,) array
        The signal.
    """
    values = np.empty(len(t))
    begin = t[0]
    while begin <= t[-1]:
        end = begin + rng.uniform(shortest, longest)
        values[(t >= begin) & (t < end)] = rng.uniform(low, high)
        begin = end
    return values


def ball(rng: np.random.Generator, name: str, t: Floats, Ts: float) -> Excitation:
    """Ball in a tube: the paper's PI with a dither on the command, or a relay.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of what is random.
    name : str
        Which excitation.
    t : (N,) array
        Time stamps [s].
    Ts : float
        Sample time [s].
    """
    r = np.full(len(t), 5.0)
    bias = 5.0 + rng.normal(0.0, 0.01)
    if name == "relay":
        half, hysteresis = six(rng.uniform(0.05, 0.13)), six(rng.uniform(0.05, 0.3))
        rows = int(rng.integers(0, round(0.25 / Ts)))
        slow = rng.choice([0.0, 0.25]) * half * np.sin(2 * np.pi * rng.uniform(0.08, 0.2) * t + rng.uniform(0, 6.28))
        law = Law(kind=RELAY, half_amplitude=half, hysteresis=hysteresis, inserted_rows=rows)
        stated = {"kind": "relay", "half_amplitude": half, "hysteresis": hysteresis, "inserted_delay": rows * Ts}
        return Excitation(name=name, law=law, r=r, dither=5.0 + slow, record_r=False, stated=stated)
    if name == "pi_multisine":
        dither = multisine(rng, t, 8, 0.2, 4.0, float(np.exp(rng.uniform(np.log(0.045), np.log(0.13)))))
    else:
        dither = multisine(rng, t, 6, 0.4, 4.0, rng.uniform(0.018, 0.03))
    if name == "pi_steps":
        r = staircase(rng, t, 2.0, 6.0, 3.0, 7.0)
    elif name == "pi_rms":
        r = 5.0 + multisine(rng, t, 6, 0.06, 0.8, rng.uniform(0.65, 1.25))
    stated = {"kind": "PI", "K": -0.023, "T_I": 3}
    law = Law(kind=PI, K=-0.023, T_I=3.0, bias=bias)
    return Excitation(name=name, law=law, r=r, dither=dither, record_r=name != "pi_multisine", stated=stated)


def servo(rng: np.random.Generator, name: str, t: Floats, Ts: float, K: float) -> Excitation:
    """Position servo: P or PD on a square or random set-point, strong dither, or a relay.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of what is random.
    name : str
        Which excitation.
    t : (N,) array
        Time stamps [s].
    Ts : float
        Sample time [s].
    K : float
        The chain's gain.
    """
    scale = 8.0 * K / 20.0  # a position the drive reaches in comfort, rad or mm
    r = np.zeros(len(t))
    if name == "relay":
        half, hysteresis = six(rng.uniform(0.6, 2.2)), six(0.05 * K)
        rows = int(rng.integers(0, round(0.1 / Ts)))
        swing = [rng.uniform(0.1, 0.3) * half * np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28)) for f in _two(rng)]
        law = Law(kind=RELAY, half_amplitude=half, hysteresis=hysteresis, inserted_rows=rows)
        stated = {"kind": "relay", "half_amplitude": half, "hysteresis": hysteresis, "inserted_delay": rows * Ts}
        return Excitation(name=name, law=law, r=r, dither=swing[0] + swing[1], record_r=False, stated=stated)
    gain, T_d = six(rng.uniform(4.4, 5.8) / K), float(rng.choice([0.0, 0.05]))
    dither = np.zeros(len(t))
    if name == "square":
        T_d = 0.05
        size = rng.uniform(0.7, 1.35) * scale
        levels = staircase(rng, t, 1.0, 4.0, -1.0, 1.0)
        r = size * np.sign(levels) * np.where(abs(levels) > 0.5, 1.0, 0.5)
    elif name == "rms":
        r = multisine(rng, t, 7, 0.08, 2.0, rng.uniform(0.6, 0.9) * scale)
        dither = multisine(rng, t, 10, 0.5, 8.0, rng.uniform(0.25, 0.4))
    else:
        r = multisine(rng, t, 3, 0.08, 0.3, rng.uniform(0.3, 0.5) * scale)
        dither = multisine(rng, t, 8, 0.3, 8.0, rng.uniform(1.2, 1.8))
    stated = {"kind": "PD" if T_d > 0 else "P", "K": gain, "T_d": T_d}
    law = Law(kind=PD, K=gain, T_d=T_d)
    return Excitation(name=name, law=law, r=r, dither=dither, record_r=True, stated=stated)


def _two(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(0.1, 0.4)), float(rng.uniform(0.4, 1.2))


def process(rng: np.random.Generator, name: str, t: Floats, Ts: float, K: float, u0: float, y0: float) -> Excitation:
    """Level or thermal process: open-loop steps, a relay, or a PI with steps in set-point and dither.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of what is random.
    name : str
        Which excitation.
    t : (N,) array
        Time stamps [s].
    Ts : float
        Sample time [s].
    K : float
        The chain's gain.
    u0, y0 : float
        The operating point.
    """
    r = np.full(len(t), y0)
    open_loop = {"kind": "open loop"}
    if name == "prbs":
        sign = np.sign(staircase(rng, t, 20.0, 120.0, -1.0, 1.0))
        wide = rng.uniform(7.0, 19.0)
        u = u0 + wide * sign + staircase(rng, t, 40.0, 150.0, -0.3, 0.3) * wide
        return Excitation(name=name, law=Law(kind=OPEN_LOOP), r=r, dither=u, record_r=False, stated=open_loop)
    if name == "steps":
        u = staircase(rng, t, 40.0, 200.0, u0 - 16.0, u0 + 16.0)
        return Excitation(name=name, law=Law(kind=OPEN_LOOP), r=r, dither=u, record_r=False, stated=open_loop)
    if name == "relay":
        half = six(rng.uniform(9.0, 16.0))
        hysteresis = six(rng.uniform(0.08, 0.22) * half * abs(K))
        rows = int(rng.integers(0, 8))
        mid = u0 + staircase(rng, t, 60.0, 350.0, -0.35, 0.35) * half
        law = Law(kind=RELAY, half_amplitude=half, hysteresis=hysteresis, inserted_rows=rows, low=0.0, high=100.0)
        stated = {"kind": "relay", "half_amplitude": half, "hysteresis": hysteresis, "inserted_delay": rows * Ts}
        return Excitation(name=name, law=law, r=r, dither=mid, record_r=False, stated=stated)
    r = y0 + staircase(rng, t, 60.0, 350.0, -13.0, 13.0) * abs(K)
    dither = staircase(rng, t, 15.0, 70.0, -8.0, 8.0)
    gain = six(0.8 / K)
    law = Law(kind=PI, K=gain, T_I=40.0, bias=u0, low=0.0, high=100.0)
    stated = {"kind": "PI", "K": gain, "T_I": 40}
    return Excitation(name=name, law=law, r=r, dither=dither, record_r=True, stated=stated)
