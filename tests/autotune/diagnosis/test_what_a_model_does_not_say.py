"""A motor whose model does not say that y is a speed: friction is not looked for, and the diagnosis says so."""

from __future__ import annotations

import numpy as np
import pytest

import autotune as at
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

STEP_S, FRICTION = 0.02, 0.4


def turned(seed: int, rows: int = 1200) -> Recording:
    """Return voltage and speed of a motor whose bearing rubs."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(-3.0, 3.0, rows // 40), 40)
    speed, y = 0.0, np.empty(rows)
    for k in range(rows):
        y[k] = speed
        for _ in range(20):
            force = u[k] - speed / 2.0
            held = abs(speed) < 1e-3 and abs(force) <= FRICTION
            speed = 0.0 if held else speed + STEP_S / 20 / 0.1 * (force - FRICTION * np.sign(speed or force))
    return Recording(t=STEP_S * np.arange(rows), u=u, y=y + random.normal(0.0, 0.02, rows), name=f"turn {seed}")


@pytest.mark.parametrize(("output", "name"), [("", None), ("speed", "plant.coulomb_friction")])
def test_friction_is_found_where_y_is_called_a_speed_and_asked_about_where_it_is_not(
    output: str, name: str | None
) -> None:
    lag = Block(name="motor", place="plant", dynamics=TransferFunction(num=(2.0,), den=(0.2, 1.0)), output=output)
    found = at.diagnose(Model(name="motor", input=Port(), output=Port(), blocks=(lag,)), [turned(1), turned(2)])
    assert any("does not say what y is" in sentence for sentence in found.sentences) == (name is None)
    if name is not None:
        (effect,) = found.effects
        assert effect.name == name
        assert effect.parameters["level"].value == pytest.approx(FRICTION, rel=0.1)
