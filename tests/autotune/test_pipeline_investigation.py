"""Investigations: what a recording leaves open, one experiment of the tool's choosing decides, within its envelope."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.config import Config, load_config
from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.simulation.assembly import assemble
from autotune.effects import CATALOGUE, KINDS
from autotune.errors import ExperimentStopped, InputError
from autotune.experiment.excitation import Excitation
from autotune.experiment_design import with_next_experiment
from autotune.experiment_design.conditions import as_recorded, conditions_of
from autotune.experiment_design.open_hypotheses import open_hypotheses
from autotune.experiment_design.plan import excitations, predict_recording
from autotune.model_tables import read_model, write_model
from autotune.models import Block, Model, Port, TransferFunction
from autotune.pipeline.investigation import Budget, Investigation, Listeners, investigate
from autotune.recording import Recording, read_recording, write_recording
from drivers.simulated import SimulatedRig
from sim.tank import TwoTank, TwoTankSettings
from sim.ties import draw, write
from tests.autotune.diagnosis.servo_rigs import servo_model
from tests.sim.imperfections import Fault, FaultyPlant, FaultyRig

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
#: A square-root outflow and what it can be taken for.
RIVALS = frozenset(("plant.sqrt_outflow", "plant.hard_stop", "sensor.nonlinear_gain"))
WITHOUT = tuple(name for name in CATALOGUE if name not in RIVALS)


def tanks_model() -> Model:
    def lag(name: str, place: str, gain: float, time_constant: float) -> Block:
        return Block(name=name, place=place, dynamics=TransferFunction(num=(gain,), den=(time_constant, 1.0)))  # type: ignore[arg-type]

    return Model(
        name="two tanks",
        input=Port(unit="V", offset=2.99),
        output=Port(unit="cm", offset=10.0),
        blocks=(
            lag("pump", "actuator", 1.0, 1.0),
            lag("upper tank", "plant", 6.7, 56.0),
            lag("lower tank", "plant", 1.0, 56.0),
            lag("level sensor", "sensor", 1.0, 2.0),
        ),
    )


def tanks_config(swing: float = 5.0) -> Config:
    config = load_config(CONFIGS / "two_tank_sim.toml")
    limits = {"swing": swing, "y_min": 10.0 - swing, "y_max": 10.0 + swing}
    return config.model_copy(
        update={
            "limits": config.limits.model_copy(update=limits),
            "signals": config.signals.model_copy(update={"sample_time_s": 4.0}),
        }
    )


def tanks(seed: int) -> TwoTank:
    return TwoTank(TwoTankSettings(start=10.0), seed=seed)


def small_steps(seed: int, rows: int = 500) -> Recording:
    """Record the tanks under steps so small that the bend of their outflow hardly shows."""
    plant, random = tanks(seed), np.random.default_rng(seed)
    u = np.repeat(plant.u_rest + 0.22 * random.uniform(-1.0, 1.0, rows // 40 + 1), 40)[:rows]
    y = np.empty(rows)
    for k in range(rows):
        y[k] = plant.measure()
        plant.advance(u[k], 4.0)
    return Recording(t=4.0 * np.arange(rows), u=u, y=y)


def test_a_square_root_outflow_that_hardly_shows_is_told_by_one_experiment(tmp_path: Path) -> None:
    rig = SimulatedRig(tanks(23), u_safe=0.0)
    known = investigate(
        rig,
        tanks_config(),
        tanks_model(),
        [small_steps(2)],
        tmp_path,
        budget=Budget(rounds=1, duration_s=1200.0),
        without=WITHOUT,
    )
    believed = dict(known.before)
    assert believed["none"] > 0.1
    assert 0.1 < believed["plant.sqrt_outflow"] < 0.5
    assert len(known.rounds) == 1
    assert set(known.rounds[0].plan.between) >= {"none", "plant.sqrt_outflow"}
    assert known.rounds[0].candidates[0][0] == "plant.sqrt_outflow"
    assert known.rounds[0].candidates[0][1] > 0.9
    assert known.ended == "one hypothesis is left: plant.sqrt_outflow"
    assert rig.command == 0.0


def test_effects_that_command_and_reading_cannot_tell_apart_count_as_one() -> None:
    rng = np.random.default_rng(1)
    config = conditions_of(tanks_config())
    lagged = tanks_model()
    slow = replace(lagged.blocks[-1], dynamics=TransferFunction(num=(1.0,), den=(20.0, 1.0)))
    sim = assemble(replace(lagged, blocks=(*lagged.blocks[:-1], slow)))
    steps = excitations(sim, config, 2000.0)[2]
    planned = predict_recording(sim, config, steps)
    assert planned is not None
    recording = replace(planned, y=planned.y + 0.02 * rng.normal(size=len(planned)))
    rest = [name for name in KINDS if name not in ("actuator.lag", "sensor.lag")]
    short = replace(lagged, blocks=lagged.blocks[1:-1])
    found = diagnose(short, [recording], without=rest)
    named = {name for candidate in found.candidates for name in candidate.name.split("+")}
    assert {"actuator.lag", "sensor.lag"} <= named
    assert len([name for name in open_hypotheses(found) if "lag" in name]) == 1


@pytest.mark.parametrize("swing", [1.0, 3.0])
def test_planned_experiments_keep_within_the_limits_by_their_own_prediction(swing: float) -> None:
    config, sim = conditions_of(tanks_config(swing)), assemble(tanks_model())
    planned = [predict_recording(sim, config, one) for one in excitations(sim, config, 2000.0)]
    assert len(planned) == 8
    for recording in planned:
        assert recording is not None
        assert np.max(np.abs(recording.y - 10.0)) < swing
        assert np.all((recording.u >= config.limits.u_min) & (recording.u <= config.limits.u_max))


def test_an_integrating_plant_is_not_driven_without_a_control_law() -> None:
    config = load_config(CONFIGS / "servo_sim.toml").model_copy(update={"controller": None})
    with pytest.raises(InputError, match="integrates"):
        excitations(assemble(servo_model()), conditions_of(config), 20.0)


def test_an_excitation_longer_than_the_rig_may_be_used_is_refused_before_the_rig_is_touched(tmp_path: Path) -> None:
    rig = SimulatedRig(tanks(6), u_safe=0.0)
    with pytest.raises(InputError, match=r"limits\.time_s"):
        investigate(rig, tanks_config(), tanks_model(), [], tmp_path, budget=Budget(duration_s=19000.0))
    assert list(tmp_path.iterdir()) == []


def test_a_fault_in_a_round_leaves_the_rig_safe_and_says_in_which_round(tmp_path: Path) -> None:
    rig = FaultyRig(FaultyPlant(tanks(5), (Fault(kind="cut link", start_s=1000.0),)), u_safe=0.0)
    kept: list[Investigation] = []
    with pytest.raises(ExperimentStopped):
        investigate(
            rig,
            tanks_config(),
            tanks_model(),
            [],
            tmp_path,
            budget=Budget(duration_s=2000.0),
            without=WITHOUT,
            told=Listeners(keep=kept.append),
        )
    assert kept[-1].ended.startswith("round 1: ")
    assert rig.command == 0.0
    assert (tmp_path / "rig_1.csv").stat().st_size > 1000


def test_the_command_ends_at_once_where_the_simulation_explains_the_recording(tmp_path: Path) -> None:
    model, config = tanks_model(), CONFIGS / "two_tank_sim.toml"
    sim = assemble(model)
    conditions = conditions_of(tanks_config())
    planned = predict_recording(sim, conditions, excitations(sim, conditions, 1600.0)[0])
    assert planned is not None
    noisy = replace(planned, y=planned.y + 0.02 * np.random.default_rng(2).normal(size=len(planned)))
    write_recording(noisy, tmp_path / "rec.csv")
    write_model(model, tmp_path / "model.toml", {})
    given = ["investigate", f"{config}", f"{tmp_path}/rec.csv", "--model", f"{tmp_path}/model.toml"]
    without = [part for name in WITHOUT for part in ("--without", name)]
    done = CliRunner().invoke(app, [*given, "--out", f"{tmp_path}/out", *without])
    assert done.exit_code == 0, done.output
    rounds = json.loads((tmp_path / "out" / "rounds.json").read_text())
    assert rounds["rounds"] == []
    assert rounds["ended"] == "the simulation explains the recordings"
    assert json.loads((tmp_path / "out" / "diagnosis.json").read_text())["verdict"] in ("none", "parameters")
    assert "How it was learnt" in (tmp_path / "out" / "report.html").read_text()
    assert not list((tmp_path / "out").glob("rig_*.csv"))


def test_a_diagnosis_asks_for_an_experiment_between_the_hypotheses_left_that_goes_no_further_than_the_recording(
    tmp_path: Path,
) -> None:
    """Gentle steps of a servo with a bent amplifier, a bend not looked for, pass for friction or a dead zone."""
    write(draw(4004), tmp_path)
    recording = read_recording(tmp_path / "first.csv")
    rivals = ("plant.coulomb_friction", "actuator.dead_zone")
    rest = [name for name in CATALOGUE if name not in rivals]
    found = with_next_experiment(diagnose(read_model(tmp_path / "model.toml"), [recording], without=rest))
    asked = found.next_experiment
    assert asked is not None
    left = open_hypotheses(found)
    assert len(left) >= 2
    assert all(name in asked.purpose for name in left)
    assert set(left) & set(rivals)
    planned = predict_recording(
        found.search.retuned.fit.sim, as_recorded(found), Excitation(kind=asked.kind, **asked.settings)
    )
    assert planned is not None
    for now, then in ((planned.u, recording.u), (planned.y, recording.y)):
        assert then.min() <= now.min()
        assert now.max() <= then.max()
