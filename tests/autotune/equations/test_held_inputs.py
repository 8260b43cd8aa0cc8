"""Play and dead time of a command as numbers of the model: a fit finds them with the others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.equations import Drive, apply, compile_model, fit, simulate
from autotune.equations.effects import compile_with
from autotune.equations.fit_data import window_rows
from autotune.models import Effect, Parameter
from autotune.recording import Recording
from tests.autotune.equations.models import one_state

DT, ROWS = 0.05, 600
LAG = one_state("b*u - a*x", {"a": 0.8, "b": 2.0})


def acting(name: str, **values: float) -> Effect:
    return Effect(name=name, parameters={key: Parameter(value=value) for key, value in values.items()})


def recorded(*effects: Effect, seed: int = 3) -> Recording:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, ROWS // 20), 20)
    compiled = compile_with(LAG, effects)
    drive = Drive(t=DT * np.arange(ROWS), inputs=u[:, None])
    y = simulate(compiled, compiled.parameter_vector, drive, np.zeros((1, 1))).y
    return Recording(t=drive.t, u=u, y=y + 0.002 * rng.normal(size=ROWS))


@pytest.mark.parametrize(
    ("name", "key", "true", "guess"),
    [("timing.dead_time", "delay", 0.137, 0.06), ("actuator.backlash", "width", 0.23, 0.1)],
)
def test_what_is_done_to_a_command_is_found_with_its_deviation(name: str, key: str, true: float, guess: float) -> None:
    found = fit(compile_with(LAG, [acting(name, **{key: guess})]), [recorded(acting(name, **{key: true}))])
    assert abs(found.parameters[-1] - true) < 4.0 * found.sd[-1]
    assert found.sd[-1] < 0.02 * true
    assert found.noise_sd == pytest.approx(0.002, rel=0.1)


@pytest.mark.parametrize(
    "effects",
    [
        [acting("actuator.backlash", width=0.4), acting("timing.dead_time", delay=0.12)],
        [acting("timing.dead_time", delay=0.03), acting("actuator.saturation", high=0.5)],
        [acting("actuator.quantisation", step=0.25), acting("actuator.stiction", band=0.3)],
    ],
)
def test_numbers_of_the_model_do_what_prepared_samples_do(effects: list[Effect]) -> None:
    """What a fit moves and what a simulation of an extended model prepares are one thing."""
    r, applied = recorded(), apply(LAG, effects)
    drive, start = Drive(t=r.t, inputs=r.u[:, None]), np.zeros((1, 1))
    one = compile_with(LAG, effects)
    other = compile_model(LAG, applied.extensions)
    prepared = simulate(other, other.parameter_vector, applied.before(drive), start, delays=applied.delays)
    np.testing.assert_array_equal(simulate(one, one.parameter_vector, drive, start).y, prepared.y)


@given(rows=st.integers(40, 900), share=st.floats(0.03, 2.0))
@settings(max_examples=60, deadline=None)
def test_no_window_is_longer_than_was_asked_for_by_more_than_a_tenth(rows: int, share: float) -> None:
    """An unstable plant would run away in one that is."""
    t = DT * np.arange(rows)
    length = max(share * t[-1], 4.0 * DT)
    starts, stops = window_rows(t, length)
    assert starts[0] == 0
    assert stops[-1] == rows
    np.testing.assert_array_equal(starts[1:], stops[:-1])
    assert np.max(stops - starts) * DT <= 1.1 * length + 2.0 * DT


@given(
    cuts=st.lists(st.integers(1, 398), min_size=1, max_size=5), stated=st.floats(-9.0, 9.0), tau=st.floats(0.01, 50.0)
)
@settings(max_examples=40, deadline=None)
def test_no_window_chooses_what_a_recorded_column_was_before_it(cuts: list[int], stated: float, tau: float) -> None:
    """A state of a lag that each window may choose is a load of its own for each: any column would then explain one."""
    wind = np.cumsum(np.random.default_rng(3).normal(size=400))
    base = one_state("u - x", input=[{"column": "u"}, {"column": "wind", "hold": "linear"}])
    parameters = {key: Parameter(value=value) for key, value in {"gain": 0.3, "time_constant": tau}.items()}
    effect = Effect(name="environment.measured_input", state="x", column="wind", parameters=parameters)
    compiled = compile_with(base, [effect], signals=["x"])
    drive = Drive(t=DT * np.arange(400), inputs=np.column_stack([np.zeros(400), wind]))
    whole = simulate(compiled, compiled.parameter_vector, drive, np.array([[1.0, stated]]))
    starts = np.array([0, *sorted(set(cuts))])
    states = np.column_stack([whole.outputs[starts, 1], np.full(starts.size, stated)])
    parts = simulate(compiled, compiled.parameter_vector, drive, states, starts=starts)
    np.testing.assert_allclose(parts.y, whole.y, rtol=1e-4, atol=1e-4)
