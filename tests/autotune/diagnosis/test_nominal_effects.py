"""Effects that the nominal model has are the base of a search: retuned, never found again, and nothing hides them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.diagnosis.diagnose import diagnose
from autotune.effects import counted_as
from autotune.errors import InputError
from autotune.model_tables import read_model, write_model
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording
from tests.autotune.diagnosis.equations.test_diagnose_equations import as_it_is, recorded
from tests.autotune.diagnosis.servo_rigs import servo_model, servo_recording
from tests.autotune.equations.models import model


def lag_recording(seed: int, low: float = -1e9, drift: float = 0.0) -> Recording:
    """0.5 dy/dt = -y + 2 max(u, low), exact from row to row, with a sensor that drifts."""
    rng = np.random.default_rng(seed)
    dt, y = 0.02, np.zeros(1200)
    u = np.repeat(rng.uniform(-1.0, 1.0, 60), 20)
    for k in range(1199):
        w = 2.0 * max(u[k], low)
        y[k + 1] = w + (y[k] - w) * np.exp(-dt / 0.5)
    t = dt * np.arange(1200)
    return Recording(t=t, u=u, y=y + drift * t + 0.01 * rng.normal(size=1200))


LAG = Model(
    name="lag",
    input=Port(unit="V"),
    output=Port(unit="V"),
    blocks=(Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.9,), den=(0.55, 1.0))),),
)
CASES = {
    "actuator.saturation": (LAG, [lag_recording(1, low=-0.5), lag_recording(2, low=-0.5)]),
    "sensor.drift": (LAG, [lag_recording(3, drift=0.02)]),
    "plant.quadratic_drag": (
        servo_model(), [servo_recording(s, lambda x, v: -0.03 * v * abs(v)) for s in (4, 5)],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_an_extended_model_explains_the_same_recordings_with_nothing_left_out(name: str, tmp_path: Path) -> None:
    nominal, recordings = CASES[name]
    found = diagnose(nominal, recordings)
    (named,) = (e.name for e in found.effects if e.name != "actuator.offset")
    assert named in counted_as(name)
    write_model(found.extended_model, tmp_path / "extended.toml")
    extended = read_model(tmp_path / "extended.toml")
    again = diagnose(extended, recordings)
    assert again.verdict == "none"
    assert again.effects == ()
    assert all(named not in c.name for c in again.candidates)
    assert [e.name for e in again.extended_model.effects] == [named]


def test_what_is_left_out_beside_a_nominal_effect_is_named_alone_and_the_effect_is_retuned() -> None:
    drag = Effect(name="plant.quadratic_drag", parameters={"coefficient": Parameter(value=0.2)})
    nominal = replace(servo_model(), effects=(drag,))

    def force(x: float, v: float) -> float:
        return -0.03 * v * abs(v) - 0.25 * float(np.tanh(v / 0.002))

    found = diagnose(nominal, [servo_recording(s, force) for s in (6, 7)])
    assert found.verdict == "effect"
    assert [e.name for e in found.effects] == ["plant.coulomb_friction"]
    values = {e.name: e for e in found.extended_model.effects}
    # -0.03 v|v| at the input is a drag of 5.4 * 0.03 beside the speed of tau dv/dt = -v + 5.4 u
    assert values["plant.quadratic_drag"].parameters["coefficient"].value == pytest.approx(5.4 * 0.03, rel=0.1)


def test_a_nominal_limit_that_no_recording_reaches_stays_as_it_was_written() -> None:
    limit = Effect(name="actuator.saturation", parameters={"high": Parameter(value=10.0, unit="V")})
    found = diagnose(replace(LAG, effects=(limit,)), [lag_recording(8)])
    assert found.verdict in ("none", "parameters")
    (kept,) = found.extended_model.effects
    assert kept.parameters["high"].value == pytest.approx(10.0)


def test_extended_equations_explain_the_same_recordings_with_nothing_left_out() -> None:
    def friction(s: float, x: np.ndarray) -> float:
        return float(-0.03 * np.tanh(x[1] / 0.002))

    recordings = [recorded(seed, friction, as_it_is, rows=600) for seed in (1, 2)]
    found = diagnose(model(), recordings)
    assert [e.name for e in found.effects] == ["plant.coulomb_friction"]
    again = diagnose(found.extended_model, recordings)
    assert again.verdict == "none"
    assert again.effects == ()
    assert [e.name for e in again.extended_model.effects] == ["plant.coulomb_friction"]


@pytest.mark.parametrize("command", ["diagnose", "simulate", "check", "design", "margins"])
def test_an_unknown_effect_is_refused_with_the_known_ones(command: str, tmp_path: Path) -> None:
    unknown = Effect(name="plant.colomb_friction", parameters={"level": Parameter(value=1.0)})
    write_model(replace(LAG, effects=(unknown,)), tmp_path / "m.toml")
    given, out = str(tmp_path / "m.toml"), ["--out", str(tmp_path / "out")]
    recording = tmp_path / "r.csv"
    recording.write_text("t,u,y\n" + "".join(f"{k * 0.1},{k % 7},{k % 5}\n" for k in range(200)))
    (tmp_path / "c.toml").write_text('kind = "pi"\nK = 1.0\nTi_s = 1.0\n')
    arguments = {
        "diagnose": ["diagnose", "--model", given, str(recording), *out],
        "simulate": ["simulate", "--model", given, str(recording), *out],
        "check": ["model", "check", given],
        "design": ["design", "--model", given, *out],
        "margins": ["margins", "--model", given, "--controller", str(tmp_path / "c.toml"), *out],
    }
    run = CliRunner().invoke(app, arguments[command])
    assert isinstance(run.exception, InputError), run.output
    said = str(run.exception)
    assert "unknown effect 'plant.colomb_friction'; did you mean 'plant.coulomb_friction'" in said
    assert "sensor.drift" in said
    assert "\n" not in said
