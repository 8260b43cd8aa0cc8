from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.config import load_config
from autotune.controller import PIDController
from autotune.errors import ExperimentStopped
from autotune.experiment.loop import ControlLoop
from autotune.experiment.run import envelope_of
from autotune.experiment.verify import StepTest, judge, law_for, plan_test, smoothed
from autotune.identification.parametric import fit_plant
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint
from autotune.recording import RecordingWriter
from drivers.simulated import SimulatedRig
from sim.plant import make_plant

CONFIG = load_config(Path(__file__).resolve().parents[3] / "configs" / "ball_sim.toml")
BALL = TransferFunction(num=(-65.5,), den=(2.02e-5, 0.007328, 0.3836, 1.0, 0.0))
PI = PIDController(K=-0.0247, Ti_s=3.6)


def fitted() -> object:
    points = []
    for omega in (0.9, 1.5, 2.4, 3.5, 5.0):
        response = complex(BALL.response(np.array([omega]))[0])
        variance = (0.004 * abs(response)) ** 2
        points.append(
            FrequencyPoint(omega_rad_s=omega, response=response, covariance=((variance, 0.0), (0.0, variance)))
        )
    return fit_plant(points)


FIT = fitted()
LAW = law_for(PI, CONFIG.limits, 0.01)
TEST = plan_test(CONFIG, LAW, FIT, 1.4)


def measured(plant: TransferFunction, seed: int) -> tuple[np.ndarray, np.ndarray]:
    from autotune.experiment.prediction import predict

    run = predict(plant, [plant], LAW, TEST.setpoint, TEST.disturbance, 0.2, np.random.default_rng(seed))
    return run.y_draws[0], run.u


def test_the_steps_stay_within_half_of_the_swing() -> None:
    quiet = np.zeros_like(TEST.setpoint)
    assert isinstance(TEST, StepTest)
    assert TEST.setpoint.max() <= CONFIG.limits.swing / 2
    y, _ = measured(BALL, 0)
    assert np.abs(smoothed(y - TEST.setpoint, TEST)).max() < 0.5 * CONFIG.limits.swing
    assert quiet.size == TEST.t.size


def test_the_load_leaves_half_of_the_commands_room_to_a_plant_that_hardly_answers() -> None:
    weak = replace(FIT, plant=replace(FIT.plant, num=tuple(1e-4 * b for b in FIT.plant.num)))
    assert plan_test(CONFIG, LAW, weak, 1.4).disturbance[-1] == 2.5  # u_guess 5 V of 0 to 10 V


def test_the_true_plant_is_accepted_and_a_gain_or_delay_of_half_as_much_again_is_not() -> None:
    accepted = [judge(TEST, *measured(BALL, seed), LAW, FIT, 0.2).accepted for seed in range(10)]
    assert all(accepted)
    stronger = replace(BALL, num=(-65.5 * 1.5,))
    slower = replace(BALL, delay_s=0.2)
    for other in (stronger, slower):
        assert not any(judge(TEST, *measured(other, seed), LAW, FIT, 0.2).accepted for seed in range(5))


def test_samples_that_were_lost_do_not_decide() -> None:
    y, u = measured(BALL, 3)
    y[::50] = math.nan
    assert judge(TEST, y, u, LAW, FIT, 0.2).accepted


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs the full device of Linux")
def test_a_full_disk_ends_in_the_safe_output_with_its_reason(tmp_path: Path) -> None:
    rig = SimulatedRig(make_plant("ball", seed=1), u_safe=0.0)
    os.symlink("/dev/full", tmp_path / "full")
    writer = RecordingWriter(tmp_path / "rec.csv", ("t", "u", "y"))

    def fill_the_disk_while_the_loop_runs() -> None:
        with ControlLoop(rig=rig, envelope=envelope_of(CONFIG), writer=writer) as loop:
            loop.step(1.0)
            with open(tmp_path / "full", "wb", buffering=0) as full:
                os.dup2(full.fileno(), writer._file.fileno())
            loop.step(2.0)

    with pytest.raises(ExperimentStopped, match="recording cannot be written"):
        fill_the_disk_while_the_loop_runs()
    assert rig.command == 0.0
