"""Start states that a stop holds are found anew from the windows' beginnings."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

DT, NOISE, STOP = 0.02, 0.01, 0.4


def carriage(rows: int = 1200, fine: int = 20) -> Recording:
    """Carriage with a speed lag of 0.2 s that runs against a stop every few seconds, and does not rebound."""
    rng = np.random.default_rng(3)
    t = DT * np.arange(rows, dtype=np.float64)
    u = np.where(np.sin(2.1 * t) > 0.0, 1.0, -1.0)
    y, v, x = np.empty(rows), 0.0, -0.3
    for k in range(rows):
        y[k] = x
        for _ in range(fine):
            v += DT / fine * (u[k] - v) / 0.2
            x += DT / fine * v
            if x > STOP:
                x, v = STOP, min(v, 0.0)
    return Recording(t=t, u=u, y=y + NOISE * rng.normal(size=rows))


@pytest.fixture
def chain() -> Model:
    speed = Block(name="speed", place="plant", dynamics=TransferFunction(num=(1.0,), den=(0.2, 1.0)))
    place = Block(name="position", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0)))
    return Model(name="carriage", input=Port(unit="V"), output=Port(unit="m"), blocks=(speed, place))
