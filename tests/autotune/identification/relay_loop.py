"""Relay loops on linear plants, for tests: exact hold, switching at samples, noise on the measurement."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.signal import cont2discrete, tf2ss

from autotune.models import TransferFunction

BALL = TransferFunction(num=(-65.5,), den=(2.02e-5, 0.007328, 0.3836, 1.0, 0.0))


def held(plant: TransferFunction, dt_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the exact discrete model of the plant under a zero-order hold; no dead time."""
    a, b, c, _, _ = cont2discrete(tf2ss(plant.num, plant.den), dt_s)
    return a, b[:, 0], c[0]


def drive(plant: TransferFunction, u: np.ndarray, dt_s: float) -> np.ndarray:
    """Return the output at the samples of a plant at rest, before that sample's u acts."""
    a, b, c = held(plant, dt_s)
    x = np.zeros(b.size)
    y = np.empty(u.size)
    for k, value in enumerate(u):
        y[k] = c @ x
        x = a @ x + b * value
    return y


def relay_loop(
    plant: TransferFunction,
    *,
    d: float,
    hysteresis: float,
    delay: float = 0.0,
    noise: np.ndarray,
    dt_s: float = 0.01,
    midpoint_error: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return t, u, y under a relay with hysteresis and an inserted delay in samples, fractions included."""
    a, b, c = held(plant, dt_s)
    sign = 1.0 if plant.num[0] > 0 else -1.0
    u, y = _relay_loop(np.ascontiguousarray(a), b, c, sign, d, hysteresis, delay, noise, midpoint_error)
    return dt_s * np.arange(noise.size), u, y


@njit(cache=True)
def _relay_loop(
    a: np.ndarray,
    b: np.ndarray,
    c: np.ndarray,
    sign: float,
    d: float,
    hysteresis: float,
    delay: float,
    noise: np.ndarray,
    midpoint_error: float,
) -> tuple[np.ndarray, np.ndarray]:
    n = noise.size
    u, y, states = np.empty(n), np.empty(n), np.ones(n)
    x = np.zeros(b.size)
    whole = int(delay)
    part = delay - whole
    for k in range(n):
        y[k] = np.sum(c * x) + noise[k]
        states[k] = states[k - 1] if k else 1.0
        if sign * y[k] > hysteresis:
            states[k] = -1.0
        elif sign * y[k] < -hysteresis:
            states[k] = 1.0
        now = states[k - whole] if k >= whole else 1.0
        before = states[k - whole - 1] if k >= whole + 1 else 1.0
        u[k] = 5.0 + d * ((1.0 - part) * now + part * before)
        drive_now = u[k] - 5.0 + midpoint_error
        new = np.zeros(b.size)
        for i in range(b.size):
            new[i] = np.sum(a[i] * x) + b[i] * drive_now
        x = new
    return u, y


def last_periods(t: np.ndarray, u: np.ndarray, periods: int, d: float) -> np.ndarray:
    """Return the mask of the last whole periods and two rows before them."""
    rises = np.flatnonzero(np.diff((u > 5.0).astype(int)) > 0) + 1
    return np.asarray(t >= t[rises[-1 - periods]] - 2.5 * (t[1] - t[0]))
