"""Something happens to a rig while it is recorded: a lid is opened, a supply falls; when it did is found."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.diagnosis import diagnose
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

STEP_S, ROWS, AT = 2.0, 1600, 0.55


def heated(seed: int, gain: float = 0.0, loss: float = 0.0) -> Recording:
    """tau dx/dt = -(1 + loss) x + K (1 + gain) u, the brackets from a time on; exact between samples."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(10.0, 60.0, ROWS // 40 + 1), 40)[:ROWS]
    x = np.zeros(ROWS)
    for k in range(ROWS - 1):
        more, less = (1.0 + gain, 1.0 + loss) if k >= AT * ROWS else (1.0, 1.0)
        keeps = np.exp(-STEP_S * less / 120.0)
        x[k + 1] = keeps * x[k] + (1.0 - keeps) * 0.8 * more * u[k] / less
    return Recording(t=STEP_S * np.arange(ROWS), u=u, y=22.0 + x + 0.05 * rng.normal(size=ROWS), name="block")


def model() -> Model:
    heater = Block(name="heater", place="plant", dynamics=TransferFunction(num=(0.75,), den=(140.0, 1.0)))
    ports = Port(unit="%"), Port(unit="degC", offset=22.0)
    return Model(name="heated block", input=ports[0], output=ports[1], blocks=(heater,))


@pytest.mark.parametrize(
    ("name", "change"), [("environment.loss_step", {"loss": 0.2}), ("environment.gain_step", {"gain": -0.15})]
)
def test_an_event_is_named_with_its_time_and_is_no_property_of_the_rig(name: str, change: dict[str, float]) -> None:
    found = diagnose(model(), [heated(2, **change)])
    assert found.verdict == "effect"
    assert found.effects[0].name == name
    parameters = found.effects[0].parameters
    assert parameters["time"].value == pytest.approx(AT * ROWS * STEP_S, abs=10 * STEP_S)
    (size,) = change.values()
    assert parameters["change"].value == pytest.approx(size, rel=0.15)
    assert found.effects[0].windows[0][1] == pytest.approx(parameters["time"].value)
    assert not found.extended_model.effects
    lag = found.extended_model.blocks[0].dynamics
    assert (lag.num[0], lag.den[0]) == (pytest.approx(0.8, rel=0.02), pytest.approx(120.0, rel=0.03))
