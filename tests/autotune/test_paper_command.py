"""Figures and tables of the papers from an installed tool: for any points, any plant, and the paper's own loop."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
from typer.testing import CliRunner

import autotune as at
from autotune.cli import app
from autotune.controller import PIDController, write_controller
from autotune.model_tables import write_model
from autotune.models import Block, Model, Port
from autotune.points import points_to_json
from autotune.report.page import Section
from autotune.report.relay_figures import step_responses
from autotune.report.relay_tables import asymptotic_bandwidth, bandwidth_limit, printed_tables
from tests.autotune.command import run
from tests.autotune.design.plants import BALL


def test_the_page_of_a_known_plant_has_the_row_of_table_ii(tmp_path):
    block = Block(name="ball", place="plant", dynamics=BALL)
    write_model(Model(name="ball", input=Port(), output=Port(), blocks=(block,)), tmp_path / "ball.toml")
    write_controller(PIDController(K=-0.023, Ti_s=3.0), tmp_path / "pi.toml")
    run("paper", "relay", "--plant", tmp_path / "ball.toml", "--controller", tmp_path / "pi.toml", "--beside",
        tmp_path / "pi.toml", "--out", tmp_path / "page.html")  # fmt: skip
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    for figure in ("0.6818", "48.16", "0.607", "1.384", "57.14", "5.214"):  # recomputed row, and omega_d
        assert figure in page, figure
    for title in ("Table I:", "Table II:", "Figure 6", "Figure 7", "Figure 8", "Figure 9"):
        assert title in page


def test_the_page_of_measured_points_needs_no_plant(tmp_path):
    points = at.frequency_points(at.example("oven"), largest_relative_sd=0.05)
    (tmp_path / "result.json").write_text(json.dumps({"points": points_to_json(points)}), encoding="utf-8")
    run("paper", "relay", "--points", tmp_path / "result.json", "--noise-gain", 10, "--out", tmp_path / "page.html")
    assert "the plant fitted to the points" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_without_points_and_plant_the_page_is_that_of_the_papers_ball(tmp_path):
    said = run("paper", "relay", "--out", tmp_path / "ball.html")
    assert re.search(r"Criterion \(10\).* holds", said)
    assert "4.15 rad/s" in said  # (26) as the paper's formula has it
    page = (tmp_path / "ball.html").read_text(encoding="utf-8")
    for figure in ("5.214", "RST, printed", "RST, recomputed", "4.25", "29.83", "56.8", "57.14", "13.5", "13.12"):
        assert figure in page, figure


def _cells(section: Section) -> dict[str, dict[str, str]]:
    """Return the cells of a section's table by row and column."""
    table = section.tables[0]
    return {str(row[0]): dict(zip(table.header, map(str, row), strict=True)) for row in table.rows}


def test_the_papers_tables_stand_beside_what_comes_out_of_its_own_numbers():
    reduced, law = at.reduce(BALL), at.PI(K=-0.025, Ti_s=3.6)
    found, omega = at.validate(BALL, reduced, law), np.geomspace(0.01, 1e3, 2000)
    rst = at.rst(BALL, dominant_rad_s=1.8, rest_rad_s=11.2)
    first, second, text = printed_tables(BALL, reduced, found, {"PI": law}, rst, omega)
    gap = _cells(first)["nu-gap"]
    assert (gap["printed"], gap["recomputed, k = 1"]) == ("0.004", "0.8442")
    assert float(gap["own"]) == pytest.approx(found.nu_gap, rel=1e-3)
    norm = _cells(second)["norm (11)"]
    assert (norm["RST, printed"], norm["RST, recomputed"]) == ("4.25", "29.83")
    assert (norm["PI, printed"], norm["PI, recomputed"]) == ("56.8", "57.14")
    assert float(norm["PI, own"]) == pytest.approx(at.margins(BALL, law).h2, rel=1e-3)
    bandwidth = _cells(text)["ω_max of (26) for N_max = 0.1"]
    assert (bandwidth["printed"], bandwidth["recomputed"], bandwidth["own"]) == ("4.3", "4.148", "3.819")


def test_an_rst_of_ones_own_plant_needs_both_of_its_poles(tmp_path):
    block = Block(name="lags", place="plant", dynamics=at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0)))
    write_model(Model(name="lags", input=Port(), output=Port(), blocks=(block,)), tmp_path / "lags.toml")
    words = ["paper", "relay", "--plant", str(tmp_path / "lags.toml"), "--out", str(tmp_path / "page.html")]
    alone = CliRunner().invoke(app, [*words, "--dominant", "1"])
    assert "--dominant and --rest together" in str(alone.exception)
    run(*words, "--dominant", 1, "--rest", 4)
    assert "RST placed here" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_the_tables_of_one_delay_and_of_two_are_beside_the_papers(tmp_path):
    """Means of four recordings within five of the paper's standard deviations of a mean, and its bias of .05."""
    printed = run("paper", "delay", "--sets", 4, "--out", tmp_path / "delay.html")
    found = [float(value) for value in re.findall(r"(?:delays?|and) (\d\.\d+) s", printed)]
    for value, true, sd in zip(found, (4.0, 2.0, 4.0), (0.065, 0.01, 0.017), strict=True):
        assert abs(value - true) < 5.0 * sd / math.sqrt(4.0) + 0.05
    page = (tmp_path / "delay.html").read_text(encoding="utf-8")
    for printed_there in ("Table 1", "Table 2", "0.084", "0.017", "starred", "figure 1", "figure 2", "figure 3"):
        assert printed_there in page


def test_the_bandwidth_that_a_noise_gain_leaves():
    """(26) continues the slope at the plant's crossover, 4.15 rad/s; the plant itself reaches 1/N_max before."""
    omega = np.geomspace(0.1, 100.0, 2000)
    assert asymptotic_bandwidth(BALL, 0.1, omega) == pytest.approx(13.118 * math.sqrt(0.1), rel=1e-4)
    lag = at.TransferFunction(num=(100.0,), den=(100.0, 1.0))  # far above its corner the line is the plant
    assert asymptotic_bandwidth(lag, 0.5, omega) == pytest.approx(0.5, rel=1e-3)
    assert math.isnan(asymptotic_bandwidth(BALL, 0.1, np.geomspace(20.0, 100.0, 200)))
    limit = bandwidth_limit(BALL, 0.1, omega)
    assert abs(BALL.response(np.array([limit]))[0]) == pytest.approx(10.0, rel=1e-3)
    assert limit == pytest.approx(4.15, rel=0.1)
    assert math.isnan(bandwidth_limit(BALL, 1e-9, omega))


def test_the_responses_are_those_of_python_control():
    control = pytest.importorskip("control")
    t, y, u = step_responses(BALL, PIDController(K=-0.023, Ti_s=3.0), 20.0)
    plant, law = at.to_control(BALL), at.to_control(at.PI(K=-0.023, Ti_s=3.0))
    first = t < 20.0
    _, expected = control.step_response(control.feedback(plant * law, 1), t[first])
    np.testing.assert_allclose(y[first], expected, atol=5e-3)
    load = 0.5 * u[np.argmax(np.abs(u[first]))]
    _, after = control.step_response(load * control.feedback(plant, law), t[~first] - 20.0)
    np.testing.assert_allclose(y[~first] - y[first][-1], after, atol=0.02 * np.max(np.abs(after)) + 5e-3)
    assert np.ptp(y[~first]) > 0.1


def test_controllers_are_compared_under_the_same_load():
    """Each had half of its own largest command as load, so that the RST looked four times better than it is."""
    pi, other = PIDController(K=-0.023, Ti_s=3.0), PIDController(K=-0.0367, Ti_s=4.05)
    levels = [step_responses(BALL, law, 40.0, -0.0115)[2][-1] for law in (pi, other)]
    np.testing.assert_allclose(levels, 0.0115, rtol=0.02)  # with integral action u takes the load away


def test_the_set_point_of_an_rst_passes_its_prefilter():
    control = pytest.importorskip("control")
    rst = at.rst(BALL, dominant_rad_s=1.8, rest_rad_s=11.2)
    t, y, _ = step_responses(BALL, rst, 10.0)
    first = t < 10.0
    loop = control.feedback(at.to_control(BALL) * at.to_control(rst), 1) * at.to_control(rst.prefilter())
    _, expected = control.step_response(loop, t[first])
    np.testing.assert_allclose(y[first], expected, atol=5e-3)


def test_the_loops_figures_hold_every_method_of_the_paper(tmp_path):
    printed = run("paper", "closed-loop", "--sets", 2, "--out", tmp_path / "loop.html")
    assert "this paper 2" in printed
    page = (tmp_path / "loop.html").read_text(encoding="utf-8")
    for title in (
        "Figure 2",
        "Figure 3",
        "Figure 4",
        "Figure 5",
        "Oku-Tanaka",
        "SSARX",
        "ORT",
        "0.1023",
        "Cramer-Rao bound",
    ):
        assert title in page
