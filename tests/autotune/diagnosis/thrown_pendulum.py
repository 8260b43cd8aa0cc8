"""A pendulum with dry friction that is thrown over: numbers a little off end on another turn."""

from __future__ import annotations

import math

import numpy as np

from autotune.recording import Recording

DT, ROWS, FINE = 0.02, 1500, 10
GRAVITY, DAMPING, FRICTION = 20.0, 0.4, 0.6


def driven(seed: int) -> Recording:
    """A pendulum with dry friction under torques that change every second and throw it over, by fine steps of Heun."""
    rng, h = np.random.default_rng(seed), DT / FINE
    u = np.repeat(rng.uniform(-12.0, 12.0, size=ROWS // 50), 50)

    def rate(x: np.ndarray, torque: float) -> np.ndarray:
        rubbing = FRICTION * math.tanh(x[1] / 1e-3)
        return np.array([x[1], torque - GRAVITY * math.sin(x[0]) - DAMPING * x[1] - rubbing])

    y, x = np.empty(ROWS), np.zeros(2)
    for k in range(ROWS):
        y[k] = x[0]
        for _ in range(FINE):
            x = x + h * rate(x + 0.5 * h * rate(x, u[k]), u[k])
    return Recording(t=DT * np.arange(ROWS), u=u, y=y + 2e-3 * rng.normal(size=ROWS))
