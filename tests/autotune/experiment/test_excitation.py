"""Excitations: what their patterns are, and that a rig under them stays within its envelope."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.config import load_config
from autotune.errors import ExperimentStopped
from autotune.experiment.excitation import KINDS, Excitation, Kind, run_excitation
from autotune.recording import read_recording
from drivers.simulated import SimulatedRig
from sim.plant import make_plant
from tests.autotune.experiment.rigs import CONFIG, ball_config, ball_rig


@given(
    kind=st.sampled_from(KINDS),
    amplitude=st.floats(1e-3, 1e3),
    hold=st.floats(0.05, 20.0),
    duration=st.floats(0.5, 60.0),
    seed=st.integers(0, 99),
)
@settings(max_examples=60)
def test_a_pattern_never_exceeds_its_amplitude(
    kind: Kind, amplitude: float, hold: float, duration: float, seed: int
) -> None:
    one = Excitation(kind=kind, on="command", amplitude=amplitude, hold_s=hold, duration_s=duration, seed=seed)
    pattern = one.pattern(0.02)
    assert np.all(np.abs(pattern) <= amplitude * (1.0 + 1e-12))


def test_a_staircase_meets_every_level_from_below_and_from_above() -> None:
    pattern = Excitation(kind="staircase", on="command", amplitude=1.0, hold_s=1.0, duration_s=17.0).pattern(0.1)
    steps = np.flatnonzero(np.diff(pattern))
    arrivals = {(float(pattern[k + 1]), float(np.sign(pattern[k + 1] - pattern[k]))) for k in steps}
    assert {(0.5, 1.0), (0.5, -1.0), (0.0, 1.0), (0.0, -1.0), (-0.5, 1.0), (-0.5, -1.0)} <= arrivals


def test_a_sweep_rises_in_frequency() -> None:
    pattern = Excitation(kind="sweep", on="command", amplitude=1.0, hold_s=2.0, duration_s=60.0).pattern(0.02)
    crossings = np.flatnonzero(np.diff(np.sign(pattern)) != 0.0)
    gaps = np.diff(crossings)
    assert np.all(gaps[1:] <= gaps[:-1] + 1)
    assert gaps[0] > 20 * gaps[-1]


def test_the_ball_under_random_steps_stays_in_its_envelope_and_the_excited_rows_are_returned(tmp_path: Path) -> None:
    config = ball_config()
    one = Excitation(kind="random steps", on="set-point", amplitude=1.0, hold_s=4.0, duration_s=15.0)
    rig = ball_rig()
    seen = run_excitation(rig, config, tmp_path / "rig.csv", one)
    whole = read_recording(tmp_path / "rig.csv")
    assert rig.command == config.limits.u_safe
    assert len(whole) > len(seen) >= 1499
    assert np.all((whole.u >= config.limits.u_min) & (whole.u <= config.limits.u_max))
    assert np.max(np.abs(seen.y - 5.0)) < config.limits.swing + 0.35
    assert np.all(np.isfinite(seen["r"]))
    assert seen.metadata["law"]["K"] == -0.01


@pytest.mark.parametrize("seed", [1, 3, 6])
def test_a_slow_law_is_handed_a_plant_that_hardly_moves(tmp_path: Path, seed: int) -> None:
    config = ball_config(signals={"sample_time_s": 0.02})
    one = Excitation(kind="staircase", on="set-point", amplitude=0.5, hold_s=2.5, duration_s=2.0)
    run_excitation(ball_rig(seed=seed), config, tmp_path / "rig.csv", one)
    whole = read_recording(tmp_path / "rig.csv")
    y = np.convolve(whole.y[np.isfinite(whole["r"])], np.ones(10) / 10, "valid")
    assert np.max(np.abs(y - 5.0)) < 0.5 * config.limits.swing


def test_a_second_excitation_waits_until_the_ball_has_sunk(tmp_path: Path) -> None:
    config, rig = ball_config(), ball_rig()
    one = Excitation(kind="sweep", on="command", amplitude=0.02, hold_s=2.0, duration_s=3.0)
    for name in ("first.csv", "second.csv"):
        seen = run_excitation(rig, config, tmp_path / name, one)
        assert np.max(np.abs(seen.y - 5.0)) < config.limits.swing + 0.35


def test_tanks_that_have_run_dry_are_filled_to_their_operating_point_again(tmp_path: Path) -> None:
    config = load_config(CONFIG.parent / "two_tank_sim.toml")
    plant = make_plant("two_tank", start="level")
    plant.advance(0.0, 900.0)
    assert plant.y_true < config.limits.y_min
    one = Excitation(kind="triangle", on="set-point", amplitude=0.5, hold_s=200.0, duration_s=800.0)
    seen = run_excitation(SimulatedRig(plant, u_safe=0.0), config, tmp_path / "rig.csv", one)
    assert np.max(np.abs(seen.y - 10.0)) < config.limits.swing


def test_a_pattern_that_is_too_large_is_halved_before_the_limit_ends_it(tmp_path: Path) -> None:
    config = ball_config()
    one = Excitation(kind="staircase", on="set-point", amplitude=2.8, hold_s=6.0, duration_s=30.0)
    seen = run_excitation(ball_rig(), config, tmp_path / "rig.csv", one)
    assert seen.metadata["excitation"]["share_at_end"] <= 0.5


def test_a_limit_that_is_reached_leaves_the_rig_safe_and_the_rows_on_disk(tmp_path: Path) -> None:
    config = ball_config(limits={"swing": 0.8, "time_s": 60.0})
    one = Excitation(kind="pulses", on="command", amplitude=2.0, hold_s=1.0, duration_s=20.0)
    rig = ball_rig()
    with pytest.raises(ExperimentStopped):
        run_excitation(rig, config, tmp_path / "rig.csv", one)
    assert rig.command == config.limits.u_safe
    whole = read_recording(tmp_path / "rig.csv")
    assert whole.metadata["ended"]["exit_status"] == 3
    assert whole.metadata["excitation"]["kind"] == "pulses"
