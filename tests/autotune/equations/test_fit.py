"""Retuning of equations: the truth is found within its stated deviation, and what cannot be known is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.equations import Drive, EquationModel, combinations, compile_model, retune, simulate, undetermined
from autotune.equations.fit import fit
from autotune.equations.forecast import forecast
from autotune.equations.parameter_scales import slopes_of, values_of
from autotune.equations.read import equations_of
from autotune.equations.rest import rest_state
from autotune.errors import InputError
from autotune.recording import Recording
from tests.autotune.equations.models import model, one_state


def recorded(truth: EquationModel, seed: int, rows: int = 800, dt: float = 0.02, size: float = 0.6) -> Recording:
    """Return a recording of a model with other parameters, from a start that nobody was told."""
    rng = np.random.default_rng(seed)
    t, u = np.arange(rows) * dt, np.repeat(rng.normal(0.0, size, -(-rows // 25)), 25)[:rows]
    compiled = compile_model(truth)
    start = 0.1 * rng.normal(size=(1, len(truth.states)))
    y = simulate(compiled, compiled.parameter_vector, Drive(t=t, inputs=u[:, None]), start).y
    return Recording(t=t, u=u, y=y + rng.normal(0.0, 0.003, rows), name=f"rec{seed}.csv")


@pytest.fixture(scope="module")
def pair() -> list[Recording]:
    truth = model().with_parameters({"J": 0.06, "c": 0.03, "m": 0.55, "l": 0.29})
    return [recorded(truth, 1), recorded(truth, 2)]


def test_what_the_recordings_tell_is_found_within_its_deviation(pair: list[Recording]) -> None:
    found = retune(compile_model(model()), pair)
    J, c, m, length, g = found.parameters
    # J, c and the product m l follow from the torque's scale; m and l apart do not
    np.testing.assert_allclose([J, c, m * length], [0.06, 0.03, 0.55 * 0.29], rtol=0.01)
    assert found.noise_sd == pytest.approx(0.003, rel=0.1)
    assert g == 9.81
    deviation = np.abs(found.parameters - [0.06, 0.03, 0.55, 0.29, 9.81]) / np.maximum(found.sd, 1e-12)
    assert np.all(deviation < 4.0)


def test_a_combination_that_is_not_determined_is_told(pair: list[Recording]) -> None:
    found = retune(compile_model(model()), pair)
    least = undetermined(combinations(found))
    assert len(least) == 1
    assert set(least[0].parameters) == {"m", "l"}
    assert least[0].changes[0] * least[0].changes[1] < 0.0
    assert all(one.narrowed < 0.1 for one in combinations(found)[1:])


def test_a_fixed_parameter_stays_and_a_given_start_holds() -> None:
    fixed = one_state("(K*u - x)/T", {"K": {"value": 2.0, "fixed": True}, "T": {"value": 1.0}})
    truth = fixed.with_parameters({"T": 1.4})
    found = retune(compile_model(fixed), [recorded(truth, 3)])
    assert found.parameters[0] == 2.0
    assert found.parameters[1] == pytest.approx(1.4, abs=4.0 * found.sd[1])


def test_rest_is_where_nothing_moves_and_the_reading_fits() -> None:
    compiled = compile_model(model())
    rest = rest_state(compiled, compiled.parameter_vector, np.array([0.5]), float("nan"))
    np.testing.assert_allclose(rest, [np.arcsin(0.5 / (0.5 * 9.81 * 0.3)), 0.0], atol=1e-5)


def test_a_forecast_of_an_unstable_plant_stays_near_its_readings() -> None:
    truth = one_state("x + u - x^3")
    rec = recorded(truth, 4)
    # its own states are known to the noise (0.003) in every window; a pole that is wrong by 0.1 adds 0.1 s of growth
    for growth, error in (("x", 0.006), ("1.1*x", 0.04)):
        windows = forecast(one_state(f"{growth} + u - x^3"), rec, 0.3)
        assert np.sqrt(np.mean((windows - rec.y)[40:] ** 2)) < error


def levitated(seed: int, rows: int = 1500, dt: float = 0.001, noise: float = 0.01) -> Recording:
    """Return a ball under a magnet, held 10 mm below it by a controller that sees the true state."""
    rng = np.random.default_rng(seed)
    z, v, aim, u, y = 0.0105, 0.0, 0.0, np.empty(rows), np.empty(rows)
    for k in range(rows):
        if k % 60 == 0:
            aim = 1e-3 * rng.choice([-1.0, 1.0])
        y[k], u[k] = 1e3 * z, 1.0 + 300.0 * (z - 0.01 - aim) + 8.0 * v
        for _ in range(10):
            v += 0.1 * dt * (9.81 - 9.81e-4 * (u[k] / z) ** 2)
            z += 0.1 * dt * v
    return Recording(t=dt * np.arange(rows), u=u, y=y + noise * rng.normal(size=rows))


@pytest.mark.parametrize("seed", [2, 3])
def test_a_ball_under_a_magnet_is_forecast_nine_times_its_growth_ahead(seed: int) -> None:
    r = levitated(seed)
    ball = equations_of(
        {
            "name": "ball", "input": [{"column": "u"}], "output": {"value": "1000*z"},
            "state": [{"name": "z", "kind": "position", "derivative": "v"},
                      {"name": "v", "kind": "speed", "of": "z", "derivative": "9.81 - c*(u/z)^2"}],
            "parameters": {"c": 9.81e-4},
        },
        "ball.toml",
    )  # fmt: skip
    error = (forecast(ball, r, 0.05) - r.y)[100:]  # what a state is off by grows ninefold until a window ends
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_a_model_that_runs_away_from_every_start_is_refused() -> None:
    rec = recorded(one_state("u - x"), 5)
    with pytest.raises(InputError, match="runs away"):
        forecast(one_state("x^3 + 1"), rec)


def test_simulate_takes_equations(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from autotune.cli import app
    from autotune.equations import write_equations
    from autotune.recording import write_recording

    write_equations(model(), tmp_path / "m.toml")
    write_recording(recorded(model(), 6, rows=200), tmp_path / "rec.csv")
    run = CliRunner().invoke(
        app,
        ["simulate", "--model", str(tmp_path / "m.toml"), str(tmp_path / "rec.csv"), "--out", str(tmp_path / "s.csv")],
    )
    assert run.exit_code == 0, run.output
    y_sim = np.loadtxt(tmp_path / "s.csv", delimiter=",", skiprows=1)[:, 1]
    y = np.loadtxt(tmp_path / "rec.csv", delimiter=",", skiprows=1)[:, 2]
    assert np.std(y - y_sim) < 0.05


@given(value=st.sampled_from([-40.0, 1e-3, 21.5]), spread=st.sampled_from([0.2, 0.5]), z=st.floats(-40.0, 8.0))
def test_a_number_keeps_its_sign_and_comes_to_nothing_at_a_finite_distance(
    value: float, spread: float, z: float
) -> None:
    compiled = compile_model(one_state("u - K*x", {"K": {"value": value, "spread": spread}}))
    (at,), (near,) = (values_of(compiled, np.array([z + dz])) for dz in (0.0, 1e-5))
    assert at / value > 0.0
    (slope,) = slopes_of(compiled, np.array([z]))
    # the scale is curved by 1 over its last 2 % at most
    assert (near - at) / 1e-5 == pytest.approx(slope, rel=3e-4, abs=1e-9 * abs(value))
    assert slope / value >= 0.0
    if z > -1.0 / spread:
        assert at == pytest.approx(value * np.exp(spread * z))
    if z < -2.1 / spread:
        assert at / value < 1e-3


def test_a_fit_follows_a_curved_valley() -> None:
    """A spring and a sine beside it share a pendulum's gravity: straight moves end in the walls after a hundredth."""
    swing = [{"name": "x", "kind": "position", "derivative": "v"}]
    truth = one_state("x", {}, state=[*swing, {"name": "v", "derivative": "u - 0.05*v - 30.8*sin(x)"}])
    shared = one_state(
        "x", {"k": {"value": 21.5, "spread": 0.2}, "A": {"value": 20.0, "spread": 1.0},
              "w": {"value": 1.1, "spread": 1.0}},
        state=[*swing, {"name": "v", "derivative": "u - 0.05*v - k*x - A*sin(w*x)"}],
    )  # fmt: skip
    t = 0.02 * np.arange(800)
    compiled = compile_model(truth)
    drive = Drive(t=t, inputs=np.zeros((t.size, 1)))
    y = simulate(compiled, compiled.parameter_vector, drive, np.array([[2.0, 0.0]])).y
    swung = Recording(t=t, u=np.zeros(t.size), y=y + np.random.default_rng(6).normal(0.0, 1e-3, t.size))
    model_of_both = compile_model(shared)
    begun = fit(model_of_both, [swung], z=np.array([-4.0, 0.0, 0.1]), horizon_s=0.7, iterations=12)
    found = fit(model_of_both, [swung], z=begun.z, horizon_s=5.4, iterations=12)
    assert found.noise_sd < 2e-3
    whole = fit(model_of_both, [swung], z=found.z, iterations=20)
    spring, gravity, _ = whole.parameters
    assert whole.noise_sd < 1.1e-3
    assert spring < 0.3  # of 21.5 that are believed: on a logarithmic scale alone 3.0 were left
    assert gravity == pytest.approx(30.8, rel=0.01)


def _fan(k: float, T: float, c: float) -> EquationModel:
    """Return an arm that a fan lifts: at rest its speed n stands at zero, where the thrust k n^2 does not feel it."""
    return one_state(
        "x", {"k": k, "T": T, "c": c},
        state=[{"name": "n", "derivative": "(u - n)/T"}, {"name": "x", "derivative": "w"},
               {"name": "w", "derivative": "k*n^2 - c*w - 25*sin(x)"}],
    )  # fmt: skip


def test_a_start_that_the_readings_hardly_feel_holds_up_no_number() -> None:
    rng = np.random.default_rng(3)
    t, u = 0.02 * np.arange(900), np.repeat(rng.uniform(0.0, 2.6, 18), 50)
    u[:200], u[500:650] = 0.0, 0.0
    truth = compile_model(_fan(3.0, 0.1, 1.5))
    y = simulate(truth, truth.parameter_vector, Drive(t=t, inputs=u[:, None]), np.zeros((1, 3))).y
    swung = Recording(t=t, u=u, y=y + rng.normal(0.0, 0.002, t.size))
    found = fit(compile_model(_fan(3.6, 0.12, 1.2)), [swung], horizon_s=1.0, iterations=15)
    assert found.noise_sd < 2.2e-3
    np.testing.assert_allclose(found.parameters, [3.0, 0.1, 1.5], rtol=0.02)


@pytest.mark.parametrize("start", [(3.0, 0.0), (0.0, 14.0), (6.0, 25.0)])
def test_a_window_that_follows_another_swing_is_started_anew(
    pair: list[Recording], start: tuple[float, float]
) -> None:  # fmt: skip
    """A start state near the top, or so quick that it goes over: steps of Gauss and Newton lead no way back."""
    compiled = compile_model(model())
    right = fit(compiled, pair, horizon_s=4.0)
    assert right.noise_sd == pytest.approx(0.003, rel=0.1)
    states = right.windows[0].states.copy()
    states[2] = start
    wrong = [replace(right.windows[0], states=states), right.windows[1]]
    again = fit(compiled, pair, z=right.z, windows=wrong, iterations=6)
    assert again.noise_sd == pytest.approx(0.003, rel=0.1)
