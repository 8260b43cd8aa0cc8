from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from autotune.config import load_config
from autotune.config.rig import ReplaySettings
from autotune.errors import InputError, LinkError
from autotune.experiment.loop import ControlLoop
from autotune.experiment.rig import Rig
from autotune.experiment.run import envelope_of, run_experiment
from autotune.recording import Recording, RecordingWriter, read_recording
from drivers import open_rig
from drivers.replay import ReplayRig
from tests.drivers.bench import serial_bench

T = np.array([0.0, 0.011, 0.019, 0.032])
U = np.array([1.0, -1.0, 1.0, 0.0])
Y = np.array([0.0, 0.1, math.nan, 0.3])


def test_the_rows_come_back_as_they_were_recorded_stamps_and_all() -> None:
    rig = ReplayRig(Recording(t=T, u=U, y=Y))
    rig.open()
    readings = [rig.read() for _ in T]
    assert [reading.t_s for reading in readings] == T.tolist()
    np.testing.assert_array_equal([reading.y for reading in readings], Y)
    # what acted while y was measured is the command of the row before
    np.testing.assert_array_equal([reading.u_applied for reading in readings], [math.nan, 1.0, -1.0, 1.0])
    assert rig.clock.now() == T[-1]


def test_another_command_than_the_recorded_one_ends_the_replay() -> None:
    rig = ReplayRig(Recording(t=T, u=U, y=Y, name="bench.csv"))
    rig.open()
    rig.read()
    rig.write(1.0)
    rig.read()
    with pytest.raises(LinkError, match=r"bench.csv: command 0.5 at t = 0.011 s, where -1 was recorded"):
        rig.write(0.5)


def test_the_end_of_the_recording_is_said() -> None:
    rig = ReplayRig(Recording(t=T, u=U, y=Y))
    rig.open()
    for _ in T:
        rig.read()
    with pytest.raises(LinkError, match=r"ends at t = 0.032 s"):
        rig.read()


def test_a_replay_is_reached_like_any_other_rig(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    writer = RecordingWriter(path, ("t", "u", "y", "u_applied"), {})
    for row in zip(T, U, (0.0, 0.1, 0.2, 0.3), (9.0, 8.0, 7.0, 6.0), strict=True):
        writer.append(row)
    writer.finish({})
    rig = open_rig(ReplaySettings(kind="replay", recording=str(path)), u_range=(-1, 1), u_safe=0.0)
    rig.open()
    assert rig.read().u_applied == 9.0
    with pytest.raises(InputError, match="no such file"):
        open_rig(ReplaySettings(kind="replay", recording=str(tmp_path / "none.csv")), u_range=(-1, 1), u_safe=0.0)


def test_a_replayed_experiment_gives_the_points_that_were_measured(tmp_path: Path) -> None:
    config = load_config(Path(__file__).parents[2] / "configs" / "ball_sim.toml")
    live = open_rig(config.rig, u_range=(0.0, 10.0), u_safe=0.0)
    measured = run_experiment(live, config, tmp_path / "live.csv").points
    settings = ReplaySettings(kind="replay", recording=str(tmp_path / "live.csv"))
    replayed = run_experiment(
        open_rig(settings, u_range=(0.0, 10.0), u_safe=0.0), config, tmp_path / "replayed.csv"
    ).points
    assert len(replayed) == len(measured)
    for one, other in zip(measured, replayed, strict=True):
        assert other.omega_rad_s == pytest.approx(one.omega_rad_s, rel=1e-9)
        assert abs(other.response / one.response - 1.0) < 1e-8  # twelve digits in the file


def test_a_recording_of_exchanged_samples_is_gone_through_by_the_law_that_made_it(tmp_path: Path) -> None:
    def go(rig: Rig, path: Path) -> None:
        config = load_config(Path(__file__).parents[2] / "configs" / "servo_sim.toml")
        writer = RecordingWriter(path, ("t", "u", "y"), {"rig": "serial"})
        with ControlLoop(rig=rig, envelope=envelope_of(config), writer=writer) as loop:
            for _ in range(40):
                loop.step(loop.nearest(-0.4 if loop.tick.y > 0.0 else 0.4))

    with serial_bench(deadman_s=5.0) as bench:
        go(bench.rig, tmp_path / "first.csv")
    first = read_recording(tmp_path / "first.csv")
    tolerance = 20.0 / 16000  # a count of the output
    settings = ReplaySettings(kind="replay", recording=first.name, tolerance=tolerance)
    go(open_rig(settings, u_range=(-1.0, 1.0), u_safe=0.0), tmp_path / "again.csv")
    again = read_recording(tmp_path / "again.csv")
    for column in ("t", "u", "y"):
        np.testing.assert_allclose(again[column][:-1], first[column][:-1], atol=1e-9)
