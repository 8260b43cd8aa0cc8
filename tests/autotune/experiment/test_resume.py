from __future__ import annotations

import math
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import InputError, OperatorStop
from autotune.experiment.cycles import Earlier, read_earlier
from autotune.experiment.result import ExperimentResult, Status
from autotune.experiment.run import run_experiment
from autotune.points import FrequencyPoint
from autotune.recording import read_recording
from tests.autotune.experiment.rigs import CONFIG, EACH, ball_config, ball_rig

SAMPLE_S = 0.01

CHILD = """
import os, signal, sys
from autotune.experiment.run import run_experiment
from tests.autotune.experiment.rigs import EACH, ball_config, ball_rig

def kill_in_the_third_setting(progress):
    if len(progress.points) == 2:
        os.kill(os.getpid(), signal.SIGKILL)

run_experiment(ball_rig(seed=7), ball_config(**EACH), sys.argv[1], on_status=kill_in_the_third_setting)
"""


def stop_in_the_third_setting(progress: Status) -> None:
    if len(progress.points) == 2:
        raise OperatorStop("stopped by the test", remedy="resume")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> ExperimentResult:
    return run_experiment(ball_rig(seed=7), ball_config(**EACH), tmp_path_factory.mktemp("whole") / "recording.csv")


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of a process that was killed in its third setting."""
    path = tmp_path_factory.mktemp("killed") / "recording.csv"
    child = subprocess.run([sys.executable, "-c", CHILD, str(path)], check=False, cwd=CONFIG.parents[1])
    assert child.returncode == -signal.SIGKILL
    return path


@pytest.fixture(scope="module")
def resumed(killed: Path) -> tuple[ExperimentResult, Earlier]:
    earlier = read_earlier([killed], SAMPLE_S)
    return run_experiment(
        ball_rig(seed=7), ball_config(**EACH), killed.with_name("recording-2.csv"), earlier=earlier
    ), earlier


def squared_distance(one: FrequencyPoint, other: complex) -> float:
    miss = one.response - other
    vector = np.array([miss.real, miss.imag])
    return float(vector @ np.linalg.solve(np.array(one.covariance), vector))


def test_a_killed_process_leaves_its_finished_cycles_in_the_sidecar(killed: Path, whole: ExperimentResult) -> None:
    recording = read_recording(killed)
    assert "killed" in recording.metadata["ended"]["reason"]
    tables = recording.metadata["relay"]
    assert [table["start_s"] for table in tables] == [one.start_s for one in whole.segments[:2]]


def test_points_from_the_disk_are_those_of_the_rig(killed: Path, whole: ExperimentResult) -> None:
    earlier = read_earlier([killed], SAMPLE_S)
    for one, other in zip(earlier.segments, whole.segments[:2], strict=True):
        # the same rows; the points of the cycles that came later make the rough model better, within the noise
        assert squared_distance(one.point, other.point.response) < 0.1


def test_a_resumed_run_measures_what_is_missing_and_agrees_with_an_uninterrupted_one(
    resumed: tuple[ExperimentResult, Earlier], whole: ExperimentResult
) -> None:
    result, _ = resumed
    assert len(result.points) == len(whole.points) == 5
    assert [one.part for one in result.segments] == [0, 0, 1, 1, 1]
    assert [one.phase_rad for one in result.segments] == [one.phase_rad for one in whole.segments]
    plant = ball_rig(seed=7).plant
    for point in (*result.points, *whole.points):
        truth = complex(plant.response(np.array([point.omega_rad_s]))[0])
        assert squared_distance(point, truth) < -2.0 * math.log(1e-4)  # ten regions together hold with 99.9 %
    # part of the rows is the same, so the hover command is at least as near as two independent runs would be
    assert result.u_rest == pytest.approx(whole.u_rest, abs=3.0 * math.hypot(result.u_rest_sd, whole.u_rest_sd))


def test_the_second_sitting_is_shorter_and_has_its_own_recording(
    resumed: tuple[ExperimentResult, Earlier], whole: ExperimentResult, killed: Path
) -> None:
    result, earlier = resumed
    assert [part.recording for part in result.parts] == ["recording.csv", "recording-2.csv"]
    assert [part.points for part in result.parts] == [2, 3]
    assert "killed" in result.parts[0].ended
    assert result.parts[1].rig_time_s < 0.8 * whole.rig_time_s
    assert result.rig_time_s == pytest.approx(sum(part.rig_time_s for part in result.parts))
    assert read_recording(killed).t == pytest.approx(earlier.recordings[0].t)
    second = read_recording(killed.with_name("recording-2.csv"))
    assert [table["start_s"] for table in second.metadata["relay"]] == [one.start_s for one in result.segments[2:]]


def test_a_complete_sweep_needs_no_rig(resumed: tuple[ExperimentResult, Earlier], killed: Path, tmp_path: Path) -> None:
    result, _ = resumed
    both = read_earlier([killed, killed.with_name("recording-2.csv")], SAMPLE_S)
    rig = ball_rig(seed=7)
    again = run_experiment(rig, ball_config(), tmp_path / "never.csv", earlier=both)
    assert rig.clock.now() == 0.0
    assert list(tmp_path.iterdir()) == []
    for one, other in zip(again.points, result.points, strict=True):
        assert one.omega_rad_s == pytest.approx(other.omega_rad_s, rel=1e-9)
        assert one.response == pytest.approx(other.response, rel=1e-6)
    assert again.u_rest == pytest.approx(result.u_rest, rel=1e-9)


def test_a_rig_that_still_moves_is_waited_for(tmp_path: Path) -> None:
    rig = ball_rig(seed=3)
    with pytest.raises(OperatorStop):
        run_experiment(rig, ball_config(), tmp_path / "recording.csv", on_status=stop_in_the_third_setting)
    # the turbine is off, and the ball is still on its way down
    earlier = read_earlier([tmp_path / "recording.csv"], SAMPLE_S)
    result = run_experiment(rig, ball_config(), tmp_path / "recording-2.csv", earlier=earlier)
    assert [part.points for part in result.parts] == [2, 3]
    assert "stopped by the test" in result.parts[0].ended


def test_a_sitting_that_ended_before_its_second_row_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "recording.csv").write_text("t,u,y\n0,0,9.9\n")
    assert read_earlier([tmp_path / "recording.csv"], SAMPLE_S).recordings == ()


def test_a_sidecar_that_tells_no_cycle_is_refused(tmp_path: Path) -> None:
    (tmp_path / "recording.csv").write_text("t,u,y\n0,0,1\n1,0,1\n")
    (tmp_path / "recording.toml").write_text("[[relay]]\nstart_s = 0.0\n")
    with pytest.raises(InputError, match=r"lacks .*begin a new run"):
        read_earlier([tmp_path / "recording.csv"], SAMPLE_S)


def test_a_recording_that_lost_its_end_gives_the_cycles_that_are_whole(tmp_path: Path) -> None:
    recording = tmp_path / "recording.csv"
    done = run_experiment(ball_rig(seed=3), ball_config(), recording)
    assert read_earlier([recording], SAMPLE_S).segments
    data = recording.read_bytes()
    for share in (0.0, 0.0001, 0.01, 0.3, 0.6, 0.9):
        recording.write_bytes(data[: int(share * len(data))])
        earlier = read_earlier([recording], SAMPLE_S)
        assert len(earlier.segments) < len(done.points), share
        whole_s = 0.0 if not earlier.recordings else earlier.recordings[0].t[-1] + SAMPLE_S
        assert all(segment.end_s <= whole_s for segment in earlier.segments), share
