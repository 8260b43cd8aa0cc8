"""Ten textbook plants: two independent integrators agree on them, and what they conceal is named at its place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from autotune.equations import compile_model, read_equations, simulate
from autotune.equations.simulate import Drive
from tests.benchmarks.textbook import diagnosed, is_right
from tests.sim.textbook import PLANTS
from tests.sim.textbook.hidden import Hidden
from tests.sim.textbook.record import record


@pytest.mark.parametrize("name", PLANTS)
def test_the_model_file_and_the_plant_are_the_same_equations(name: str, tmp_path: Path) -> None:
    """LSODA at 1e-10 against the project's own pair at 1e-6 of each state's largest size."""
    plant = PLANTS[name]
    rng = np.random.default_rng(3)
    truth = record(plant, plant.nominal, plant.columns(rng, plant.rows), rng)
    clean = np.array([plant.reading(x, ()) for x in truth.states])
    (tmp_path / "m.toml").write_text(plant.model, encoding="utf-8")
    model = read_equations(tmp_path / "m.toml")
    compiled = compile_model(model)
    drive = Drive(t=truth.t, inputs=np.column_stack([truth.columns[c] for c in model.columns]))
    # an unstable plant is compared as forecasts, from the true states
    every = plant.rows if model.horizon_s is None else round(model.horizon_s / plant.dt_s)
    starts = np.arange(0, plant.rows, every, dtype=np.int64)
    run = simulate(compiled, compiled.parameter_vector, drive, truth.states[starts], starts=starts)
    assert float(np.max(np.abs(run.y - clean))) < 2e-4 * float(np.std(clean))


def test_a_dead_time_between_rows_is_the_closed_solution() -> None:
    """A lag of first order answers a step L later by 1 - exp(-(t - L)/tau)."""
    plant, late_s = PLANTS["heater"], 10.0  # two and a half rows
    columns = {"u": np.where(np.arange(plant.rows) < 50, 0.0, 60.0), "ambient": np.full(plant.rows, 23.0)}
    made = record(plant, plant.nominal, columns, np.random.default_rng(2), Hidden(delay_s=late_s))
    p = plant.nominal
    since = np.maximum(made.t - 50 * plant.dt_s - late_s, 0.0)
    wanted = 23.0 + 60.0 * p["alpha"] / p["UA"] * (1.0 - np.exp(-since * p["UA"] / p["C"]))
    np.testing.assert_allclose(made.states[:, 0], wanted, atol=1e-5)


@pytest.mark.parametrize(
    "case",
    [
        ("two coupled tanks", "plant.leak", "h2", 0.2, 63),
        ("dc motor", "plant.coulomb_friction", "T_d", 0.15, 65),
        ("heater", "clean", "", 0.0, 61),
        # the stop lies where without it the pendulum would be for a fifth of the time
        ("pendulum", "plant.hard_stop", "omega", 0.85, 22066),
    ],
    ids=lambda case: f"{case[0]}, {case[1]}",
)
def test_what_a_textbook_plant_conceals_is_named(case: tuple[str, str, str, float, int], tmp_path: Path) -> None:
    """The short form of ``python -m tests.benchmarks textbook``."""
    said = diagnosed(PLANTS[case[0]], case, tmp_path)
    assert is_right(case, said), said
