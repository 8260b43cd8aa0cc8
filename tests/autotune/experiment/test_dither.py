"""Dither under the present controller: the signal, the envelope, and the plant that comes out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.cli.closed_loop import dither
from autotune.config import load_config
from autotune.controller import PIDController
from autotune.errors import InputError
from autotune.experiment.dither import random_dwells, run_dither
from autotune.identification.closed_loop.identify import identify_closed_loop
from autotune.recording import read_recording
from drivers import open_rig

CONFIGS = Path(__file__).resolve().parents[3] / "configs"


@given(rows=st.integers(1, 500), shortest=st.integers(1, 20), longest=st.integers(21, 50), seed=st.integers(0, 99))
@settings(max_examples=30)
def test_dither_is_binary_and_dwells_within_what_was_asked(rows: int, shortest: int, longest: int, seed: int) -> None:
    signal = random_dwells(rows, longest, seed, shortest)
    assert set(np.unique(signal)) <= {-1.0, 1.0}
    changes = np.flatnonzero(np.diff(signal)) + 1
    dwells = np.diff(np.concatenate([[0], changes, [rows]]))
    assert np.max(dwells) <= longest
    assert np.all(dwells[:-1] >= shortest)


def test_ball_under_its_slow_controller_tells_its_gain_within_its_limits(tmp_path: Path) -> None:
    config = load_config(CONFIGS / "ball_sim.toml")
    limits = config.limits
    rig = open_rig(config.rig, u_range=(limits.u_min, limits.u_max), u_safe=limits.u_safe)
    done = run_dither(rig, config, tmp_path / "d.csv", duration_s=40.0)
    recording = read_recording(tmp_path / "d.csv")
    assert done.departure < limits.swing
    assert np.all((recording.u >= limits.u_min) & (recording.u <= limits.u_max))
    found = identify_closed_loop(recording, controller=done.controller, order=2)
    assert found.law is not None
    assert found.estimate.converged  # at 10 ms the plant's poles, and the noise model's, crowd at one
    assert found.law.unexplained < 1e-6  # the recorded dither is what the law did not ask for
    near = [point for point in found.points if 1.0 < point.omega_rad_s < 6.0]
    assert near
    for point in near:
        s = 1j * point.omega_rad_s
        truth = -65.5 / (2.02e-5 * s**4 + 0.007328 * s**3 + 0.3836 * s**2 + s)
        assert abs(point.response / truth - 1.0) < 0.12


def test_dwell_times_in_the_wrong_order_are_refused(tmp_path: Path) -> None:
    config = load_config(CONFIGS / "ball_sim.toml")
    rig = open_rig(config.rig, u_range=(config.limits.u_min, config.limits.u_max), u_safe=config.limits.u_safe)
    with pytest.raises(InputError, match="dwell times 2 to 1 s"):
        run_dither(rig, config, tmp_path / "d.csv", duration_s=1.0, dwell_s=(2.0, 1.0))


def test_amplitude_without_room_is_refused(tmp_path: Path) -> None:
    config = load_config(CONFIGS / "servo_sim.toml")
    limits = config.limits
    rig = open_rig(config.rig, u_range=(limits.u_min, limits.u_max), u_safe=limits.u_safe)
    with pytest.raises(InputError, match="amplitude"):
        run_dither(rig, config, tmp_path / "d.csv", duration_s=1.0, amplitude=1e6)


@pytest.mark.parametrize(("K", "Ti_s"), [(1e15, 6.0), (-0.01, 1e-6)])
def test_gains_that_a_rig_holds_and_no_rig_runs_with_are_not_run(tmp_path: Path, K: float, Ti_s: float) -> None:
    """Registers read in the wrong order: what comes out is no law of these ranges."""
    config = load_config(CONFIGS / "ball_sim.toml").model_copy(update={"controller": None})
    rig = open_rig(config.rig, u_range=(config.limits.u_min, config.limits.u_max), u_safe=config.limits.u_safe)
    rig.open()
    rig.write_gains(PIDController(K=K, Ti_s=Ti_s))
    rig.close()
    with pytest.raises(InputError, match=r"the rig says that it holds gains of which K.* moves the command through"):
        run_dither(rig, config, tmp_path / "d.csv", duration_s=1.0, amplitude=0.1)


def test_recording_whose_sidecar_would_be_the_configuration_is_refused(tmp_path: Path) -> None:
    config = tmp_path / "rig.toml"
    config.write_text((CONFIGS / "servo_sim.toml").read_text())
    with pytest.raises(InputError, match="would overwrite the configuration"):
        dither(config, tmp_path / "rig.csv")
    assert config.read_text() == (CONFIGS / "servo_sim.toml").read_text()
