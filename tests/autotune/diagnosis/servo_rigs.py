"""A servo by its own equations with a force that no catalogue knows, recorded under a P controller."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

GAIN, TAU, K = 5.4, 0.23, 0.9


def servo_model(gain: float = GAIN, tau: float = TAU) -> Model:
    """Return the servo as a chain of lag and integrator."""
    return Model(
        name="servo",
        input=Port(unit="V"),
        output=Port(unit="rad"),
        blocks=(
            Block(name="mass", place="plant", dynamics=TransferFunction(num=(gain,), den=(tau, 1.0))),
            Block(name="position", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0))),
        ),
    )


def servo_recording(
    seed: int,
    force: Callable[[float, float], float] = lambda x, v: 0.0,
    *,
    rows: int = 1000,
    period: int = 0,
    shown_gain: float = K,
) -> Recording:
    """Return tau dv/dt = -v + gain (u + force(x, v)) in steps of 4 ms, sampled every 20 ms.

    Parameters
    ----------
    seed : int
        Of set-points and noise.
    force : callable
        Force at the motor's input [V] over position and speed.
    rows : int
        Length.
    period : int
        Rows after which the set-point repeats itself; 0 for random steps beside a sine on the command.
    shown_gain : float
        Gain that the sidecar states; the law runs with K.
    """
    rng = np.random.default_rng(seed)
    dt, v, x = 0.02, 0.0, 0.0
    u, y = np.empty(rows), np.empty(rows)
    k = np.arange(rows)
    aim = np.sign(np.sin(2.0 * np.pi * (k + 0.5) / period)) if period else np.repeat(
        rng.uniform(-2.0, 2.0, rows // 100 + 1), 100
    )[:rows]  # fmt: skip
    added = 0.0 * k if period else 0.3 * np.sin(5.0 * k * dt)
    for i in range(rows):
        y[i] = x + 0.01 * rng.normal()
        u[i] = K * (aim[i] - y[i]) + added[i]
        for _ in range(5):
            # the force is held over each of the steps, whose solution is exact
            rest = GAIN * (u[i] + force(x, v))
            faded = np.exp(-dt / 5 / TAU)
            x += rest * dt / 5 + (v - rest) * TAU * (1.0 - faded)
            v = rest + (v - rest) * faded
    stated = {"controller": {"kind": "P", "K": shown_gain}}
    return Recording(t=dt * k, u=u, y=y, extra={"r": aim}, metadata=stated)
