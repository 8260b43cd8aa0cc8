"""A model beside its plant, a set-point a loop can follow, pole placement: from files, beside the paper's figures."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.controller import PIDController, read_controller, write_controller
from autotune.model_tables import read_model, write_model
from autotune.models import Block, Model, Port, TransferFunction
from tests.autotune.command import run
from tests.autotune.design.plants import BALL


@pytest.fixture
def files(tmp_path):
    for name, plant in {"ball": BALL, "oven": TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0), delay_s=0.5)}.items():
        block = Block(name=name, place="plant", dynamics=plant)
        write_model(Model(name=name, input=Port(), output=Port(), blocks=(block,)), tmp_path / f"{name}.toml")
    write_controller(PIDController(K=-0.023, Ti_s=3.0), tmp_path / "pi.toml")
    return tmp_path


def test_a_known_plant_is_reduced_and_compared_with_its_model(files):
    """Unscaled nu-gap 0.844, b 0.01786 and 0.01862; at k = 0.023 it is 0.1643 < 0.3437 <= 0.3986 on -65 and 5.17."""
    run("reduce", "--model", files / "ball.toml", "--out", files / "reduced.toml")
    assert read_model(files / "reduced.toml").transfer_function().response(np.array([1e-3]))[0] != 0.0
    words = ["validate", "--model", files / "reduced.toml", "--against", files / "ball.toml"]
    run(*words, "--controller", files / "pi.toml", "--scaling", 1, "--out", files / "printed.json")
    run(*words, "--controller", files / "pi.toml", "--out", files / "scaled.json")
    printed, scaled = (json.loads((files / f"{name}.json").read_text()) for name in ("printed", "scaled"))
    assert printed["nu_gap"] == pytest.approx(0.844, abs=0.005)
    assert printed["b_plant"] == pytest.approx(0.01862, abs=2e-5)
    assert not printed["holds"]
    assert scaled["holds"]
    assert scaled["nu_gap"] < scaled["b_model"] <= scaled["b_plant"]


def test_pole_placement_gives_the_row_of_table_ii(files):
    run("rst", "--model", files / "ball.toml", "--dominant", 1.8, "--rest", 11.2, "--out", files / "rst.json",
        "--controller", files / "feedback.toml")  # fmt: skip
    margins = json.loads((files / "rst.json").read_text())["margins"]
    assert margins["modulus"] == pytest.approx(0.615, abs=0.001)
    assert margins["phase_deg"] == pytest.approx(45.5, abs=0.1)
    assert margins["delay_s"] == pytest.approx(0.388, abs=0.001)
    assert isinstance(read_controller(files / "feedback.toml"), TransferFunction)
    run("rst", "--model", files / "ball.toml", "--dominant", 1.8, "--rest", 11.2, "--sample-time", 0.01, "--out",
        files / "sampled.json")  # fmt: skip
    law = json.loads((files / "sampled.json").read_text())["sampled"]
    assert sum(law["T"]) == pytest.approx(sum(law["R"]))  # y is r at rest, whatever u
    assert sum(law["S"]) == pytest.approx(0.0, abs=1e-9)  # integral action
    refused = CliRunner().invoke(
        app,
        ["rst", "--model", str(files / "oven.toml"), "--dominant", "1", "--rest", "2", "--out", str(files / "r.json")],
    )
    assert "dead time" in str(refused.exception)


def test_a_transition_keeps_its_limits_and_a_prefilter_is_a_file(files):
    run("reference", "--model", files / "oven.toml", "--from", 1, "--to", 3, "--rest", 0.5, "--u-min", -2,
        "--u-max", 2.5, "--u-rate", 1.5, "--out", files / "ref.csv")  # fmt: skip
    t, r, u = np.loadtxt(files / "ref.csv", delimiter=",", skiprows=1).T
    assert (r[0], r[-1]) == pytest.approx((1.0, 3.0), abs=1e-6)
    assert u.max() <= 2.5 + 1e-9
    assert np.max(np.abs(np.diff(u) / np.diff(t))) <= 1.5 * (1 + 1e-6)
    assert u[-1] == pytest.approx(1.5, abs=1e-6)  # half a unit for one of y
    run("reference", "--controller", files / "pi.toml", "--out", files / "prefilter.toml")
    filtered = read_controller(files / "prefilter.toml")
    assert abs(filtered.response(np.array([1e-6]))[0]) == pytest.approx(1.0)
    neither = CliRunner().invoke(app, ["reference", "--out", str(files / "x.csv")])
    assert "one of --model and --controller" in str(neither.exception)
