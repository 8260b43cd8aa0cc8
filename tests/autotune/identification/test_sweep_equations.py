"""The search for the dead time of an equation over the rows of a sweep."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest

from autotune.errors import IdentificationError
from autotune.identification import sweep_equations
from autotune.identification.delay.data import DelayData, prepare
from autotune.identification.delay.output_error import Point, Structure, minimise, solve_linear
from autotune.identification.noise_filter import WHITE
from autotune.identification.sweep_equations import Fitted, fit_again
from autotune.recording import Recording

STEP_S = 0.01


def under_a_command_that_clips(seed: int) -> DelayData:
    """Return rows of three lags whose actuator clips from 3 s on: no equation, and larger ones always fit better."""
    rng = np.random.default_rng(seed)
    t = STEP_S * np.arange(600)
    u = np.repeat(np.tile([-1.0, 1.0], 20), rng.integers(25, 70, 40))[: t.size]
    late = np.concatenate([np.zeros(8), np.where(t > 3.0, np.minimum(u, 0.5), u)])
    x, y = np.zeros(3), np.empty(t.size)
    for k in range(t.size):
        y[k] = x[0]
        x = x + STEP_S * np.array([x[1], x[2], -30.0 * x[2] - 10.0 * x[1] + 200.0 * late[k]])
    return prepare(Recording(t=t, u=u, y=y + rng.normal(0.0, 0.003, t.size)), start_s=0.3, past_input="held")


def begun_off(data: DelayData) -> Fitted:
    """Return an equation of order 4 whose numbers are far from the rows."""
    structure = Structure(order=4, zeros=1)
    begun = solve_linear(data, structure, (-2000.0, -3000.0, -600.0, -60.0), 0.02)
    return Fitted(structure=structure, point=begun, covariance=np.empty((0, 0)), places=1)


def test_the_search_for_a_dead_time_ends_with_the_rows_of_which_it_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    """It crept on, a little lower each time and no row further: 91 descents where there are 8 steps to the limit."""
    data, longest_s = under_a_command_that_clips(seed=5), 0.3
    descents: list[Point] = []

    def counted(*given: object, **named: object) -> Point:
        descents.append(minimise(*given, **named))  # type: ignore[arg-type]
        return descents[-1]

    monkeypatch.setattr(sweep_equations, "minimise", counted)
    start = begun_off(data)
    with suppress(IdentificationError):  # whether these rows determine what no equation describes hangs on rounding
        fit_again(data, [start], longest_s, WHITE)
    assert min(point.cost for point in descents) < start.point.cost
    assert 3 < len(descents) <= 3 + longest_s / STEP_S


def test_an_equation_that_its_rows_determine_is_fitted_lower_than_it_began() -> None:
    data = under_a_command_that_clips(seed=6)
    start = begun_off(data)
    (found,) = fit_again(data, [start], 0.3, WHITE)
    assert found.point.cost < start.point.cost
