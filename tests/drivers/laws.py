"""Vectors on which every form of the laws is compared, and the laws in Python on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.law import PILaw
from autotune.experiment.relay import RelaySettings, RelayState, relay_step

#: counts of a 10-bit converter; every number a dyadic fraction, so that single precision is exact where it can be
RELAYS = tuple(
    RelaySettings(
        y_centre=512.5,
        midpoint=8000.0,
        amplitude=512.0,
        hysteresis=hysteresis,
        delay_samples=delay,
        smoothing=smoothing,
        plant_sign=sign,
    )
    for hysteresis, delay, smoothing, sign in (
        (0.0, 0.0, 1, 1),
        (0.25, 7.0, 1, -1),
        (20.25, 12.375, 4, -1),
        (3.0, 30.5, 8, 1),
        (5.0, 0.625, 16, -1),
        (40.0, 63.9375, 32, 1),
    )
)
LAWS = tuple(
    PILaw(controller=PIDController(K=K, Ti_s=Ti_s), sample_time_s=2.0**-10, u_min=1000.0, u_max=15000.0, u_rate=u_rate)
    for K, Ti_s, u_rate in ((-0.5, 2.0, 1e30), (3.0, 0.25, 1e30), (40.0, 1.0, 2.0**20), (-2.0, float("inf"), 1e30))
)


def measurements(seed: int, rows: int = 3000) -> FloatArray:
    """Return counts as a limit cycle has them, with noise and steps between its periods, (N,)."""
    random = np.random.default_rng(seed)
    period = random.uniform(150, 400)
    wave = 120.0 * np.sin(2 * np.pi * np.arange(rows) / period) + 20.0 * random.standard_normal(rows).cumsum() / 30.0
    return np.clip(np.round(512.0 + wave + random.uniform(-20, 20, rows)), 0, 1023)


def relay_outputs(settings: RelaySettings, y: FloatArray) -> FloatArray:
    """Return the relay's outputs in Python, (N,)."""
    state, u = RelayState(), np.empty(len(y))
    for k, value in enumerate(y):
        state, u[k] = relay_step(state, settings, float(value))
    return u


def pi_outputs(law: PILaw, y: FloatArray, r: float, u_held: float) -> FloatArray:
    """Return the law's outputs in Python, (N,)."""
    state, u = law.initial(u_held, r, float(y[0])), np.empty(len(y))
    for k, value in enumerate(y):
        u[k], state = law.step(state, r, float(value))
    return u


def longest_pending(settings: RelaySettings, y: FloatArray) -> int:
    """Return how many decisions are on their way at most."""
    state, longest = RelayState(), 0
    for value in y:
        state, _ = relay_step(state, replace(settings), float(value))
        longest = max(longest, len(state.pending))
    return longest
