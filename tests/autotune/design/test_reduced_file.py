"""A reduced model's file carries what it was reduced from, so that a design on it is a design for that."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import autotune as at
from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.design.specification import Specification
from autotune.errors import DesignError, InputError
from autotune.identification.reduced_file import read_reduced, write_reduced
from autotune.identification.reduction import ReducedModel, reduce_points, reduce_transfer_function
from autotune.model_tables import read_model
from autotune.models import TransferFunction
from autotune.pipeline.analysis import on_reduced_model
from autotune.points import points_to_json
from tests.autotune.command import run
from tests.autotune.design.plants import BALL, measured


def _ball_points(folder: Path) -> Path:
    path = folder / "points.json"
    path.write_text(json.dumps({"points": points_to_json(measured(BALL, 0))}))
    return path


def test_a_design_on_the_file_of_reduced_points_is_checked_on_the_points(tmp_path: Path) -> None:
    run("reduce", "--points", _ball_points(tmp_path), "--out", tmp_path / "red.toml")
    said = run("design", "--model", tmp_path / "red.toml", "--noise-gain", 0.1, "--out", tmp_path / "d.json")
    assert "on the fitted plant" in said
    assert "on the measured points" in said
    found = json.loads((tmp_path / "d.json").read_text())
    m = margins(BALL, PIDController(K=found["K"], Ti_s=found["Ti_s"]))
    assert m.modulus >= 0.5
    assert m.phase_rad >= math.radians(45.0)


def test_a_pid_on_the_file_of_a_reduced_model_is_refused_by_name(tmp_path: Path) -> None:
    run("reduce", "--points", _ball_points(tmp_path), "--out", tmp_path / "red.toml")
    words = ("design", "--model", tmp_path / "red.toml", "--kind", "pid", "--out", tmp_path / "d.json")
    with pytest.raises(DesignError, match=r"not of class \(2\)"):
        run(*words)
    assert not (tmp_path / "d.json").exists()
    with pytest.raises(DesignError, match=r"not of class \(2\)"):
        at.tune(tmp_path / "red.toml", kind="pid")


def test_a_block_that_was_edited_is_not_taken_for_the_reduced_model(tmp_path: Path) -> None:
    path = tmp_path / "red.toml"
    write_reduced(reduce_transfer_function(BALL), path)
    text = path.read_text()
    H = read_model(path).transfer_function()
    path.write_text(text.replace(repr(H.num[-1]), repr(0.5 * H.num[-1]), 1))
    with pytest.raises(InputError, match=r"\[reduced\].*delete the table"):
        read_reduced(path)
    path.write_text(text.split("[reduced]")[0])
    assert read_reduced(path) is None
    assert read_model(path).transfer_function() == H


@pytest.mark.parametrize("broken", ["G_r = ", "omega_d_rad_s = "])
def test_a_table_that_is_not_complete_is_refused(broken: str, tmp_path: Path) -> None:
    path = tmp_path / "red.toml"
    write_reduced(reduce_transfer_function(BALL), path)
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith(broken)))
    with pytest.raises(InputError, match="write it again with autotune reduce"):
        read_reduced(path)


@pytest.mark.parametrize("reduced", [reduce_transfer_function(BALL), reduce_points(measured(BALL, 1))])
def test_what_is_written_is_read_again(reduced: ReducedModel, tmp_path: Path) -> None:
    write_reduced(reduced, tmp_path / "red.toml")
    again = read_reduced(tmp_path / "red.toml")
    assert again is not None
    assert (again.G_r, again.omega_0r_rad_s, again.omega_d_rad_s, again.plant) == (
        reduced.G_r,
        reduced.omega_0r_rad_s,
        reduced.omega_d_rad_s,
        reduced.plant,
    )
    for one, other in zip(again.points, reduced.points, strict=True):
        assert one.omega_rad_s == other.omega_rad_s
        assert one.response == pytest.approx(other.response, rel=1e-12)
        assert np.array_equal(one.covariance, other.covariance)


@given(lags=st.lists(st.floats(0.05, 1.0), max_size=3), delay=st.floats(0.05, 2.0))
@settings(max_examples=6, deadline=None)
def test_the_plant_that_was_reduced_keeps_what_was_asked_for(lags: list[float], delay: float) -> None:
    """Integrating plants lost up to .06 degrees where the margins were kept on the reduced model alone."""
    den = np.array([1.0, 0.0])
    for lag in lags:
        den = np.polymul(den, [lag, 1.0])
    plant = TransferFunction(num=(1.0,), den=tuple(den), delay_s=delay)
    asked = Specification(noise_gain=20.0)
    found, looked = on_reduced_model(reduce_transfer_function(plant), asked, "pi", certificate=False)
    m = margins(plant, found.controller)
    assert m.modulus >= asked.modulus_margin * (1.0 - 1e-5)
    assert m.phase_rad >= asked.phase_margin_rad * (1.0 - 1e-5)
    assert [check.kept for check in looked] == [True]


def test_a_reduced_model_of_nothing_that_is_known_says_so() -> None:
    found, looked = on_reduced_model(
        ReducedModel(G_r=1.0, omega_0r_rad_s=0.1, omega_d_rad_s=1.0), Specification(noise_gain=20.0), "pi"
    )
    assert looked == ()
    assert "not checked" in found.certificate
