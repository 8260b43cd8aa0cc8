"""The default estimate: gradient, efficiency, coverage, order choice, unstable and integrating plants, dead time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.confidence import (
    pole_covariance,
    residuals,
    response_covariance,
    whiteness,
)
from autotune.identification.closed_loop.lagged import lagged_factor, lagged_range, lagged_rows
from autotune.identification.closed_loop.order import choose_order, fit_order
from autotune.identification.closed_loop.prediction_error import prediction_error
from autotune.identification.closed_loop.predictor_directions import Predictor, behaviour_directions
from autotune.identification.closed_loop.predictor_sweep import innovations, normal_equations
from autotune.identification.closed_loop.state_space import InnovationModel, from_polynomials, spectral_radius
from tests.loop_example import (
    CONTROLLER,
    PLANT,
    PLANT_DEN,
    PLANT_NUM,
    example_set,
    feedback,
    inside_region,
    simulate_loop,
    two_by_two,
)

OMEGA = np.geomspace(0.05, 1.2, 9)


def _predictor(n: int, n_u: int, n_y: int, seed: int) -> tuple[Predictor, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    F = np.hstack([0.7 * A / spectral_radius(A), 0.3 * rng.standard_normal((n, n_u + n_y + 1))])
    H = 0.3 * rng.standard_normal((n_y, n + n_u + 1))
    u, y = rng.standard_normal((40, n_u)), rng.standard_normal((40, n_y))
    return Predictor(F=F, H=H, x0=rng.standard_normal(n)), u, y


def _errors(p: Predictor, u: FloatArray, y: FloatArray) -> FloatArray:
    return innovations(p.F, p.H, p.x0, u, y)


@settings(max_examples=15)
@given(
    n=st.integers(1, 4), n_u=st.integers(1, 2), n_y=st.integers(1, 2), offset=st.booleans(), seed=st.integers(0, 999)
)
def test_derivatives_agree_with_differences(n: int, n_u: int, n_y: int, offset: bool, seed: int) -> None:
    p, u, y = _predictor(n, n_u, n_y, seed)
    directions = behaviour_directions(p, offset=offset)
    P = directions.shape[1]
    assert n * (n_u + 2 * n_y) + n + (n_y if offset else 0) == P
    every = np.eye(p.F.shape[1])
    total = normal_equations(p.F, p.H, p.x0, u, y, every, directions, np.eye(n_y))
    step = 1e-6
    ahead = [_errors(p.move_along(step * column, directions), u, y).ravel() for column in np.eye(P)]
    behind = [_errors(p.move_along(-step * column, directions), u, y).ravel() for column in np.eye(P)]
    J = (np.array(ahead) - np.array(behind)).T / (2.0 * step)
    scale = np.max(np.abs(total))
    np.testing.assert_allclose(total[:-1, :-1], J.T @ J, atol=1e-5 * scale)
    np.testing.assert_allclose(total[:-1, -1], J.T @ _errors(p, u, y).ravel(), atol=1e-5 * scale)


@given(rows=st.integers(30, 300), lags=st.integers(1, 5), seed=st.integers(0, 99))
@settings(max_examples=20)
def test_blockwise_factor_has_the_lagged_products_about_the_means(rows: int, lags: int, seed: int) -> None:
    signal = np.random.default_rng(seed).standard_normal((rows, 2))
    signals = [(signal, range(-lags, 0)), (signal[:, :1], [0])]
    R, used = lagged_factor(signals)
    X = lagged_rows(signals, *lagged_range(signals))
    assert len(X) == used
    X = X - X.mean(axis=0)
    np.testing.assert_allclose(R.T @ R, X.T @ X, atol=1e-9 * rows)


def test_default_is_exact_without_noise() -> None:
    d = example_set(11, sd=0.0)
    num, den = fit_order(d.u, d.y, 5).model.polynomials()
    np.testing.assert_allclose(den, PLANT_DEN, atol=1e-8)
    np.testing.assert_allclose(num, PLANT_NUM, atol=1e-9)


def test_default_sits_on_the_cramer_rao_bound_with_true_regions_and_stabilised_models() -> None:
    poles = PLANT.poles
    squares, information, covered, covered_poles = np.zeros(5), np.zeros(5), [], []
    count = 40
    truth = PLANT.response(OMEGA)
    for seed in range(count):
        d = example_set(seed)
        estimate = fit_order(d.u, d.y, 5)
        assert estimate.converged
        assert spectral_radius(feedback(estimate.model, CONTROLLER).A) < 1.0
        at = [int(np.argmin(np.abs(estimate.model.poles - pole))) for pole in poles]
        error = estimate.model.poles[at] - poles
        squares += np.abs(error) ** 2
        bound = pole_covariance(prediction_error(PLANT, d.u, d.y, offset=False, max_iterations=0))
        information += np.trace(bound, axis1=1, axis2=2)
        covered.append(inside_region(estimate.model.response(OMEGA) - truth, response_covariance(estimate, OMEGA)))
        covered_poles.append(inside_region(error, pole_covariance(estimate)[at]))
    # 40 sets: the ratio's own standard deviation is about 0.2
    assert np.all(information / squares > 0.6)
    assert 0.90 < np.mean(covered) < 0.99
    assert 0.88 < np.mean(covered_poles) <= 0.99


def test_order_five_is_found() -> None:
    found = [choose_order(d.u, d.y).estimate.model.order for d in map(example_set, range(100, 106))]
    assert found == [5] * 6


def test_two_by_two_loop_with_noise() -> None:
    plant, controller = two_by_two()
    rng = np.random.default_rng(12)
    d = simulate_loop(plant, controller, rng.standard_normal((3000, 2)), 0.1 * rng.standard_normal((3000, 2)))
    choice = choose_order(d.u, d.y, max_order=6)
    assert choice.estimate.model.order == 4
    covariance = response_covariance(choice.estimate, OMEGA)
    error = choice.estimate.model.response(OMEGA) - plant.response(OMEGA)
    assert np.mean(inside_region(error, covariance, 0.9999)) == 1.0
    spread = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    assert np.max(spread / np.max(np.abs(plant.response(OMEGA)), axis=(1, 2))[:, None, None]) < 0.15


PI = from_polynomials([0.5, -0.45], [1.0, -1.0])
UNSTABLE = from_polynomials([0.0, 0.1], [1.0, -1.05], [1.0, -0.9], variance=4e-4)
INTEGRATING = from_polynomials([0.0, 0.02, 0.015], [1.0, -1.8, 0.8], [1.0, -1.2, 0.4], variance=1e-4)


@pytest.mark.parametrize(("plant", "order"), [(UNSTABLE, 1), (INTEGRATING, 2)])
def test_plants_that_run_away_alone_are_identified_under_control(plant: InnovationModel, order: int) -> None:
    controller = from_polynomials([1.5, -1.4], [1.0, -1.0])
    assert spectral_radius(feedback(plant, controller).A) < 1.0
    rng = np.random.default_rng(13)
    sd = float(plant.innovation_covariance[0, 0]) ** 0.5
    d = simulate_loop(plant, controller, rng.standard_normal((1500, 1)), sd * rng.standard_normal((1500, 1)))
    estimate = choose_order(d.u, d.y).estimate
    assert estimate.model.order == order
    error = estimate.model.poles - plant.poles
    assert np.all(inside_region(error, pole_covariance(estimate), 0.9999) == 1.0)
    assert np.max(np.abs(error)) < 0.02


def test_dead_time_is_named_instead_of_a_chain_of_states() -> None:
    plant = replace(from_polynomials([0.0, 0.2], [1.0, -0.9], [1.0, -0.3], variance=0.01), input_delay=6)
    rng = np.random.default_rng(14)
    d = simulate_loop(
        plant.with_delay_as_states(), PI, rng.standard_normal((2000, 1)), 0.1 * rng.standard_normal((2000, 1))
    )
    model = choose_order(d.u, d.y).estimate.model
    assert (model.order, model.input_delay) == (1, 6)
    num, den = model.polynomials()
    assert np.flatnonzero(num)[0] == 7
    np.testing.assert_allclose(model.response(OMEGA), plant.response(OMEGA), rtol=0.1)
    assert den[0] == 1.0


def test_operating_point_and_units_do_not_matter() -> None:
    d = example_set(15)
    here = fit_order(d.u - 5.0, 1e-3 * (d.y + 30.0), 5).model
    there = fit_order(d.u + 40.0, d.y - 7.0, 5).model
    np.testing.assert_allclose(1e3 * here.response(OMEGA), there.response(OMEGA), rtol=2e-3)


def test_constant_is_estimated_where_the_data_ask_for_one_only() -> None:
    d = example_set(15)
    centred, loaded = fit_order(d.u, d.y, 5), fit_order(d.u + 0.2, d.y, 5)
    assert np.all(centred.offset_x == 0.0)
    assert np.all(centred.offset_y == 0.0)
    assert loaded.parameters == centred.parameters + 1
    # the constants stand for the load that was added to u
    unseen = loaded.offset_x + 0.2 * loaded.model.B[:, 0]
    shift, rest, *_ = np.linalg.lstsq(
        np.vstack([loaded.model.A - np.eye(5), loaded.model.C]), np.append(unseen, loaded.offset_y), rcond=None
    )
    assert shift.shape == (5,)
    assert rest[0] < 1e-3


def test_stray_mean_of_a_slow_loop_is_no_operating_point() -> None:
    d = example_set(180)
    assert abs(d.y.mean()) > 0.2 * d.y.std()  # zero in the long run
    found, without = fit_order(d.u, d.y, 5), fit_order(d.u, d.y, 5, offset=False)
    np.testing.assert_allclose(found.model.poles, without.model.poles, rtol=1e-6)


def test_residuals_are_white_at_the_right_order_only() -> None:
    d = example_set(16)
    low, right = fit_order(d.u, d.y, 3), fit_order(d.u, d.y, 5)
    assert whiteness(low, residuals(low, d.u, d.y)).probability < 1e-6
    assert whiteness(right, residuals(right, d.u, d.y)).probability > 1e-3


def test_too_few_rows_are_refused() -> None:
    d = example_set(17)
    with pytest.raises(IdentificationError, match=r"too short|longer future window"):
        fit_order(d.u[:18], d.y[:18], 5)
