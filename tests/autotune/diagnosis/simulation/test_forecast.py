"""A forecast knows the past alone, and is as good as the noise allows where the model is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis.simulation.forecast import forecast
from autotune.equations.chain import from_chain
from autotune.equations.forecast import forecast as of_equations
from autotune.errors import InputError
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording


def integrator() -> Model:
    return Model(
        name="integrator",
        input=Port(),
        output=Port(),
        blocks=(
            Block(name="speed", place="plant", dynamics=TransferFunction(num=(2.0,), den=(0.3, 1.0))),
            Block(name="position", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0))),
        ),
    )


def recorded(seed: int = 0, rows: int = 1500, dt: float = 0.02, noise: float = 0.05) -> Recording:
    """Zero-order-hold response of 2/(s (0.3 s + 1)), in closed form from row to row."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=rows // 25), 25)
    decay = np.exp(-dt / 0.3)
    v, x, y = 0.4, 1.0, np.empty(rows)
    for k in range(rows):
        y[k] = x
        rest = 2.0 * u[k]
        x += rest * dt + (v - rest) * 0.3 * (1.0 - decay)
        v = rest + (v - rest) * decay
    return Recording(t=dt * np.arange(rows), u=u, y=y + noise * rng.normal(size=rows))


def test_a_forecast_does_not_change_when_what_comes_after_its_start_changes() -> None:
    r = recorded()
    before = forecast(integrator(), r, 3.0)
    later = r.y.copy()
    later[900:] += 5.0  # the window from row 900 on is forecast from rows before it
    after = forecast(integrator(), Recording(t=r.t, u=r.u, y=later), 3.0)
    np.testing.assert_allclose(before[:1050], after[:1050], atol=1e-9)  # the units of the search know all rows


def test_the_error_of_a_right_models_forecast_is_the_noise() -> None:
    r = recorded()
    error = (forecast(integrator(), r, 3.0) - r.y)[300:]
    assert np.std(error) < 1.1 * 0.05


@pytest.mark.parametrize("size", [1.0, 2.0**24, -(2.0**-24)])
def test_a_forecast_is_the_same_in_every_unit_of_the_reading_and_as_equations(size: float) -> None:
    r = recorded()
    there = Recording(t=r.t, u=r.u, y=size * r.y)
    first, *rest = integrator().blocks
    scaled = replace(first, dynamics=TransferFunction(num=(2.0 * size,), den=(0.3, 1.0)))
    model = replace(integrator(), blocks=(scaled, *rest))
    usual = forecast(integrator(), r, 3.0)
    np.testing.assert_allclose(forecast(model, there, 3.0) / size, usual, rtol=0.0, atol=1e-6)
    # integrated to a tolerance where the chain is exact
    np.testing.assert_allclose(of_equations(from_chain(model), there, 3.0) / size, usual, rtol=0.0, atol=1e-3)


def test_a_forecast_that_runs_away_in_one_window_is_far_from_the_readings_there() -> None:
    r = recorded(rows=600)
    growth = TransferFunction(num=(1.0,), den=(0.002, -1.0))
    wild = replace(integrator(), blocks=(Block(name="wild", place="plant", dynamics=growth),))
    found = forecast(wild, r, 3.0)[150:]
    assert np.all(np.isfinite(found))
    assert np.max(np.abs(found)) > 1e5 * np.ptp(r.y)


def test_without_a_horizon_the_state_comes_from_the_first_tenth() -> None:
    r = recorded(noise=0.0)
    later = r.y.copy()
    later[150:] = 0.0
    got = forecast(integrator(), Recording(t=r.t, u=r.u, y=later))
    np.testing.assert_allclose(got, r.y, atol=1e-5)


def test_a_horizon_below_two_samples_is_refused() -> None:
    with pytest.raises(InputError, match="horizon"):
        forecast(integrator(), recorded(), 0.03)


def test_behind_a_coarse_converter_the_forecast_takes_its_steps() -> None:
    step = 0.5
    fine = recorded(noise=0.0)
    r = Recording(t=fine.t, u=fine.u, y=step * np.floor(fine.y / step + 0.5))
    model = integrator()
    converter = Effect(name="sensor.quantisation", parameters={"step": Parameter(value=step)})
    plain = np.abs(forecast(model, r, 3.0) - r.y)[300:]
    stepped = np.abs(forecast(replace(model, effects=(converter,)), r, 3.0) - r.y)[300:]
    assert np.sqrt(np.mean(plain**2)) > 0.9 * step / np.sqrt(12.0)  # no state explains the rounding
    assert np.mean(stepped < 1e-9) > 0.9


def test_where_nothing_drives_a_swing_a_shift_of_its_centre_is_found_from_the_past() -> None:
    t = 0.01 * np.arange(2000)
    noise = 0.01 * np.random.default_rng(2).normal(size=t.size)
    y = 0.3 + np.exp(-0.1 * t) * np.cos(np.sqrt(16.0 - 0.01) * t) + noise  # at rest, by the model, at 0
    dynamics = TransferFunction(num=(1.0,), den=(1.0, 0.2, 16.0))
    swing = Model(
        name="swing", input=Port(), output=Port(), blocks=(Block(name="arm", place="plant", dynamics=dynamics),)
    )
    error = (forecast(swing, Recording(t=t, u=np.zeros(t.size), y=y), 3.0) - y)[600:]
    assert np.sqrt(np.mean(error**2)) < 1.5 * 0.01
