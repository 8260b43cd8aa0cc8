"""Start states of windows: what an earlier fit knows is taken over, and what strays leads no later window astray."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.arrays import FloatArray
from autotune.equations import Compiled, Drive, compile_model, simulate
from autotune.equations.rest import rest_state
from autotune.equations.sensitivity import Windows
from autotune.equations.starts import fit_starts
from tests.autotune.equations.models import model, one_state

ROWS = 1200


def _swinging(seed: int) -> tuple[Compiled, Drive, FloatArray, FloatArray]:
    """Return a pendulum that is driven over the top, its reading and its states."""
    rng = np.random.default_rng(seed)
    t = np.arange(ROWS) * 0.02
    u = np.repeat(rng.normal(0.0, 2.0, ROWS // 40), 40)
    compiled = compile_model(model(), signals=["theta", "omega"])
    run = simulate(compiled, compiled.parameter_vector, Drive(t=t, inputs=u[:, None]), np.zeros(2))
    return compile_model(model()), Drive(t=t, inputs=u[:, None]), run.y, run.outputs[:, 1:]


def test_a_window_takes_over_the_state_that_a_fit_on_other_windows_knows() -> None:
    compiled, drive, y, states = _swinging(1)
    grid = np.arange(0, 600, 50)
    known = Windows(starts=grid, stops=np.append(grid[1:], 600), states=states[grid])
    starts = np.array([0, 130, 260, 399, 700])
    stops = np.append(starts[1:], ROWS)
    p = compiled.parameter_vector
    found = fit_starts(compiled, p, drive, y, np.isfinite(y), starts, stops, known=known)
    np.testing.assert_allclose(found.states[:4], states[starts[:4]], atol=1e-4)
    np.testing.assert_allclose(found.states[4], states[700], atol=1e-2)  # nobody knows it: the readings tell


@pytest.mark.parametrize("seed", [6, 12, 19, 25])
def test_starts_keep_to_the_swing_of_the_readings_where_wrong_numbers_lead_a_simulation_astray(seed: int) -> None:
    compiled, drive, y, states = _swinging(seed)
    p = compiled.parameter_vector * np.array([1.1, 1.5, 0.9, 1.0, 1.0])
    starts = np.arange(0, ROWS, 300)
    stops = starts + 300
    strays = y - simulate(compiled, p, drive, states[starts], starts=starts, stops=stops).y
    assert np.max(np.abs(strays)) > np.pi  # another swing than the readings'
    first = Windows(starts=np.array([0]), stops=np.array([1]), states=states[:1])
    found = fit_starts(compiled, p, drive, y, np.isfinite(y), starts, stops, known=first)
    spread = np.ptp(states, axis=0)
    assert np.all(np.abs(found.states - states[starts]) < 0.1 * spread)


@pytest.mark.parametrize("unit", [1e-12, 1e-6, 1.0, 1e9])
def test_a_rest_is_found_in_every_unit_of_its_state(unit: float) -> None:
    """A tank rests at (k u / a)^2 = 4, in whatever its level is told."""
    numbers: dict[str, object] = {"k": {"value": 0.5 * unit}, "a": {"value": unit**0.5}}
    compiled = compile_model(one_state("k*u - a*sqrt(max(x, 0))", numbers))
    rest = rest_state(compiled, compiled.parameter_vector, np.array([4.0]), float("nan"))
    assert rest / unit == pytest.approx(4.0, rel=1e-6)
