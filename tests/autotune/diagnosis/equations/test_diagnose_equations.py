"""Diagnosis of equations: what was left out is named at its place, and nothing where nothing was."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.diagnosis import diagnose
from autotune.equations import write_equations
from autotune.recording import Recording, write_recording
from tests.autotune.equations.models import model

J, C, M, L, G = 0.06, 0.018, 0.55, 0.29, 9.81  # the truth: other numbers than the nominal ones


Torque = Callable[[float, np.ndarray], float]
Acts = Callable[[np.ndarray], np.ndarray]


def recorded(
    seed: int,
    torque: Callable[[float, np.ndarray], float],
    u_acts: Callable[[np.ndarray], np.ndarray],
    rows: int = 1200,
) -> Recording:
    """Integrate the pendulum by Runge and Kutta's method, eight steps a row, with a further torque."""
    rng = np.random.default_rng(seed)
    t, u = np.arange(rows) * 0.02, np.repeat(rng.normal(0.0, 0.25, rows // 40), 40)
    acting, h = u_acts(u), 0.02 / 8

    def slope(s: float, x: np.ndarray, w: float) -> np.ndarray:
        return np.array([x[1], (w - C * x[1] - M * G * L * np.sin(x[0]) + torque(s, x)) / J])

    x, y = np.array([0.1, 0.0]), np.empty(rows)
    for k in range(rows):
        y[k] = x[0]
        for i in range(8):
            s = t[k] + i * h
            k1 = slope(s, x, acting[k])
            k2 = slope(s + h / 2, x + h / 2 * k1, acting[k])
            k3 = slope(s + h / 2, x + h / 2 * k2, acting[k])
            k4 = slope(s + h, x + h * k3, acting[k])
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return Recording(t=t, u=u, y=y + rng.normal(0.0, 0.003, rows), name=f"rec{seed}.csv")


def none(s: float, x: np.ndarray) -> float:
    return 0.0


def as_it_is(u: np.ndarray) -> np.ndarray:
    return u


def test_wrong_numbers_are_numbers_and_what_they_do_not_tell_is_told() -> None:
    found = diagnose(model(), [recorded(1, none, as_it_is), recorded(2, none, as_it_is)])
    assert found.verdict == "parameters"
    assert not found.effects
    values = {p.name: p.value for p in found.extended_model.parameters}
    np.testing.assert_allclose([values["J"], values["c"], values["m"] * values["l"]], [J, C, M * L], rtol=0.02)
    assert any("m, l" in one or "l, m" in one for one in found.as_json()["undetermined"])


@pytest.mark.parametrize(
    ("torque", "u_acts", "name", "place", "key", "value"),
    [
        (lambda s, x: -0.03 * np.tanh(x[1] / 0.002), as_it_is, "plant.coulomb_friction", "omega", "level", 0.03 / J),
        (lambda s, x: -0.02 * x[1] * abs(x[1]), as_it_is, "plant.quadratic_drag", "omega", "coefficient", 0.02 / J),
        (none, lambda u: u - np.clip(u, -0.1, 0.1), "actuator.dead_zone", "u", "half_width", 0.1),
    ],
    ids=["friction", "drag", "dead zone"],
)
def test_missing_physics_is_named_at_its_place_with_its_size(
    torque: Torque, u_acts: Acts, name: str, place: str, key: str, value: float, tmp_path: Path
) -> None:  # fmt: skip
    write_equations(model(), tmp_path / "m.toml")
    for seed in (1, 2):
        write_recording(recorded(seed, torque, u_acts), tmp_path / f"rec{seed}.csv")
    files = [str(tmp_path / one) for one in ("m.toml", "rec1.csv", "rec2.csv", "out")]
    run = CliRunner().invoke(app, ["diagnose", "--model", files[0], *files[1:3], "--out", files[3]])
    assert run.exit_code == 0, run.output
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert found["verdict"] == "effect"
    assert [e["name"] for e in found["effects"]] == [name]
    effect = found["effects"][0]
    assert place in (effect["state"], effect["input"])
    assert effect["parameters"][key]["value"] == pytest.approx(value, rel=0.05)
    assert found["fit"]["extended"] < 0.3 * found["fit"]["retuned"]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f"({name} at {place}, probability" in page
    assert "rec1.csv: measured, and simulated" in page
    simulated = CliRunner().invoke(
        app,
        ["simulate", "--model", str(tmp_path / "out" / "extended_model.toml"), files[1], "--out", f"{files[3]}.csv"],
    )
    assert simulated.exit_code == 0, simulated.output
