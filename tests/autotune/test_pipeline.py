from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.config import Config, load_config
from autotune.config.procedure import DesignSettings
from autotune.controller import PIDController
from autotune.design.specification import Design
from autotune.errors import DesignError, IdentificationError, InputError, LinkError
from autotune.experiment.judgement import Verification
from autotune.experiment.rig import Reading, TrialGains
from autotune.experiment.verify import run_verification
from autotune.identification.parametric import fit_plant
from autotune.models import TransferFunction
from autotune.pipeline import analyse, hand_over, tune
from autotune.pipeline.deployment import deploy
from autotune.pipeline.folder import differences, next_free, read_interrupted, read_stored_config, store_config
from autotune.pipeline.mismatch import around_operating_point, resting_command
from autotune.points import FrequencyPoint, points_to_json
from autotune.recording import read_recording
from drivers.simulated import SimulatedRig
from sim.plant import make_plant

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
BALL = TransferFunction(num=(-65.5,), den=(2.02e-5, 0.007328, 0.3836, 1.0, 0.0))
OLD = PIDController(K=-0.01, Ti_s=6.0)


def points_of(plant: TransferFunction, omega: np.ndarray, relative_sd: float) -> list[FrequencyPoint]:
    return [
        FrequencyPoint(
            omega_rad_s=float(w),
            response=complex(plant.response(np.array([w]))[0]),
            covariance=((float((abs(plant.response(np.array([w]))[0]) * relative_sd) ** 2), 0.0),
                        (0.0, float((abs(plant.response(np.array([w]))[0]) * relative_sd) ** 2))),
        )
        for w in omega
    ]  # fmt: skip


class Mute(SimulatedRig):
    """A rig that does not say what it applies."""

    def read(self) -> Reading:
        return replace(super().read(), u_applied=math.nan)


class Changing(Mute):
    """The ball rig whose actuator becomes stronger after the sweep, as when somebody opens a valve."""

    stronger = 1.0

    def live(self, dt_s: float) -> None:
        self.plant.advance(4.9 + self.stronger * (self.command - 4.9), dt_s)

    def close(self) -> None:
        super().close()
        self.stronger = 1.4


class RefusesGains(SimulatedRig):
    """A rig whose link breaks when the gains of the new controller are written."""

    def write_gains(self, controller: PIDController) -> None:
        if controller != OLD:
            raise LinkError("no answer")
        super().write_gains(controller)


def test_exact_points_of_the_ball_give_the_optimum_of_its_reduced_model() -> None:
    papers = DesignSettings(source="reduced model", noise_gain=0.1)
    analysis = analyse(points_of(BALL, np.array([0.9, 1.5, 2.4, 3.5, 5.0]), 1e-5), papers)
    assert analysis.reduced is not None
    assert analysis.unscaled is not None
    assert analysis.scaled is not None
    # FACTS: largest omega_d that C2 allows on (23) is 5.2138, smallest |G_r| 65.5
    assert analysis.reduced.G_r == pytest.approx(-65.5, rel=2e-3)
    assert analysis.reduced.omega_d_rad_s == pytest.approx(5.2138, rel=5e-3)
    assert analysis.design.h2 == pytest.approx(58.1, rel=0.02)
    assert analysis.margins.modulus > analysis.design.margins.modulus  # Proposition 1
    assert analysis.margins.phase_rad > analysis.design.margins.phase_rad
    assert not analysis.unscaled.holds  # (10) as printed fails: the nu-gap depends on the units
    assert analysis.scaled.holds


def test_a_bound_on_the_norm_is_proved_of_the_design_that_is_chosen_and_of_no_other() -> None:
    points = points_of(BALL, np.array([0.9, 1.5, 2.4, 3.5, 5.0]), 1e-3)
    chosen = analyse(points, DesignSettings(source="reduced model", noise_gain=0.1)).design
    beside = dict(analyse(points, DesignSettings(source="points", noise_gain=0.1)).alternatives)["reduced model"]
    assert isinstance(beside, Design)
    assert chosen.h2_lower_bound is not None
    assert beside.h2_lower_bound is None
    assert beside.controller == chosen.controller


def test_points_that_do_not_reach_135_degrees_are_refused_with_the_remedy() -> None:
    with pytest.raises(IdentificationError, match="higher frequency"):
        analyse(points_of(BALL, np.array([0.1, 0.2, 0.3]), 1e-3), DesignSettings(source="reduced model"))


def test_a_plant_that_changed_is_noticed_and_the_old_gains_stay(tmp_path: Path) -> None:
    config = load_config(CONFIGS / "ball_sim.toml")
    rig = Changing(make_plant("ball", seed=4, noise=0.1), u_safe=0.0, controller=OLD)
    tuning = tune(rig, config, tmp_path)
    assert tuning.verification is not None
    assert not tuning.verification.accepted
    assert not tuning.deployed
    assert rig.read_gains() == OLD
    assert rig.command == 0.0
    assert json.loads((tmp_path / "progress.jsonl").read_text().splitlines()[-1])["exit_status"] == 3


def test_gains_that_cannot_be_written_are_taken_back(tmp_path: Path) -> None:
    rig = RefusesGains(make_plant("ball", seed=4), u_safe=0.0, controller=OLD)
    journal = tmp_path / "journal.jsonl"
    with pytest.raises(LinkError, match="old gains are in place"):
        hand_over(rig, PIDController(K=-0.02, Ti_s=3.0), journal)
    assert rig.read_gains() == OLD
    assert [line.split('"')[3] for line in journal.read_text().splitlines()] == [
        "read", "writing", "restoring", "restored",
    ]  # fmt: skip


def test_gains_are_not_written_where_the_plant_is_not_the_measured_one(tmp_path: Path) -> None:
    config = load_config(CONFIGS / "ball_sim.toml")
    rig = Changing(make_plant("ball", seed=4, noise=0.1), u_safe=0.0, controller=OLD)
    rig.stronger = 1.4
    fit = fit_plant(points_of(BALL, np.array([0.9, 1.5, 2.4, 3.5, 5.0]), 0.004))

    def try_out(held: PIDController, gains: TrialGains | None) -> Verification:
        assert gains is None  # nobody can start its controller: it keeps what it had until the host's law is accepted
        assert rig.read_gains() == OLD
        return run_verification(rig, config, held, fit, tmp_path / "verification.csv")

    new = PIDController(K=-0.0247, Ti_s=3.6)
    done = deploy(rig, new, tmp_path / "journal.jsonl", agree=lambda old, to_be: None, try_out=try_out)
    assert not done.kept
    assert rig.read_gains() == OLD
    assert rig.command == 0.0


def test_a_verification_of_a_plant_that_is_not_the_measured_one_ends_with_status_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Changing(make_plant("ball", seed=4, noise=0.1), u_safe=0.0, controller=PIDController(K=-0.0247, Ti_s=3.6))
    monkeypatch.setattr("autotune.cli.deploy.rig_of", lambda _: rig)
    points = tmp_path / "points.json"
    measured = points_of(BALL, np.array([0.9, 1.5, 2.4, 3.5, 5.0]), 0.004)
    points.write_text(json.dumps({"points": points_to_json(measured)}), encoding="utf-8")
    words = ["verify", str(CONFIGS / "ball_sim.toml"), "--points", str(points), "--out", str(tmp_path)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 3, done.output
    assert "Not accepted" in done.output
    assert rig.command == 0.0


def test_gains_that_the_measured_plant_calls_unstable_never_reach_the_rig(tmp_path: Path) -> None:
    config = load_config(CONFIGS / "ball_sim.toml")
    rig = SimulatedRig(make_plant("ball", seed=4, noise=0.1), u_safe=0.0, controller=OLD)
    fit = fit_plant(points_of(BALL, np.array([0.9, 1.5, 2.4, 3.5, 5.0]), 0.004))
    with pytest.raises(DesignError, match="no stable loop"):
        run_verification(rig, config, PIDController(K=0.02, Ti_s=3.0), fit, tmp_path / "verification.csv")
    assert rig.clock.now() == 0.0
    assert list(tmp_path.iterdir()) == []


class Loaded(Mute):
    """The ball rig with something that leans on its actuator 28 s after the sweep, in the midst of the verification."""

    swept_s = math.inf

    def live(self, dt_s: float) -> None:
        late = self.clock.now() - self.swept_s > 28.0
        self.plant.advance(self.command - (0.03 if late else 0.0), dt_s)

    def close(self) -> None:
        super().close()
        self.swept_s = min(self.swept_s, self.clock.now())


def sections(config: Config, **changes: dict[str, Any]) -> Config:
    return config.model_copy(
        update={name: getattr(config, name).model_copy(update=keys) for name, keys in changes.items()}
    )


@pytest.fixture
def loaded() -> tuple[Config, Loaded]:
    config = sections(
        load_config(CONFIGS / "ball_sim.toml"),
        signals={"sample_time_s": 0.03}, experiment={"points": 3, "budget_s": 25.0}, verification={"duration_s": 8.0},
        design={"source": "reduced model", "noise_gain": 0.1},  # a slow loop, whose test lasts beyond the load
    )  # fmt: skip
    return config, Loaded(make_plant("ball", seed=4, noise=0.1), u_safe=0.0, controller=OLD)


def test_the_fitted_plant_explains_the_sweep_around_its_operating_point(
    loaded: tuple[Config, Loaded], tmp_path: Path
) -> None:
    config, rig = loaded
    tuning = tune(rig, config, tmp_path, verify=False)
    sweep = around_operating_point(read_recording(tmp_path / "recording.csv"))
    assert sweep is not None
    assert sweep.t[0] == pytest.approx(tuning.experiment.segments[0].start_s)
    assert np.abs(sweep.y - 5.0).max() < 3.0  # the floor, at 10 V, is not in it
    u_rest = resting_command(sweep, tuning.analysis.fit.plant, tuning.experiment.u_rest, config.operating_point.y)
    truth = make_plant("ball", seed=4, noise=0.1).u_rest
    assert u_rest == pytest.approx(truth, abs=5e-4)


def test_a_load_in_the_midst_of_the_verification_fails_the_run_and_is_found_in_its_own_recordings(
    loaded: tuple[Config, Loaded], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, rig = loaded
    store_config(config, tmp_path)
    monkeypatch.setattr("autotune.cli.run.rig_of", lambda config, **_: rig)
    done = CliRunner().invoke(app, ["run", str(tmp_path / "config.toml"), "--out", str(tmp_path / "out")])
    assert done.exit_code == 3, done.output
    assert "Not accepted" in done.output
    assert rig.read_gains() == OLD
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert not result["verification"]["accepted"]
    found = result["diagnosis"]
    effect = found["effects"][0]
    assert (found["verdict"], effect["name"]) == ("effect", "environment.step_load")
    recording, start_s, _ = effect["windows"][0]
    assert recording == 1
    assert start_s == pytest.approx(28.0, abs=0.5)
    assert effect["parameters"]["amplitude"]["value"] == pytest.approx(-0.03, rel=0.1)
    assert found["next_experiment"]


def test_the_stored_configuration_is_the_one_that_was_given(tmp_path: Path) -> None:
    for path in sorted(CONFIGS.glob("ball_*.toml")):
        config = load_config(path)
        store_config(config, tmp_path)
        assert read_stored_config(tmp_path) == config


def test_a_run_is_not_gone_on_with_under_other_limits_and_the_refusal_names_them(tmp_path: Path) -> None:
    config = load_config(CONFIGS / "ball_sim.toml")
    store_config(config, tmp_path)
    other = sections(config, limits={"swing": 2.5}, experiment={"points": 7}, design={"noise_gain": 0.2})
    assert differences(config, other) == ("limits.swing = 2.5, was 3.0", "experiment.points = 7, was 5")
    with pytest.raises(InputError, match=r"limits\.swing = 2\.5, was 3\.0; experiment\.points = 7, was 5"):
        read_interrupted(tmp_path, other)
    assert read_interrupted(tmp_path, sections(config, design={"noise_gain": 0.2})).segments == ()


def test_no_recording_is_ever_overwritten(tmp_path: Path) -> None:
    names = []
    for _ in range(3):
        path = next_free(tmp_path / "recording.csv")
        path.touch()
        names.append(path.name)
    assert names == ["recording.csv", "recording-2.csv", "recording-3.csv"]


def test_points_past_a_pi_s_use_are_left_out_of_the_analysis_and_said() -> None:
    plant = TransferFunction(num=(2.0,), den=(1.0, 1.0), delay_s=1.0)
    of_use = points_of(plant, np.array([0.3, 0.7, 1.2, 1.8, 2.5]), 1e-3)  # phases to -211 degrees
    beyond = points_of(plant, np.array([4.0, 6.0, 8.0]), 1e-3)  # phases to -541 degrees, which wrap to -181
    alone, whole = (analyse(p, DesignSettings(), compare=False) for p in (of_use, [*of_use, *beyond]))
    assert whole.design == alone.design
    assert whole.points == (*of_use, *beyond)
    assert whole.warnings == ("3 points past -270 deg were left out: a PI has no use for them", *alone.warnings)
    one = analyse([*of_use, beyond[0]], DesignSettings(), compare=False).warnings[0]
    assert one == "1 point past -270 deg was left out: a PI has no use for it"
