"""Commands design and margins: the fixed formats, and refusals in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.controller import PIDController, read_controller, write_controller
from autotune.errors import InputError
from autotune.model_tables import write_model
from autotune.models import Block, Model, Port
from autotune.points import points_to_json
from tests.autotune.design.plants import REDUCED, measured

MARGINS = {"modulus", "phase_deg", "delay_s", "gain", "crossover_rad_s", "noise_gain", "h2", "stable"}


@pytest.fixture
def model(tmp_path: Path) -> Path:
    chain = Model(
        name="reduced ball",
        input=Port(unit="V"),
        output=Port(unit="V"),
        blocks=(Block(name="ball", place="plant", dynamics=REDUCED),),
    )
    write_model(chain, tmp_path / "model.toml")
    return tmp_path / "model.toml"


def test_design_on_a_model_then_its_margins(model: Path, tmp_path: Path) -> None:
    out, controller = tmp_path / "design.json", tmp_path / "controller.toml"
    arguments = ["design", "--model", str(model), "--out", str(out), "--controller", str(controller)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "phase margin 45.0 deg" in result.output
    content = json.loads(out.read_text())
    assert {"kind", "K", "Ti_s", "Td_s", "Tf_s", "h2", "h2_lower_bound", "binding", "margins"} <= set(content)
    assert set(content["margins"]) >= MARGINS
    assert content["K"] == pytest.approx(-0.0251, rel=5e-3)
    assert content["h2_lower_bound"] < content["h2"]
    assert read_controller(controller) == PIDController(K=content["K"], Ti_s=content["Ti_s"])

    report = tmp_path / "margins.json"
    arguments = ["margins", "--model", str(model), "--controller", str(controller), "--out", str(report)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert json.loads(report.read_text()) == pytest.approx(content["margins"])


def test_design_on_points(tmp_path: Path) -> None:
    points, out = tmp_path / "points.json", tmp_path / "design.json"
    points.write_text(json.dumps({"points": points_to_json(measured(REDUCED, 0))}))
    arguments = ["design", "--points", str(points), "--out", str(out)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    content = json.loads(out.read_text())
    assert content["h2_lower_bound"] is None
    assert content["margins"]["phase_deg"] == pytest.approx(45.0, abs=1e-3)


def test_neither_model_nor_points_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one of --model and --points"):
        CliRunner().invoke(app, ["design", "--out", str(tmp_path / "d.json")], catch_exceptions=False)


def test_margins_of_an_unstable_loop_say_so(model: Path, tmp_path: Path) -> None:
    wrong_sign = tmp_path / "controller.toml"
    write_controller(PIDController(K=0.02, Ti_s=3.0), wrong_sign)
    out = tmp_path / "margins.json"
    arguments = ["margins", "--model", str(model), "--controller", str(wrong_sign), "--out", str(out)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert "UNSTABLE" in result.output
    content = json.loads(out.read_text())
    assert content["stable"] is False
    assert content["h2"] is None


@pytest.mark.parametrize(
    ("form", "expected"),
    [("siemens", "Gain = 0.025"), ("rockwell-dependent", "IGain_min = 0.06"), ("c", "control_step"), ("st", "LIMIT(")],
)
def test_controller_in_a_makers_form_and_as_code(form: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "controller.toml"
    write_controller(PIDController(K=-0.025, Ti_s=3.6), path)
    result = CliRunner().invoke(app, ["controller", "--controller", str(path), "--form", form], catch_exceptions=False)
    assert expected in result.output
    if form == "siemens":
        assert "reverse_acting = 0" in result.output
