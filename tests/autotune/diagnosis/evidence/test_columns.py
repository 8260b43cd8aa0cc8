"""Further recorded columns: one that drives the plant is named, others are not."""

from __future__ import annotations

import numpy as np

from autotune.diagnosis import diagnose
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

MODEL = Model(
    name="heater",
    input=Port(unit="%"),
    output=Port(unit="degC"),
    blocks=(Block(name="heater", place="plant", dynamics=TransferFunction(num=(0.8,), den=(60.0, 1.0))),),
)


def heater(ambient_gain: float) -> Recording:
    """60 s y' = 0.8 u + g (ambient - 20) - y, the ambient measured, and an unrelated humidity beside it."""
    rng, dt, n = np.random.default_rng(6), 2.0, 2000
    u = np.repeat(rng.uniform(20.0, 60.0, n // 40), 40)
    ambient = 20.0 + np.repeat(np.cumsum(rng.normal(scale=0.7, size=n // 20)), 20)
    humidity = 40.0 + np.repeat(np.cumsum(rng.normal(size=n // 20)), 20)
    y, state, pole = np.empty(n), 32.0, np.exp(-dt / 60.0)
    for k in range(n):
        y[k] = state
        end = 0.8 * u[k] + ambient_gain * (ambient[k] - 20.0)
        state = end + (state - end) * pole
    extra = {"ambient": ambient, "humidity": humidity}
    return Recording(t=dt * np.arange(n), u=u, y=y + 0.1 * rng.normal(size=n), extra=extra)


def test_a_measured_ambient_temperature_that_the_model_lacks_is_told_by_its_column() -> None:
    found = diagnose(MODEL, [heater(1.0)])
    assert found.verdict == "unexplained"
    assert found.places == ("environment",)
    assert any("the column 'ambient'" in sentence for sentence in found.sentences)


def test_columns_that_drive_nothing_are_not_accused() -> None:
    found = diagnose(MODEL, [heater(0.0)])
    assert found.verdict in ("none", "parameters")
    assert not any(column in sentence for column in ("ambient", "humidity") for sentence in found.sentences)
