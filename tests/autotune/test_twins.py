"""Twins of ``init``: textbook plants go from the answers of a person to accepted, on any noise of their sensor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from autotune.config import load_config
from autotune.equations.transfer_text import parse_transfer_function
from autotune.experiment.cycles import read_earlier
from tests.benchmarks.twins import PLANTS, REACHED, TextbookPlant, run_twin


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("one lag", 0),
        ("one lag", 3),  # its first oscillation is so small that noise turns its phase beyond 90 degrees
        ("one slow lag, small gain", 0),  # a gain per second that is nothing beside an hour
        ("two equal lags, fast", 1),  # what is known of their difference is of second order
        ("integrator and dead time", 0),  # frequencies far beyond those measured are foreseen too high
        ("oscillating", 0),
    ],
)
def test_a_textbook_plant_runs_from_init_to_accepted(tmp_path: Path, name: str, seed: int) -> None:
    outcome = run_twin(next(plant for plant in PLANTS if plant.name == name), tmp_path, seed=seed)
    assert outcome.accepted, outcome.said


@pytest.mark.parametrize("name", ["three lags and dead time of three", "oscillating, lag and dead time"])
def test_a_limit_cycle_is_measured_where_it_repeats_itself(tmp_path: Path, name: str) -> None:
    """The next ones are planned from its gain: of one that was still growing it was 8 and 20 % too small."""
    plant = next(plant for plant in PLANTS if plant.name == name)
    outcome = run_twin(plant, tmp_path)
    assert outcome.accepted, outcome.said
    sample_time_s = load_config(tmp_path / "rig.toml").signals.sample_time_s
    cycles = read_earlier([tmp_path / "out" / "recording.csv"], sample_time_s).segments
    truth = parse_transfer_function(plant.written)
    for one in cycles:
        expected = complex(truth.response(np.array([one.point.omega_rad_s]))[0])
        assert abs(one.point.response / expected - 1.0) < 0.06


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.name)
def test_a_plant_as_people_write_it_runs_from_init_to_accepted(tmp_path: Path, plant: TextbookPlant) -> None:
    outcome = run_twin(plant, tmp_path)
    assert outcome.accepted, outcome.said


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("kind", REACHED)
def test_the_twin_of_a_rig_that_init_described_is_rehearsed_to_accepted(tmp_path: Path, kind: str) -> None:
    outcome = run_twin(PLANTS[2], tmp_path, kind)
    assert outcome.accepted, outcome.said
