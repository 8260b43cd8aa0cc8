"""Dither over real lines: the law is read from the device, runs on the host, and the device is left safe."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from autotune.config import load_config
from autotune.controller import PIDController
from autotune.experiment.dither import run_dither
from autotune.identification.closed_loop.control_law import check_law
from autotune.recording import read_recording
from tests.drivers.bench import Bench, serial_bench, tcp_bench

CONFIG = """
name = "servo on a line"
rig = { kind = "simulated", plant = "servo" }
signals = { sample_time_s = 0.05, u_unit = "V", y_unit = "rad" }
operating_point = { y = 0.0, u_guess = 0.0, u_uncertainty = 0.3, approach = "hold" }
experiment = { phases_deg = [-105.0, -160.0], points = 5, budget_s = 6.0 }
[limits]
u_min = -10.0
u_max = 10.0
u_safe = -0.5
y_min = -3.0
y_max = 3.0
swing = 2.0
time_s = 20.0
late_s = 2.0
"""


@pytest.fixture(params=["tcp", "serial"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    # the rig lives in this process: where the computer is busy its host is late, and that is not what is tested; nor is
    # how late the loop may be, so that limits.late_s is large
    context = tcp_bench(timeout_s=2.0) if request.param == "tcp" else serial_bench(deadman_s=5.0)
    with context as made:
        yield made


def test_dither_runs_the_devices_own_gains_and_leaves_it_safe(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(CONFIG)
    config = load_config(tmp_path / "config.toml")
    done = run_dither(bench.rig, config, tmp_path / "dither.csv", duration_s=1.5, amplitude=0.4)
    assert (done.controller.K, done.controller.Ti_s) == pytest.approx((1.5, 2.0))
    recording = read_recording(tmp_path / "dither.csv")
    rows = np.isfinite(recording["dither"]) & np.isfinite(recording.y)
    assert rows.sum() >= 30
    u, y, added = recording.u[rows], recording.y[rows], recording["dither"][rows]
    assert np.max(np.abs(added)) == pytest.approx(0.4, abs=0.01)
    law = check_law(PIDController(K=1.5, Ti_s=2.0), u, y, recording["r"][rows], 0.05, added=added)
    assert law.unexplained < 0.05  # of the command's motion; rounding to a count of 1.25 mV is 2 % of it
    safe = [pytest.approx(value, abs=0.01) for value in (-0.5, 0.0)]  # the host's, or the dead-man's
    assert bench.output() in safe
