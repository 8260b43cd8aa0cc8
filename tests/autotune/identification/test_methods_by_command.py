"""Every method of the papers from a recording by one command: delays, two delays, closed loop of any size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import autotune as at
from autotune.cli import app
from autotune.controller import DiscreteController, write_controller
from autotune.errors import InputError
from autotune.identification.closed_loop.methods import METHODS
from autotune.recording import Recording, write_recording
from tests.autotune.command import run
from tests.autotune.identification.delay_examples import A, B, example_2
from tests.autotune.identification.test_modulating import example_3
from tests.loop_example import CONTROLLER_DEN, CONTROLLER_NUM, PLANT, example_set, simulate_loop, two_by_two


@pytest.mark.parametrize("method", ["algebraic", "online", "output-error"])
def test_a_delay_by_every_method(method, tmp_path):
    record = example_2(rate_hz=50.0)
    y = record.y + 0.5 * np.random.default_rng(0).standard_normal(len(record))
    write_recording(Recording(t=record.t, u=record.u, y=y), tmp_path / "rec.csv")
    run("identify", "delay", tmp_path / "rec.csv", "--method", method, "--hold", "linear", "--out", tmp_path / "d.json")
    found = json.loads((tmp_path / "d.json").read_text())
    values = np.array([*found["a"], *found["b"], found["delay_s"]])
    sd = np.array([*found["sd"]["a"], *found["sd"]["b"], found["sd"]["delay_s"]])
    assert np.all(np.abs(values - [*A, B, 4.0]) < np.maximum(5.0 * sd, 0.02 * np.abs(values)))
    assert np.all((sd > 0.0) & (sd < 0.2 * np.abs(values)))


def test_two_delays_by_command(tmp_path):
    record = example_3(0.02)
    write_recording(Recording(t=record.t[::10], u=record.u[::10], y=record.y[::10]), tmp_path / "rec.csv")
    run("identify", "delay", tmp_path / "rec.csv", "--delays", 2, "--out", tmp_path / "two.json")
    found = json.loads((tmp_path / "two.json").read_text())
    for name, truth in {"a": 2.7, "b": 1.5, "h1_s": 2.0, "h2_s": 4.0}.items():
        assert abs(found[name] - truth) < 5.0 * found["sd"][name] < 0.5 * truth


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("loop")
    d = example_set(1, rows=3000)
    t = np.arange(len(d.u)) * 1.0
    write_recording(Recording(t=t, u=d.u[:, 0], y=d.y[:, 0], extra={"r": d.r[:, 0]}), folder / "loop.csv")
    law = DiscreteController(num=tuple(CONTROLLER_NUM), den=tuple(CONTROLLER_DEN), sample_time_s=1.0)
    write_controller(law, folder / "c.toml")
    return folder


@pytest.mark.parametrize("method", METHODS)
def test_a_closed_loop_by_every_method(method, loop, tmp_path):
    out = tmp_path / "closed_loop.json"
    run("identify", "closed-loop", loop / "loop.csv", "--controller", loop / "c.toml", "--method", method, "--order", 5,
        "--out", out)  # fmt: skip
    found = json.loads(out.read_text())
    poles = np.array([complex(*pole) for pole in found["poles"]])
    assert np.all(np.abs(PLANT.poles[:, None] - poles).min(axis=1) < 0.06)
    matrices = {name: np.array(value) for name, value in found["state_space"].items()}
    # the file's matrices, polynomials and noise model are one model
    z = np.exp(0.3j)
    of_matrices = matrices["C"] @ np.linalg.solve(z * np.eye(5) - matrices["A"], matrices["B"]) + matrices["D"]
    assert np.polyval(found["num"][::-1], 1 / z) / np.polyval(found["den"][::-1], 1 / z) == pytest.approx(
        of_matrices[0, 0]
    )
    noise = 1.0 + (matrices["C"] @ np.linalg.solve(z * np.eye(5) - matrices["A"], matrices["K"]))[0, 0]
    of_noise = np.polyval(found["noise_model"]["num"][::-1], 1 / z) / np.polyval(found["den"][::-1], 1 / z)
    assert of_noise == pytest.approx(noise)


@pytest.mark.parametrize("method", ["indirect", "pbsid", "prediction-error"])
def test_two_inputs_and_two_outputs_by_command(method, tmp_path):
    plant, controller = two_by_two()
    rng = np.random.default_rng(9)
    d = simulate_loop(plant, controller, rng.standard_normal((2000, 2)), 0.02 * rng.standard_normal((2000, 2)))
    more = {"u2": d.u[:, 1], "y2": d.y[:, 1], "r": d.r[:, 0], "r2": d.r[:, 1]}
    write_recording(Recording(t=np.arange(2000) * 1.0, u=d.u[:, 0], y=d.y[:, 0], extra=more), tmp_path / "two.csv")
    run("identify", "closed-loop", tmp_path / "two.csv", "--more-u", "u2", "--more-y", "y2", "--more-r", "r2",
        "--method", method, "--order", 4, "--out", tmp_path / "c.json")  # fmt: skip
    found = {
        name: np.array(value) for name, value in json.loads((tmp_path / "c.json").read_text())["state_space"].items()
    }
    z = np.exp(0.2j)
    response = found["C"] @ np.linalg.solve(z * np.eye(4) - found["A"], found["B"]) + found["D"]
    truth = plant.response(np.array([0.2]))[0]
    assert np.max(np.abs(response - truth)) < 0.05 * np.max(np.abs(truth))


def test_an_indirect_method_without_r_is_refused_with_what_would_do(loop, tmp_path):
    d = example_set(1, rows=500)
    write_recording(Recording(t=np.arange(500) * 1.0, u=d.u[:, 0], y=d.y[:, 0]), tmp_path / "no_r.csv")
    result = CliRunner().invoke(
        app,
        ["identify", "closed-loop", str(tmp_path / "no_r.csv"), "--method", "indirect", "--out", str(tmp_path / "c")],
    )
    assert "record what moved the loop" in str(result.exception)


@pytest.mark.parametrize(
    ("method", "windows"),
    [
        ("indirect", {"f": 15, "p": 15, "n_cl": 8, "Psi": "r"}),
        ("van-overschee", {"f": 10, "p": 10}),
        ("oku-tanaka", {"f": 20}),
        ("ssarx", {"f": 12, "p": 20}),
    ],
)
def test_the_papers_windows_are_reached_and_change_the_model(method: str, windows: dict[str, Any]) -> None:
    record = at.example("loop")
    chosen = at.closed_loop(record, 5, method=method)
    asked = at.closed_loop(record, 5, method=method, **windows)
    assert len(asked.poles) == 5
    assert np.max(np.abs(asked.poles - chosen.poles)) > 1e-9


@pytest.mark.parametrize(
    ("method", "windows", "named"),
    [
        ("oku-tanaka", {"n_cl": 8}, "n_cl is none of its settings"),
        ("ssarx", {"Psi": "r"}, "Psi is none of its settings"),
        ("indirect", {"psi": "r"}, "'Psi'"),
        ("indirect", {"Psi": "u"}, "known are r, r and y"),
        ("indirect", {"f": 0}, "at least 1"),
        ("prediction-error", {"f": 10}, "no setting 'f'"),
    ],
)
def test_a_window_that_a_method_does_not_take_is_refused(method: str, windows: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=named):
        at.closed_loop(at.example("loop"), 5, method=method, **windows)
