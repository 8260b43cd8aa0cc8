from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.errors import ExperimentStopped, LinkError
from autotune.experiment import run
from autotune.experiment.loop import ControlLoop
from autotune.experiment.result import ExperimentResult, State, Status
from autotune.experiment.rig import Reading
from autotune.experiment.run import bring_to_operating_point, envelope_of, run_experiment
from autotune.recording import RecordingWriter, read_recording
from drivers.simulated import SimulatedRig
from sim.ball import make_ball
from tests.autotune.experiment.rigs import CONFIG, EACH, ball_config, ball_rig, open_loop
from tests.sim.imperfections import Fault, FaultyPlant


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[ExperimentResult, SimulatedRig, Path, list[Status]]:
    recording = tmp_path_factory.mktemp("run") / "recording.csv"
    rig = ball_rig(seed=7)
    told: list[Status] = []
    return run_experiment(rig, ball_config(), recording, on_status=told.append), rig, recording, told


Finished = tuple[ExperimentResult, SimulatedRig, Path, list[Status]]


def test_five_points_in_the_wanted_range_within_their_regions(finished: Finished) -> None:
    result, rig, _, _ = finished
    omega = np.array([point.omega_rad_s for point in result.points])
    truth = rig.plant.response(omega)
    assert len(omega) == 5
    assert np.all((np.degrees(np.angle(-truth)) < -105.0) & (np.degrees(np.angle(-truth)) > -160.0))
    for point, value in zip(result.points, truth, strict=True):
        miss = point.response - value
        vector = np.array([miss.real, miss.imag])
        # all five regions together hold with 99.99 %
        assert vector @ np.linalg.solve(np.array(point.covariance), vector) < -2.0 * math.log(2e-5)
        assert abs(miss) < 0.03 * abs(value)


def test_the_hover_voltage_the_noise_and_the_sign_are_found(finished: Finished) -> None:
    result, rig, _, _ = finished
    assert result.u_rest == pytest.approx(rig.plant.u_rest, abs=0.002)
    assert result.u_rest_sd < 0.001
    assert result.noise_sd == pytest.approx(0.35 / math.sqrt(3.0), rel=0.1)
    assert result.plant_sign == -1
    assert result.sweep_time_s <= 60.0


def test_the_recording_tells_the_whole_procedure(finished: Finished) -> None:
    result, _, path, _ = finished
    recording = read_recording(path)
    states = [state["name"] for state in recording.metadata["states"]]
    assert states == ["preflight", "approach", "find the mid-point", "relay sweep", "hand back"]
    assert [one["start_s"] for one in recording.metadata["relay"]] == [s.start_s for s in result.segments]
    assert recording.metadata["ended"]["reason"] == "completed"
    # every command lies on the converter's grid
    steps = recording.u / ball_config().signals.u_step
    assert steps == pytest.approx(np.round(steps), abs=1e-6)


def test_the_ball_stays_within_the_swing(finished: Finished) -> None:
    result, _, path, _ = finished
    recording = read_recording(path).between(result.segments[0].start_s, result.segments[-1].end_s)
    assert np.abs(recording.y - 5.0).max() < 3.0 + 0.36


def test_progress_says_how_long_it_will_take(finished: Finished) -> None:
    _, _, _, told = finished
    sweeping = [one for one in told if one.state is State.SWEEP and math.isfinite(one.remaining_s)]
    assert len(sweeping) >= 4
    assert all(0.0 <= one.fraction <= 1.0 for one in told)
    assert sweeping[0].remaining_s == pytest.approx(20.0, abs=3.0)


def test_the_describing_function_is_shown_with_its_error(finished: Finished) -> None:
    result, _, _, _ = finished
    for segment in result.segments:
        # first-harmonic formulas: the hysteresis and the hold turn the phase, the relay's third harmonic the gain
        assert 1.0 < segment.describing.gain / segment.point.gain < 1.8
        turned = segment.describing.phase_rad - np.angle(result.plant_sign * segment.point.response)
        assert math.remainder(turned, 2.0 * math.pi) < 0.0


def test_without_noise_the_points_are_exact(tmp_path: Path) -> None:
    rig = ball_rig(noise=0.0)
    result = run_experiment(rig, ball_config(), tmp_path / "r.csv")
    assert result.warnings == ()  # what little is left may differ between the points as it likes
    for point in result.points:
        ratio = point.response / rig.plant.response(np.array([point.omega_rad_s]))[0]
        assert abs(abs(ratio) - 1.0) < 1e-3
        assert abs(math.degrees(math.atan2(ratio.imag, ratio.real))) < 0.1


def test_a_ball_left_on_the_floor_is_floated_again_from_a_known_hover_voltage(tmp_path: Path) -> None:
    rig = ball_rig(seed=3)
    with open_loop(rig, tmp_path / "r.csv") as loop:
        known = bring_to_operating_point(loop, ball_config(), u_rest=rig.plant.u_rest)
        assert abs(rig.plant.y_true - 5.0) < 3.0
        assert known.midpoint == pytest.approx(rig.plant.u_rest, abs=0.03)


FAULTS = {
    "stale sensor": [Fault(kind="frozen sensor", start_s=20.0)],
    "not a number": [Fault(kind="not a number", start_s=20.0)],
    "the sensor jumps": [Fault(kind="sensor at full scale", start_s=20.0, value=10.0)],
    "does not follow": [Fault(kind="stuck actuator", start_s=20.0)],
    "the device applies": [Fault(kind="saturated actuator", value=4.0)],
    "does not answer": [Fault(kind="frozen sensor")],
    "wrong sign": [Fault(kind="inverted actuator", value=5.0)],
    "link cut": [Fault(kind="cut link", start_s=20.0)],
}


class Mute(SimulatedRig):
    """A rig that does not say what it applies."""

    def read(self) -> Reading:
        return replace(super().read(), u_applied=math.nan)


@pytest.mark.parametrize(
    ("seed", "start_s", "level"),
    [(1, 22.0, 4.6), (1, 40.0, 4.6), (2, 22.0, 5.1), (2, 40.0, 4.9), (3, 22.0, 4.8), (3, 40.0, 4.77)],
)
def test_an_actuator_that_saturates_in_mid_sweep_is_named_though_nobody_reads_it_back(
    seed: int, start_s: float, level: float, tmp_path: Path
) -> None:
    fault = Fault(kind="saturated actuator", start_s=start_s, value=level)
    rig = Mute(FaultyPlant(make_ball(seed=seed, noise=0.35), [fault]), u_safe=0.0)
    with pytest.raises(ExperimentStopped, match="relay sweep: y does not follow the command"):
        run_experiment(rig, ball_config(**EACH), tmp_path / "r.csv")
    assert rig.command == 0.0


@pytest.mark.parametrize(("seed", "start_s", "share"), [(1, 15.0, 0.8), (2, 31.0, 0.8), (3, 23.0, 0.8)])
def test_an_actuator_that_clips_a_part_of_the_relay_in_mid_sweep_is_warned_of(
    seed: int, start_s: float, share: float, tmp_path: Path
) -> None:
    """The oscillation goes on, so nothing stops it; what y does beside it says that something changed."""
    config = ball_config(**EACH)
    whole = run_experiment(ball_rig(seed=seed), config, tmp_path / "whole.csv")
    assert whole.warnings == ()
    hit = next(one for one in whole.segments if one.end_s > start_s)
    level = hit.settings.midpoint + share * hit.settings.amplitude
    fault = Fault(kind="saturated actuator", start_s=start_s, value=level)
    rig = Mute(FaultyPlant(make_ball(seed=seed, noise=0.35), [fault]), u_safe=0.0)
    (warning,) = run_experiment(rig, config, tmp_path / "clipped.csv").warnings
    named = re.search(
        r"wanted: look for an actuator at its limit, .* at (\S+) to (\S+) s, where y swings less", warning
    )
    assert named
    assert float(named[1]) < start_s < float(named[2])


@pytest.mark.parametrize("seed", [1, 4])
def test_a_relay_that_fails_on_noise_says_so(seed: int, tmp_path: Path) -> None:
    with pytest.raises(ExperimentStopped, match="drowned in noise"):
        run_experiment(ball_rig(seed=seed, noise=1.0), ball_config(), tmp_path / "r.csv")


def test_an_amplitude_that_a_person_asked_for_and_that_is_too_large_is_not_called_saturation(tmp_path: Path) -> None:
    config = ball_config(experiment={"relay_amplitude": 0.6})
    with pytest.raises(ExperimentStopped, match=r"limits\.swing .* ask for a smaller relay_amplitude"):
        run_experiment(ball_rig(seed=1), config, tmp_path / "r.csv")


@pytest.mark.parametrize("verdict", FAULTS)
def test_every_fault_has_its_verdict_ends_safe_and_keeps_the_recording(verdict: str, tmp_path: Path) -> None:
    rig = ball_rig(faults=FAULTS[verdict])
    with pytest.raises(ExperimentStopped, match=verdict) as stop:
        run_experiment(rig, ball_config(), tmp_path / "r.csv")
    assert stop.value.exit_status == 3
    assert "\n" not in str(stop.value)
    assert stop.value.remedy
    assert rig.command == 0.0
    recording = read_recording(tmp_path / "r.csv")
    assert recording.u[-1] == 0.0
    assert recording.metadata["ended"]["reason"] == str(stop.value)


@pytest.mark.parametrize("share", [0.5, 0.7])
def test_a_sensor_that_jumps_no_further_than_y_may_is_not_taken_for_the_actuator(share: float, tmp_path: Path) -> None:
    whole = run_experiment(ball_rig(seed=2), ball_config(**EACH), tmp_path / "whole.csv")
    rows = read_recording(tmp_path / "whole.csv").between(whole.segments[0].start_s, whole.segments[-1].end_s)
    far = rows.t[rows.y < 6.0]  # nearer to its end a jump is lost in the noise
    start_s = float(far[int(share * far.size)])
    rig = ball_rig(seed=2, faults=[Fault(kind="sensor at full scale", start_s=start_s, value=9.0)])
    with pytest.raises(ExperimentStopped, match=r"the sensor jumps"):
        run_experiment(rig, ball_config(**EACH), tmp_path / "r.csv")


@pytest.mark.parametrize("value", [0.0, 10.0])
def test_spikes_of_the_sensor_are_survived(value: float, tmp_path: Path) -> None:
    rig = ball_rig(seed=2, faults=[Fault(kind="spikes", value=value)])
    result = run_experiment(rig, ball_config(), tmp_path / "r.csv")
    for point in result.points:
        truth = rig.plant.response(np.array([point.omega_rad_s]))[0]
        assert abs(point.response - truth) < 0.05 * abs(truth)
    assert result.timing.unusable > 100


def test_a_sign_that_contradicts_the_configuration_is_named(tmp_path: Path) -> None:
    with pytest.raises(ExperimentStopped, match="wrong sign"):
        run_experiment(ball_rig(), ball_config(operating_point={"plant_sign": 1}), tmp_path / "r.csv")


def test_a_sensor_that_is_more_noise_than_swing_is_named(tmp_path: Path) -> None:
    with pytest.raises(ExperimentStopped, match="drowned in noise"):
        run_experiment(ball_rig(noise=3.0), ball_config(), tmp_path / "r.csv")


def test_a_hover_voltage_outside_its_bracket_is_named(tmp_path: Path) -> None:
    with pytest.raises(ExperimentStopped, match="does not answer"):
        run_experiment(ball_rig(), ball_config(operating_point={"u_guess": 3.5}), tmp_path / "r.csv")


def test_a_link_that_is_cut_from_the_start_refuses_before_anything_moves(tmp_path: Path) -> None:
    with pytest.raises(LinkError):
        run_experiment(ball_rig(faults=[Fault(kind="cut link")]), ball_config(), tmp_path / "r.csv")
    assert "link cut" in (tmp_path / "r.toml").read_text()


CHILD = """
import sys
from autotune.errors import AutotuneError
from autotune.config import load_config
from autotune.experiment.run import run_experiment
from drivers.simulated import SimulatedRig
from sim.ball import make_ball

def wait(progress):
    if progress.state.value == "relay sweep":
        print("sweeping", flush=True)
        sys.stdin.readline()

rig = SimulatedRig(make_ball(seed=1), u_safe=0.0)
try:
    run_experiment(rig, load_config(sys.argv[1]), sys.argv[2], on_status=wait)
except AutotuneError as error:
    print(error, rig.command, flush=True)
    sys.exit(error.exit_status)
"""


def stopped_by(number: signal.Signals, recording: Path) -> tuple[int, str]:
    """Start an experiment in a child, stop it in its sweep, and return its exit status and last words."""
    command: Sequence[str] = (sys.executable, "-c", CHILD, str(CONFIG), str(recording))
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "sweeping\n"
        child.send_signal(number)
        words, _ = child.communicate("\n")
        return child.returncode, words


@pytest.mark.parametrize(("number", "name"), [(signal.SIGINT, "Ctrl-C"), (signal.SIGTERM, "SIGTERM")])
def test_a_stopped_process_leaves_the_rig_safe_with_status_130(
    number: signal.Signals, name: str, tmp_path: Path
) -> None:
    status, words = stopped_by(number, tmp_path / "r.csv")
    assert status == 130
    assert words.startswith(f"relay sweep: stopped by {name}")
    assert words.endswith("0.0\n")  # the rig's command
    recording = read_recording(tmp_path / "r.csv")
    assert recording.u[-1] == 0.0
    assert recording.metadata["ended"]["exit_status"] == 130


def test_a_killed_process_leaves_a_readable_recording(tmp_path: Path) -> None:
    status, _ = stopped_by(signal.SIGKILL, tmp_path / "r.csv")
    assert status == -signal.SIGKILL
    recording = read_recording(tmp_path / "r.csv")
    assert len(recording) > 500
    assert np.all(np.isfinite(recording.y))
    assert "killed" in recording.metadata["ended"]["reason"]


def test_all_cycles_are_estimated_together_once_the_rig_is_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That takes as long as many samples: in the open loop it was a link too slow."""
    rig, held = ball_rig(seed=7), []
    real = run.refine_cycles

    def looked(*given: Any) -> Any:
        held.append(rig.command)
        return real(*given)

    monkeypatch.setattr(run, "refine_cycles", looked)
    run_experiment(rig, ball_config(), tmp_path / "recording.csv")
    assert held == [0.0]


@pytest.mark.parametrize("sample_time_s", [0.005, 0.01])
def test_a_faster_host_ramps_no_faster(tmp_path: Path, sample_time_s: float) -> None:
    config = ball_config()
    config = config.model_copy(
        update={"signals": config.signals.model_copy(update={"sample_time_s": sample_time_s, "u_step": 0.0})}
    )
    writer = RecordingWriter(tmp_path / "ramp.csv", ("t", "u", "y"))
    with ControlLoop(rig=ball_rig(seed=7), envelope=envelope_of(config), writer=writer) as loop:
        bring_to_operating_point(loop, config)
        t, u, _ = loop.history()
    begun = int(np.argmax(u > 4.3))
    climbing = slice(begun, begun + round(0.5 / sample_time_s))  # half a second of the ramp, before the ball moves
    rate = float(np.polyfit(t[climbing], u[climbing], 1)[0])
    assert rate == pytest.approx(config.operating_point.u_uncertainty / 6.0, rel=0.05)
