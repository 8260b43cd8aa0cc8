from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from autotune.config import load_config
from autotune.config.rig import SerialSettings
from autotune.controller import PIDController
from autotune.errors import DesignError, ExperimentStopped
from autotune.experiment.judgement import Verification, expectation, judge, require_predictable, smooth_steps
from autotune.experiment.loop import ControlLoop
from autotune.experiment.run import envelope_of
from autotune.experiment.step_test import StepTest, plan_test
from autotune.experiment.verify import law_for, run_verification
from autotune.identification.parametric import PlantFit, fit_plant
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint
from autotune.recording import RecordingWriter
from drivers import open_rig
from drivers.simulated import SimulatedRig
from sim.plant import make_plant

CONFIG = load_config(Path(__file__).resolve().parents[3] / "configs" / "ball_sim.toml")
BALL = TransferFunction(num=(-65.5,), den=(2.02e-5, 0.007328, 0.3836, 1.0, 0.0))
PI = PIDController(K=-0.0247, Ti_s=3.6)


def fitted(plant: TransferFunction, *omegas: float, relative_sd: float = 0.004) -> PlantFit:
    points = []
    for omega in omegas:
        response = complex(plant.response(np.array([omega]))[0])
        variance = (relative_sd * abs(response)) ** 2
        points.append(
            FrequencyPoint(omega_rad_s=omega, response=response, covariance=((variance, 0.0), (0.0, variance)))
        )
    return fit_plant(points)


FIT = fitted(BALL, 0.9, 1.5, 2.4, 3.5, 5.0)
LAW = law_for(PI, CONFIG.limits, 0.01)
TEST = plan_test(CONFIG, LAW, FIT, 1.4)


def measured(plant: TransferFunction, seed: int) -> tuple[np.ndarray, np.ndarray]:
    from autotune.experiment.prediction import predict

    run = predict(plant, [plant], LAW, TEST.setpoint, TEST.disturbance, 0.2, np.random.default_rng(seed), u_rest=5.0)
    return run.y_draws[0], run.u


def test_the_steps_stay_within_half_of_the_swing() -> None:
    quiet = np.zeros_like(TEST.setpoint)
    assert isinstance(TEST, StepTest)
    assert TEST.setpoint.max() <= CONFIG.limits.swing / 2
    y, _ = measured(BALL, 0)
    assert np.abs(smooth_steps(y - TEST.setpoint, TEST)).max() < 0.5 * CONFIG.limits.swing
    assert quiet.size == TEST.t.size


def test_the_load_leaves_half_of_the_commands_room_to_a_plant_that_hardly_answers() -> None:
    weak = replace(FIT, plant=replace(FIT.plant, num=tuple(1e-4 * b for b in FIT.plant.num)))
    assert plan_test(CONFIG, LAW, weak, 1.4).disturbance[-1] == 2.5  # u_guess 5 V of 0 to 10 V


def test_the_true_plant_is_accepted_and_a_gain_or_delay_of_half_as_much_again_is_not() -> None:
    accepted = [judge(TEST, *measured(BALL, seed), LAW, FIT, 0.2, u_rest=5.0).accepted for seed in range(10)]
    assert all(accepted)
    stronger = replace(BALL, num=(-65.5 * 1.5,))
    slower = replace(BALL, delay_s=0.2)
    for other in (stronger, slower):
        assert not any(judge(TEST, *measured(other, seed), LAW, FIT, 0.2, u_rest=5.0).accepted for seed in range(5))


def test_samples_that_were_lost_do_not_decide() -> None:
    y, u = measured(BALL, 3)
    y[::50] = math.nan
    assert judge(TEST, y, u, LAW, FIT, 0.2, u_rest=5.0).accepted


LAGS = TransferFunction(num=(1.0,), den=(1.0, 2.5, 1.0), delay_s=0.1)
FAST = PIDController(K=4.3, Ti_s=2.65)  # a step of a third of the swing asks for more than the command has


def verified(
    folder: Path,
    *,
    u_range: tuple[float, float] = (0.0, 10.0),
    delay_s: float = 0.1,
    rate: float = math.inf,
    kind: SerialSettings | None = None,
    **steps: Any,
) -> Verification:
    """Verify the gains on a rig of two lags, in virtual time; it may be taken for one of another kind."""
    (folder / "lags.toml").write_text(
        'name = "lags"\n[input]\nunit = "V"\n[output]\nunit = "V"\n[[block]]\nname = "lags"\nplace = "plant"\n'
        f"num = [1.0]\nden = [1.0, 2.5, 1.0]\ndelay = {delay_s}\n"
    )
    rate_limit = {} if math.isinf(rate) else {"u_rate": rate}
    content = {
        "name": "lags",
        "rig": {"kind": "simulated", "model": str(folder / "lags.toml"), "noise": 0.005},
        "signals": {"sample_time_s": 0.2, "u_unit": "V", "y_unit": "V"},
        "limits": {
            "u_min": u_range[0], "u_max": u_range[1], "u_safe": u_range[0], "y_min": -1.0, "y_max": 9.5, "swing": 3.0,
            "time_s": 300.0, **rate_limit,
        },
        "operating_point": {"y": 5.0, "u_guess": 5.0, "u_uncertainty": 0.5, "approach": "ramp", "ramp_rate": 0.4},
        "experiment": {"budget_s": 200.0},
        "design": {"noise_gain": 20.0},
        "verification": steps,
    }  # fmt: skip
    (folder / "rig.toml").write_text(tomli_w.dumps(content))
    config = load_config(folder / "rig.toml")
    rig = open_rig(config.rig, u_range=u_range, u_safe=u_range[0])
    fit = fitted(LAGS, 0.9, 1.5, 3.0)
    config = config if kind is None else config.model_copy(update={"rig": kind})
    return run_verification(rig, config, FAST, fit, folder / "verification.csv", u_rest=5.0)


def test_a_sound_loop_is_accepted_where_its_steps_ask_for_more_than_the_command_has(tmp_path: Path) -> None:
    chosen, wide, slow = (tmp_path / name for name in ("chosen", "wide", "slow"))
    for folder in (chosen, wide, slow):
        folder.mkdir()
    steps_chosen = verified(chosen)
    assert steps_chosen.accepted, steps_chosen.reason
    assert "limit" not in steps_chosen.reason
    wide_steps = verified(wide, setpoint_step=2.0, disturbance_step=3.0)
    assert wide_steps.accepted, wide_steps.reason
    assert wide_steps.u.max() == 10.0
    slow_actuator = verified(slow, rate=4.0, setpoint_step=1.0)
    assert slow_actuator.accepted, slow_actuator.reason


def test_the_steps_keep_to_the_commands_room_where_a_dead_time_still_shows(tmp_path: Path) -> None:
    expected, late = tmp_path / "expected", tmp_path / "late"
    for folder in (expected, late):
        folder.mkdir()
    sound = verified(expected, u_range=(4.0, 6.0))
    assert sound.accepted, sound.reason
    assert 4.0 < sound.u.min() < sound.u.max() < 6.0
    assert not verified(late, u_range=(4.0, 6.0), delay_s=0.3).accepted


def test_a_device_that_holds_gains_and_cannot_be_started_is_not_called_verified(tmp_path: Path) -> None:
    """A microcontroller whose host computes the PI has a law of its own; a simulated rig has none."""
    on_line = SerialSettings.model_validate(
        {"kind": "serial", "device": "/dev/none", "y_span": (0.0, 10.0), "u_span": (0.0, 10.0)}
    )
    real, played = tmp_path / "real", tmp_path / "played"
    for folder in (real, played):
        folder.mkdir()
    found = verified(real, kind=on_line)
    assert found.accepted
    assert found.by == "host"
    assert found.whose == "host's law verified; the device's own law not tried (the host has no means to start it)"
    assert verified(played).whose == "host's law verified on a simulated rig"


def test_a_command_at_its_limit_for_long_is_told(tmp_path: Path) -> None:
    narrow = verified(tmp_path, u_range=(4.0, 6.0), setpoint_step=0.9)
    assert narrow.accepted, narrow.reason
    assert "the command is at its limit for" in narrow.reason


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


#: gains that leave less room than the tuned ones
HOT = PIDController(K=-0.06, Ti_s=1.5)


def test_an_error_that_nearly_any_loop_would_have_verifies_nothing() -> None:
    law = replace(LAW, controller=HOT)
    test = plan_test(CONFIG, law, FIT, 3.0)
    loose = fitted(BALL, 0.9, 1.5, 2.4, 3.5, 5.0, relative_sd=0.4)
    y = expectation(test, law, loose, 0.2, u_rest=5.0).prediction.y  # exactly as expected
    sound = judge(test, y, np.zeros_like(y), law, FIT, 0.2, u_rest=5.0)
    assert sound.allowed < abs(test.setpoint[0]) / 3.0
    loud = judge(test, y, np.zeros_like(y), law, loose, 0.2, u_rest=5.0)
    assert loud.rms_error <= loud.allowed
    assert not loud.accepted
    assert "nothing is verified" in loud.reason
    assert "measure the points again" in loud.reason


def test_points_that_leave_stability_open_are_refused_before_the_rig_is_touched() -> None:
    assert require_predictable(FIT, HOT).stable
    loose = fitted(BALL, 0.9, 1.5, 2.4, relative_sd=1.0)
    with pytest.raises(DesignError, match=r"of 60 plants that the points allow make no stable loop.*") as refused:
        require_predictable(loose, HOT)
    assert "measure points around" in refused.value.remedy


def test_points_that_contradict_their_covariance_are_refused_and_small_errors_of_structure_are_not() -> None:
    points = []
    for omega, factor in ((0.9, 1.0), (1.5, 1.25), (2.4, 1.0), (3.5, 1.2), (5.0, 1.0)):
        response = factor * complex(BALL.response(np.array([omega]))[0])
        variance = (0.004 * abs(response)) ** 2
        covariance = ((variance, 0.0), (0.0, variance))
        points.append(FrequencyPoint(omega_rad_s=omega, response=response, covariance=covariance))
    with pytest.raises(DesignError, match="the points contradict their covariance: chi-square"):
        require_predictable(fit_plant(points), PI)
    slight = replace(FIT, chi_square=100.0, degrees_of_freedom=2)
    assert slight.p_value < 1e-10
    assert require_predictable(slight, PI).stable
