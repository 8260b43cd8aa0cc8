"""What a diagnosis of equations says beside effects: the control law, and what to record next."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.diagnosis import diagnose
from autotune.equations import write_equations
from autotune.errors import InputError
from autotune.experiment.excitation import KINDS
from autotune.experiment_design import with_next_experiment
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording, write_recording
from tests.autotune.equations.models import model, one_state

DT, A, B = 0.05, 0.8, 2.0


def closed(seed: int, gain: float, rows: int = 800) -> Recording:
    """x' = -A x + B u exactly from row to row, under a PI law with Ti = 4 s."""
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.uniform(-1.0, 1.0, rows // 40), 40)
    kept, x, integral = np.exp(-A * DT), 0.0, 0.0
    u, y = np.empty(rows), np.empty(rows)
    for k in range(rows):
        y[k] = x + 0.005 * rng.normal()
        integral += gain * DT / 4.0 * (r[k] - y[k])
        u[k] = gain * (r[k] - y[k]) + integral
        x = kept * x + (1.0 - kept) * B / A * u[k]
    return Recording(t=DT * np.arange(rows), u=u, y=y, extra={"r": r})


LAG = one_state("b*u - a*x", {"a": 0.75, "b": 2.1})


def test_a_law_that_u_does_not_follow_is_named_by_the_command_line(tmp_path: Path) -> None:
    write_equations(LAG, tmp_path / "m.toml")
    write_recording(closed(1, 1.5), tmp_path / "rec.csv")
    for name, gain in (("right", 1.5), ("wrong", 2.5)):
        (tmp_path / f"{name}.toml").write_text(f'kind = "pi"\nK = {gain}\nTi_s = 4.0\n')
        out = tmp_path / name
        run = CliRunner().invoke(
            app,
            ["diagnose", "--model", str(tmp_path / "m.toml"), "--controller", str(tmp_path / f"{name}.toml"),
             str(tmp_path / "rec.csv"), "--out", str(out)],
        )  # fmt: skip
        assert run.exit_code == 0, run.output
        said = json.loads((out / "diagnosis.json").read_text())
        laws = [e for e in said["effects"] if e["name"] == "controller.law"]
        assert len(laws) == (name == "wrong")
        assert all(e["places"] == ["controller"] for e in laws)


def test_where_several_explanations_are_left_an_experiment_within_the_commands_is_planned() -> None:
    rng = np.random.default_rng(4)
    u, x, y = np.repeat(rng.uniform(-1.0, 1.0, 40), 20), 0.0, np.empty(800)
    for k in range(800):
        y[k] = x + 0.005 * rng.normal()
        # a loss that comes and goes by itself, which no effect of the catalogue is
        kept = np.exp(-A * (1.0 + 0.6 * np.sign(np.sin(0.9 * k * DT))) * DT)
        x = kept * x + (1.0 - kept) * B / A * u[k]
    found = with_next_experiment(diagnose(LAG, [Recording(t=DT * np.arange(800), u=u, y=y)]))
    assert found.verdict == "unexplained"
    planned = found.as_json()["next_experiment"]
    assert planned["kind"] in KINDS
    assert planned["purpose"].startswith("tell ")
    assert 0.0 < planned["settings"]["amplitude"] <= 0.5 * float(np.ptp(u))


def test_nothing_is_planned_where_nothing_is_left_out() -> None:
    found = with_next_experiment(diagnose(LAG, [closed(2, 1.5)]))
    assert found.verdict == "parameters"
    assert found.as_json()["next_experiment"] is None


def test_investigate_says_that_it_plans_for_chains(tmp_path: Path) -> None:
    write_equations(model(), tmp_path / "m.toml")
    example = Path(__file__).parents[4] / "configs" / "ball_sim.toml"
    run = CliRunner().invoke(
        app, ["investigate", str(example), "--model", str(tmp_path / "m.toml"), "--out", str(tmp_path / "out")]
    )
    assert isinstance(run.exception, InputError)
    assert "these are equations" in str(run.exception)
    assert "\n" not in str(run.exception)


@pytest.mark.parametrize("of_chain", [False, True])
def test_spikes_smaller_than_the_reading_moves_are_found_in_what_a_simulation_leaves(of_chain: bool) -> None:
    """Two beside each other as well: half of the variance that is left is theirs."""
    rng = np.random.default_rng(8)
    lag = Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.0,), den=(0.125, 1.0)))
    chain = Model(name="lag", input=Port(), output=Port(), blocks=(lag,))
    quick = chain if of_chain else one_state("b*u - a*x", {"a": 8.0, "b": 8.0})
    t, u = DT * np.arange(900), np.repeat(rng.uniform(-1.0, 1.0, 300), 3)
    x, y, kept = 0.0, np.empty(900), np.exp(-8.0 * DT)
    for k in range(900):
        y[k] = x + 0.005 * rng.normal()
        x = kept * x + (1.0 - kept) * u[k]
    struck = np.array([80, 200, 201, 333, 460, 461, 590, 742, 811])
    y[struck] += 0.09 * rng.choice([-1.0, 1.0], struck.size)
    found = diagnose(quick, [Recording(t=t, u=u, y=y)])
    assert found.verdict == "effect"
    (outliers,) = found.effects
    assert outliers.name == "sensor.outliers"
    rest = found.search.data.good[0] if of_chain else np.isfinite(found.search.bench.recordings[0].y)
    spared = np.flatnonzero(~rest)
    # a chain's start takes its first rows
    assert set(spared[spared > 10]) == set(struck)
