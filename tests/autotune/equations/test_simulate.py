"""Simulation of equations against what is known in closed form, and against an integrator that nobody here wrote."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, lfilter

from autotune.equations import (
    Compiled,
    Drive,
    Extension,
    Run,
    compile_model,
    drive_of,
    parse,
    require_complete,
    simulate,
)
from autotune.equations.kernel import TOO_MANY_STEPS
from autotune.equations.model import ModelParameter, State
from autotune.errors import InputError
from autotune.recording import Recording
from tests.autotune.equations.models import model, one_state


def run(compiled: Compiled, t: np.ndarray, u: np.ndarray, x0: list[float], **options: object) -> Run:
    inputs = u[:, None] if u.ndim == 1 else u
    return simulate(compiled, compiled.parameter_vector, Drive(t=t, inputs=inputs), np.array([x0]), **options)  # type: ignore[arg-type]


def steps(seed: int, rows: int, each: int, size: float = 1.0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).normal(0.0, size, -(-rows // each)), each)[:rows]


def test_a_held_command_through_a_lag_is_the_discrete_lag() -> None:
    t, u = np.arange(500) * 0.1, steps(1, 500, 7)
    y = run(compile_model(one_state("(2*u - x)/0.7")), t, u, [0.0]).y
    num, den, _ = cont2discrete(([2.0], [0.7, 1.0]), 0.1, "zoh")
    np.testing.assert_allclose(y, lfilter(num.ravel(), den, u), atol=5e-6)


def test_a_pendulum_swings_as_a_foreign_integrator_says() -> None:
    compiled = compile_model(model())
    J, c, m, length, g = compiled.parameter_vector
    t, u = np.arange(400) * 0.02, steps(2, 400, 25, 0.5)
    mine = run(compiled, t, u, [0.5, -1.0])
    x, theirs = np.array([0.5, -1.0]), []
    for k in range(400):
        theirs.append(x[0])
        x = solve_ivp(lambda _, x, k=k: [x[1], (u[k] - c * x[1] - m * g * length * np.sin(x[0])) / J], (0, 0.02), x,
                      rtol=1e-10, atol=1e-12).y[:, -1]  # fmt: skip
    np.testing.assert_allclose(mine.y, theirs, atol=2e-6)


@given(tolerance=st.floats(1e-9, 1e-4))
@settings(max_examples=20, deadline=None)
def test_the_error_stays_near_what_was_asked_for(tolerance: float) -> None:
    y = run(compile_model(one_state("-x")), np.arange(11) * 1.0, np.zeros(11), [1.0], tolerance=tolerance).y
    assert np.max(np.abs(y - np.exp(-np.arange(11.0)))) < 20.0 * tolerance


def test_dry_friction_sticks_and_breaks_away_at_its_level() -> None:
    # v' = u - 0.5 sign(v): held below 0.5, it runs as u - 0.5 above
    t = np.arange(1000) * 0.01
    u = np.where(t < 2.0, 0.4, np.where(t < 4.0, 0.9, np.where(t < 7.0, 0.0, -0.49)))
    result = run(compile_model(one_state("u - 0.5*sign(x)"), signals=["u - 0.5*sign(x)"]), t, u, [0.0])
    v = result.y
    assert np.all(v[t < 2.0] == 0.0)
    np.testing.assert_allclose(v[(t > 2.0) & (t < 4.0)], 0.4 * (t[(t > 2.0) & (t < 4.0)] - 2.0), atol=1e-9)
    stopped = 4.0 + 0.8 / 0.5  # decelerates by 0.5 from 0.8
    np.testing.assert_allclose(v[t > stopped + 0.01], 0.0, atol=1e-9)
    assert result.is_complete


def test_a_thrown_mass_stops_where_dry_friction_says() -> None:
    # x'' = -mu g sign(x'): stops after v^2 / (2 mu g)
    content = one_state("v", state=[{"name": "x", "derivative": "v"}, {"name": "v", "derivative": "-a*sign(v)"}],
                        parameters={"a": 3.0})  # fmt: skip
    result = run(compile_model(content), np.array([0.0, 5.0]), np.zeros(2), [0.0, 2.0])
    np.testing.assert_allclose(result.ends[0], [2.0**2 / 6.0, 0.0], atol=1e-6)


@given(rate=st.floats(0.1, 50.0), seed=st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_a_rate_limiter_runs_at_its_rate_and_holds_once_it_has_caught_up(rate: float, seed: int) -> None:
    t, u = np.arange(200) * 0.1, steps(seed, 200, 9)
    w = run(compile_model(one_state("rate*sign(u - x)", {"rate": rate})), t, u, [u[0]]).y
    expected = np.empty(200)
    expected[0] = u[0]
    for k in range(199):
        expected[k + 1] = expected[k] + np.clip(u[k] - expected[k], -rate * 0.1, rate * 0.1)
    np.testing.assert_allclose(w, expected, atol=1e-7)


def test_a_tank_runs_empty_and_stays_empty() -> None:
    # h' = -k sqrt(h): h = (1 - k t / 2)^2 until it is empty
    t = np.arange(60) * 0.1
    result = run(compile_model(one_state("-sqrt(max(x, 0))")), t, np.zeros(60), [1.0])
    np.testing.assert_allclose(result.y, np.maximum(1.0 - t / 2.0, 0.0) ** 2, atol=1e-5)
    assert result.is_complete


def test_a_stiff_model_is_carried_through() -> None:
    # van der Pol with mu = 1000: the explicit pair alone would need some 10^6 steps
    content = one_state("v", state=[{"name": "x", "derivative": "v"},
                                    {"name": "v", "derivative": "1000*(1 - x^2)*v - x + u"}])  # fmt: skip
    t = np.arange(2001) * 1.0
    result = run(compile_model(content), t, np.zeros(2001), [2.0, 0.0])
    truth = solve_ivp(lambda _, x: [x[1], 1000.0 * (1.0 - x[0] ** 2) * x[1] - x[0]], (0, 2000), [2.0, 0.0],
                      method="Radau", rtol=1e-9, atol=1e-11, t_eval=t)  # fmt: skip
    np.testing.assert_allclose(result.y, truth.y[0], atol=2e-3)


def test_dead_time_and_a_straight_line_between_rows_act_as_they_say() -> None:
    content = one_state("-x + u + w", input=[{"column": "u", "delay": 0.25}, {"column": "w", "hold": "linear"}],
                        output="x + w")  # fmt: skip
    t = np.arange(50) * 0.1
    inputs = np.column_stack([t >= 1.0, np.sin(t)]).astype(float)
    y = run(compile_model(content), t, inputs, [0.0]).y
    truth = solve_ivp(lambda s, x: [-x[0] + (s >= 1.25) + np.interp(s, t, inputs[:, 1])], (0, 4.9), [0.0],
                      rtol=1e-9, atol=1e-11, max_step=0.01, t_eval=t)  # fmt: skip
    np.testing.assert_allclose(y, truth.y[0] + inputs[:, 1], atol=3e-6)


def test_the_reading_of_a_row_comes_before_its_command_acts() -> None:
    t, u = np.arange(5) * 1.0, np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    y = run(compile_model(one_state("0*x", output="u")), t, u, [0.0]).y
    np.testing.assert_array_equal(y, [1.0, 1.0, 2.0, 3.0, 4.0])


@given(cut=st.integers(1, 198))
@settings(max_examples=25, deadline=None)
def test_windows_that_go_on_from_each_other_are_one_run(cut: int) -> None:
    compiled = compile_model(model(input=[{"column": "u", "unit": "N m", "delay": 0.07}]))
    t, u = np.arange(200) * 0.02, steps(3, 200, 11)
    whole = run(compiled, t, u, [0.3, 0.0])
    first = run(compiled, t, u, [0.3, 0.0], stops=np.array([cut]))
    states = np.array([[0.3, 0.0], first.ends[0]])
    drive = Drive(t=t, inputs=u[:, None])
    both = simulate(compiled, compiled.parameter_vector, drive, states, starts=np.array([0, cut]))
    np.testing.assert_allclose(both.y, whole.y, atol=1e-6)
    np.testing.assert_allclose(both.ends[-1], whole.ends[0], atol=1e-6)


def test_an_extension_acts_where_it_says() -> None:
    base = model(port=[{"name": "T_d", "kind": "torque", "across": "omega", "unit": "N m"}],
                 state=[{"name": "theta", "derivative": "omega"},
                        {"name": "omega", "derivative": "(u + T_d - c*omega - m*g*l*sin(theta))/J"}])  # fmt: skip
    t, u = np.arange(300) * 0.02, steps(4, 300, 20)

    def of(*extensions: Extension) -> np.ndarray:
        return run(compile_model(base, extensions), t, u, [0.1, 0.0] + [0.0] * sum(len(e.states) for e in extensions)).y

    level = (ModelParameter(name="level", value=0.2),)
    friction = "-level*sign(omega)"
    at_port = of(Extension(name="friction", parameters=level, port={"T_d": parse(friction)}))
    at_state = of(Extension(name="friction", parameters=level, derivative={"omega": parse(f"({friction})/J")}))
    np.testing.assert_allclose(at_port, at_state, atol=1e-9)
    assert np.max(np.abs(at_port - of())) > 0.05
    clipped = Extension(name="saturation", input={"u": parse("min(max(value, -0.3), 0.3)")})
    np.testing.assert_allclose(of(clipped), run(compile_model(base), t, np.clip(u, -0.3, 0.3), [0.1, 0.0]).y, atol=1e-9)
    gain = Extension(name="gain", output=parse("2*value + 1"))
    twice = Extension(name="gain", output=parse("value^2"))
    np.testing.assert_allclose(of(gain, twice), (2.0 * of() + 1.0) ** 2, atol=1e-9)


def test_an_extension_may_have_a_memory_of_its_own() -> None:
    lag = Extension(name="lag", states=(State(name="lagged", derivative=parse("(value - lagged)/T")),),
                    parameters=(ModelParameter(name="T", value=0.3),), input={"u": parse("lagged")})  # fmt: skip
    t, u = np.arange(200) * 0.05, steps(5, 200, 13)
    chained = run(compile_model(one_state("u - x"), [lag]), t, u, [0.0, 0.0]).y
    written = one_state("x", state=[{"name": "x", "derivative": "w - x"}, {"name": "w", "derivative": "(u - w)/0.3"}])
    np.testing.assert_allclose(chained, run(compile_model(written), t, u, [0.0, 0.0]).y, atol=1e-9)


@pytest.mark.parametrize("extension", [
    Extension(name="loop", input={"u": parse("value + u")}), Extension(name="nowhere", derivative={"v": parse("1")}),
    Extension(name="port", port={"F": parse("1")}), Extension(name="input", input={"w": parse("value")}),
    Extension(name="word", derivative={"x": parse("omega")}),
    Extension(name="twice", states=(State(name="x", derivative=parse("1")),)),
])  # fmt: skip
def test_an_extension_that_does_not_fit_is_refused(extension: Extension) -> None:
    with pytest.raises(InputError):
        compile_model(one_state("u - x"), [extension])


def test_a_runaway_is_one_line_that_says_when() -> None:
    compiled = compile_model(one_state("x^2"))
    result = run(compiled, np.arange(50) * 0.1, np.zeros(50), [1.0])  # x = 1/(1 - t)
    assert not result.is_complete
    assert np.all(np.isfinite(result.y[:9]))
    with pytest.raises(InputError, match=r"runs away.* at t = (0\.9|1) s"):
        require_complete(result, compiled, "rec.csv")


def test_a_column_that_the_recording_lacks_is_named() -> None:
    recording = Recording(t=np.arange(3.0), u=np.zeros(3), y=np.zeros(3), name="rec.csv")
    needs = one_state("u + supply - x", input=[{"column": "u"}, {"column": "supply"}])
    with pytest.raises(InputError, match=r"rec\.csv: no column 'supply'"):
        drive_of(needs, recording)


def test_a_level_may_fall_through_the_edge_of_a_root() -> None:
    # x' = -1 - sqrt(max(x, 0)): beyond the edge it falls at 1
    compiled = compile_model(one_state("-1 - sqrt(max(x, 0))"))
    t = np.arange(40) * 0.1
    y = run(compiled, t, np.zeros(40), [1.0]).y
    empty = 2.0 * (1.0 - np.log(2.0))  # with s = sqrt(x): t = 2 (1 - s) - 2 log(2/(1 + s))
    np.testing.assert_allclose(y[t > empty], -(t[t > empty] - empty), atol=1e-5)


def test_a_root_of_what_is_negative_is_no_number_and_not_something_else() -> None:
    result = run(compile_model(one_state("-1 - sqrt(x)")), np.arange(20) * 0.1, np.zeros(20), [1.0])
    assert not result.is_complete


def test_what_chatters_between_all_rows_ends_with_a_reason() -> None:
    """An oscillator of 200 Hz seen every .5 s: 100 turns from row to row say nothing, and one fit would take hours."""
    fast = one_state(
        "v", {"w": 1257.0}, state=[{"name": "x", "derivative": "v"}, {"name": "v", "derivative": "-w^2*x"}]
    )
    result = run(compile_model(fast), np.arange(200) * 10.0, np.zeros(200), [1.0, 0.0])
    assert result.reasons[0] == TOO_MANY_STEPS
    assert result.until_s[0] < 100.0


@given(level=st.floats(0.02, 0.3), seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_a_crossing_is_located_in_a_dozen_trials(level: float, seed: int) -> None:
    """Halving the step takes 30 trials to 1e-9 of a row, and a mass with dry friction stops at every turn."""
    states = [{"name": "x", "derivative": "v"}, {"name": "v", "derivative": "u - x - level*sign(v)"}]
    t, u = np.arange(400) * 0.1, steps(seed, 400, 9)
    rubbed = run(compile_model(one_state("v", {"level": level}, state=states)), t, u, [0.0, 0.0])
    moves = np.diff(rubbed.y)
    way = np.sign(np.where(np.abs(moves) < 1e-9, 0.0, moves))
    turns = int(np.sum(way[1:] != way[:-1]))  # turning, sticking, and breaking away
    assert turns > 5
    assert rubbed.steps[0] < 399 + 16 * turns
