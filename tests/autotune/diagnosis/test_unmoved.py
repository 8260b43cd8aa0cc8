"""Recordings in which nobody moves the command tell nothing of what acts on a command, nor of what bends a reading."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.diagnosis import diagnose
from autotune.diagnosis.evidence.operating_point import unmoved
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording
from tests.autotune.equations.models import one_state


def test_no_effect_of_the_actuator_is_named_where_the_command_stands() -> None:
    t = 0.02 * np.arange(1200)
    noise = 0.01 * np.random.default_rng(1).normal(size=t.size)
    y = 0.4 + 0.01 * t + np.exp(-0.1 * t) * np.cos(np.sqrt(16.0 - 0.01) * t) + noise
    y = 0.1 * np.round(y / 0.1)  # a drift behind a converter, about another centre than the model's
    arm = Block(name="arm", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.2, 16.0)))
    model = Model(name="swing", input=Port(), output=Port(), blocks=(arm,))
    found = diagnose(model, [Recording(t=t, u=np.zeros(t.size), y=y)])
    assert not [e.name for e in found.effects if e.name.startswith("actuator.")]


def test_a_bent_reading_is_not_told_from_the_plant_where_the_command_stands() -> None:
    """y = x + 0.2 x^2 of a free decay is as well the motion of another plant, in other coordinates."""
    t = 0.02 * np.arange(1500)
    x = np.exp(-0.1 * t) * np.cos(np.sqrt(16.0 - 0.01) * t)
    y = x + 0.2 * x**2 + 0.005 * np.random.default_rng(1).normal(size=t.size)
    arm = Block(name="arm", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.2, 16.0)))
    model = Model(name="swing", input=Port(), output=Port(), blocks=(arm,))
    found = diagnose(model, [Recording(t=t, u=np.zeros(t.size), y=y)])
    assert not [e.name for e in found.effects if e.name.startswith(("actuator.", "sensor."))]


def test_a_recording_that_begins_at_rest_under_another_command_begins_with_a_step() -> None:
    """A heater switched on at the first row, behind a lag that the model lacks: later rows alone cannot tell of it."""
    t = np.arange(900.0)
    warm = 1.0 - (170.0 * np.exp(-t / 170.0) - 20.0 * np.exp(-t / 20.0)) / 150.0
    y = 21.0 + 35.0 * warm + 0.05 * np.random.default_rng(3).normal(size=t.size)
    dynamics = TransferFunction(num=(0.7,), den=(150.0, 1.0))
    heater = Block(name="heater", place="plant", dynamics=dynamics, output="temperature", unit="degC")
    model = Model(name="oven", input=Port(unit="%"), output=Port(unit="degC", offset=21.0), blocks=(heater,))
    found = diagnose(model, [Recording(t=t, u=np.full(t.size, 50.0), y=y)])
    assert [e.name for e in found.effects] == ["sensor.lag"]
    assert found.effects[0].parameters["time_constant"].value == pytest.approx(20.0, rel=0.1)
    assert set(found.effects[0].places) >= {"sensor", "actuator"}
    assert "actuator.lag" in unmoved(model, [Recording(t=t, u=np.zeros(t.size), y=y)])


@pytest.mark.parametrize("as_equations", [False, True])
def test_a_part_in_which_an_effect_would_change_nothing_is_not_asked_of_it(as_equations: bool) -> None:
    """A valve that saturates beyond 1 V, driven beyond it in the first minutes alone."""
    rng, rows = np.random.default_rng(5), 2000
    u = np.repeat(rng.uniform(-0.9, 0.9, rows // 20), 20)
    u[: rows // 6] *= 2.2
    y, x = np.empty(rows), 0.0
    for k in range(rows):
        y[k] = x
        x += (1.0 - np.exp(-0.1)) * (min(max(u[k], -1.0), 1.0) - x)
    r = Recording(t=0.1 * np.arange(rows), u=u, y=y + 0.02 * rng.normal(size=rows))
    dynamics = TransferFunction(num=(1.0,), den=(1.0, 1.0))
    valve = Block(name="valve", place="plant", dynamics=dynamics)
    chain = Model(name="valve", input=Port(), output=Port(), blocks=(valve,))
    found = diagnose(one_state("(u - x)/tau", {"tau": {"value": 1.0}}) if as_equations else chain, [r])
    assert [e.name for e in found.effects] == ["actuator.saturation"]
    assert found.effects[0].probability > 0.9
