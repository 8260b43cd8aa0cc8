"""A twin from a model file: it lives by the model's equations, in whatever steps, and is rehearsed on."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from autotune.cli import app
from autotune.cli.served import device_of
from autotune.config import load_config
from autotune.config.rig import SimulatedRigSettings
from autotune.errors import InputError
from autotune.model_tables import read_model
from drivers.model_plant import ModelPlant, model_plant
from sim.plant import Plant

HEATER = """
name = "heater"
[input]
unit = "%"
[output]
unit = "degC"
offset = 20.0
[[block]]
name = "tank"
place = "plant"
num = [0.8]
den = [3.0, 1.0]
delay = 0.35
"""
BALL = """
name = "ball"
[input]
offset = 5.0
[output]
offset = 5.0
[[block]]
name = "speed"
place = "plant"
num = [-65.5]
den = [0.36, 1.0]
[[block]]
name = "height"
place = "plant"
num = [1.0]
den = [1.0, 0.0]
"""
TANK = """
name = "tank"
[[input]]
column = "u"
[output]
value = "level"
[[state]]
name = "level"
kind = "level"
derivative = "(k*u - a*sqrt(max(level, 0)))"
start = 1.0
[parameters.k]
value = 0.5
[parameters.a]
value = 1.0
"""
CONFIG = """
name = "heater"
[rig]
kind = "modbus_tcp"
registers = {{ y = {{ table = "input", address = 0, type = "float32" }}, u = {{ address = 0, type = "float32" }} }}
[rig.twin]
model = "{model}"
noise = 0.02
[signals]
sample_time_s = 0.1
[limits]
u_min = 0.0
u_max = 100.0
u_safe = 10.0
y_min = 20.0
y_max = 90.0
swing = 8.0
time_s = 3000.0
[operating_point]
y = 60.0
u_guess = 50.0
u_uncertainty = 5.0
[experiment]
points = 3
budget_s = 30.0
gain_sd = 0.03
[design]
noise_gain = 20.0
"""


def plant_from(text: str, folder: Path, *, u_start: float = 10.0, noise: float | None = None) -> ModelPlant:
    path = folder / "model.toml"
    path.write_text(text)
    settings = SimulatedRigSettings(kind="simulated", model=str(path), noise=noise)
    return model_plant(settings, str(path), u_start=u_start)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("models")


@given(
    held=st.lists(st.tuples(st.floats(0.0, 100.0), st.floats(0.01, 2.0)), min_size=1, max_size=8),
    cuts=st.lists(st.floats(0.05, 0.95), max_size=3),
)
def test_a_lag_with_a_dead_time_answers_as_its_solution_does_however_it_is_cut(
    folder: Path, held: list[tuple[float, float]], cuts: list[float]
) -> None:
    plant = plant_from(HEATER, folder)
    assert (plant.u_applied, plant.y_true) == (10.0, pytest.approx(28.0))  # at rest under the safe command
    for u, dt_s in held:
        for start, end in zip((0.0, *sorted(cuts)), (*sorted(cuts), 1.0), strict=True):
            plant.advance(u, (end - start) * dt_s)
    total = sum(dt_s for _, dt_s in held)
    assert plant.time_s == pytest.approx(total)
    y, at = 8.0, 0.0  # above the 20 degC of the room
    for u, dt_s in held:  # each command acts from at + 0.35 s on
        into = max(0.0, min(total, at + dt_s + 0.35) - max(0.0, at + 0.35)) if at + 0.35 < total else 0.0
        y = 0.8 * u + (y - 0.8 * u) * math.exp(-into / 3.0)
        at += dt_s
    assert plant.y_true == pytest.approx(20.0 + y, rel=1e-6)


def test_its_response_is_the_models(folder: Path) -> None:
    omega = np.array([0.01, 0.3, 3.0])
    for text in (HEATER, BALL):
        plant = plant_from(text, folder)
        assert isinstance(plant, Plant)
        np.testing.assert_allclose(plant.response(omega), read_model(folder / "model.toml").response(omega), rtol=1e-6)


def test_an_integrating_plant_starts_where_its_model_rests(folder: Path) -> None:
    plant = plant_from(BALL, folder, u_start=0.0)
    assert (plant.u_applied, plant.u_rest) == (5.0, 5.0)
    plant.advance(plant.u_applied, 10.0)
    assert plant.y_true == pytest.approx(5.0, abs=1e-6)


def test_equations_are_a_twin_too(folder: Path) -> None:
    plant = plant_from(TANK, folder, u_start=2.0)
    assert plant.y_true == pytest.approx(1.0)  # (k u / a)^2
    plant.advance(4.0, 200.0)
    assert plant.y_true == pytest.approx(4.0, rel=1e-4)


def test_noise_is_drawn_within_its_half_width_and_anew_for_every_measurement(folder: Path) -> None:
    plant = plant_from(HEATER, folder, noise=0.5)
    drawn = np.array([plant.measure() for _ in range(400)])
    assert np.max(np.abs(drawn - 28.0)) <= 0.5
    assert np.std(drawn) == pytest.approx(0.5 / math.sqrt(3.0), rel=0.1)


def test_what_a_twin_cannot_be_made_of_is_refused(folder: Path) -> None:
    effect = '[[effect]]\nname = "actuator.dead_zone"\n[effect.parameters.width]\nvalue = 0.1\n'
    with pytest.raises(InputError, match="which a twin does not take along"):
        plant_from(HEATER + effect, folder)
    with pytest.raises(InputError, match="no_model"):
        model_plant(SimulatedRigSettings(kind="simulated", model="x"), str(folder / "no_model.toml"), u_start=0.0)
    for wrong in ({}, {"plant": "ball", "model": "m.toml"}, {"model": "m.toml", "start": "floor"}):
        with pytest.raises(ValueError, match=r"plant or model|start is of"):
            SimulatedRigSettings.model_validate({"kind": "simulated"} | wrong)


def test_a_run_is_rehearsed_on_the_rigs_own_kind_and_served_as_it(tmp_path: Path) -> None:
    (tmp_path / "model.toml").write_text(HEATER)
    config = tmp_path / "heater.toml"
    config.write_text(CONFIG.format(model=tmp_path / "model.toml"))
    done = CliRunner().invoke(app, ["run", str(config), "--dry-run", "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, (done.output, done.exception)
    assert "on a simulated rig; no real one was touched" in done.output
    points = json.loads((tmp_path / "out" / "result.json").read_text())["points"]
    omega = np.array([point["omega_rad_s"] for point in points])
    truth = np.abs(read_model(tmp_path / "model.toml").response(omega))
    np.testing.assert_allclose([point["gain"] for point in points], truth, rtol=0.1)
    device = device_of(load_config(config))
    assert isinstance(device.plant, ModelPlant)
    assert device.output == 10.0


def test_a_sensor_has_the_steps_of_its_converter(tmp_path: Path) -> None:
    (tmp_path / "heater.toml").write_text(HEATER)
    given = {"kind": "simulated", "model": str(tmp_path / "heater.toml"), "noise": 0.02, "resolution": 0.25}
    settings = SimulatedRigSettings.model_validate(given)
    plant = model_plant(settings, str(tmp_path / "heater.toml"), u_start=10.0)
    for _ in range(20):
        plant.advance(60.0, 0.1)
        assert plant.measure() % 0.25 == 0.0
        assert abs(plant.measure() - plant.y_true) <= 0.125 + 0.02
    with pytest.raises(ValueError, match="resolution is of a model's plant"):
        SimulatedRigSettings.model_validate({"kind": "simulated", "plant": "ball", "resolution": 0.1})
