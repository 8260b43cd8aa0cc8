"""Rows that were not fitted: forecasts of a plant that is not stable begin where the readings are."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.diagnosis.equations.equation_bench import EquationBench
from autotune.equations import EquationModel
from autotune.equations.read import equations_of
from autotune.recording import Recording

#: Sample time [s], and the reading's noise [mm].
DT, NOISE = 1e-3, 3e-3


def levitation() -> EquationModel:
    """A steel ball under a magnet, x from the magnet down, with a force of C u^2/(x + x1)^2."""
    states = [{"name": "x", "kind": "position", "derivative": "v"},
              {"name": "v", "kind": "speed", "of": "x", "derivative": "g - C*u^2/(m*(x + x1)^2) - b*v/m"}]  # fmt: skip
    numbers = {
        "m": {"value": 0.05, "fixed": True},
        "C": 7e-5,
        "x1": 0.002,
        "b": 0.3,
        "g": {"value": 9.81, "fixed": True},
    }
    return equations_of(
        {"name": "levitation", "input": [{"column": "u"}], "output": {"value": "1000*x"}, "state": states,
         "parameters": numbers}, "levitation.toml",
    )  # fmt: skip


def held_by_a_pid(seed: int, rows: int = 3000) -> Recording:
    """Such a ball, held by a PID whose set-point jumps 25 times a second."""
    random = np.random.default_rng(seed)
    r = 10.0 + np.repeat(random.uniform(-1.5, 1.5, rows // 40 + 1), 40)[:rows]
    y, u = np.empty(rows), np.empty(rows)
    x, v, speed, area, before = 0.010, 0.0, 0.0, 0.0, 10.0
    rest = np.sqrt(9.81 * 0.05 * 0.012**2 / 6.3e-5)
    for k in range(rows):
        y[k] = 1000.0 * x + NOISE * random.standard_normal()
        speed, before = 0.8 * speed + 0.2 * (y[k] - before) / DT, y[k]
        area += (y[k] - r[k]) * DT
        u[k] = np.clip(rest + 0.35 * (y[k] - r[k]) + 0.008 * speed + area, 0.2, 3.0)
        for _ in range(10):
            v += DT / 10 * (9.81 - 6.3e-5 * u[k] ** 2 / (0.05 * (x + 0.0021) ** 2) - 0.33 * v / 0.05)
            x += DT / 10 * v
    return Recording(t=DT * np.arange(rows), u=u, y=y, name=f"record {seed}")


@pytest.mark.parametrize("seed", [0, 1, 2, 11])
def test_a_right_model_of_an_unstable_plant_forecasts_rows_that_it_never_saw(seed: int) -> None:
    record = held_by_a_pid(seed)
    bench = EquationBench(levitation(), [record], [np.ones(len(record), dtype=bool)])
    fitted = bench.retuned()
    assert np.sqrt(fitted.rss / len(record)) == pytest.approx(NOISE, rel=0.1)
    # a start state that is off by the noise grows e^3-fold until a forecast ends
    assert bench.held_out_error(fitted, False) < np.exp(3.0) * NOISE
