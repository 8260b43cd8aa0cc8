"""The method of Pouliquen et al. 2011 and its peers: exact without noise, the paper's figures with it."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from autotune.errors import IdentificationError
from autotune.identification.closed_loop.refit import refit_inputs
from autotune.identification.closed_loop.state_space import spectral_radius
from autotune.identification.closed_loop.subspace_direct import pbsid_opt, ssarx
from autotune.identification.closed_loop.subspace_indirect import (
    controller_markov_parameters,
    controller_order,
    indirect_subspace,
)
from autotune.identification.closed_loop.subspace_peers import (
    oku_tanaka,
    orthogonal_decomposition,
    van_overschee_de_moor,
)
from tests.loop_example import (
    CONTROLLER,
    PLANT,
    PLANT_DEN,
    PLANT_NUM,
    difference,
    example_set,
    feedback,
    h2_norm,
    simulate_loop,
    two_by_two,
)

MARKOV = CONTROLLER.markov_parameters(20)
OMEGA = np.geomspace(0.02, 1.2, 9)


def test_loop_of_the_example_is_stable_with_the_published_spectral_radius() -> None:
    assert spectral_radius(feedback(PLANT, CONTROLLER).A) == pytest.approx(0.98886, abs=5e-6)


def test_a_model_prints_as_a_few_lines_with_its_poles() -> None:
    lines = str(PLANT).splitlines()
    assert len(lines) <= 4
    assert f"order {PLANT.order}, 1 input(s), 1 output(s)" in lines[0]
    assert f"{PLANT.poles[0].real:.4g}" in lines[1]


@pytest.mark.parametrize("instrument", ["r", "r and y"])
def test_paper_method_is_exact_without_noise(instrument: str) -> None:
    d = example_set(1, sd=0.0)
    found = indirect_subspace(d.r, d.u, d.y, 5, controller_markov=MARKOV, f=15, instrument=instrument)
    num, den = found.polynomials()
    np.testing.assert_allclose(den, PLANT_DEN, atol=1e-10)
    np.testing.assert_allclose(num, PLANT_NUM, atol=1e-10)


@pytest.mark.parametrize("from_data", [False, True])
def test_the_loops_order_is_the_plants_and_the_controllers(from_data: bool) -> None:
    """With noise the gap of the singular values shows the plant alone: n_cl = n is not consistent."""
    d = example_set(3, rows=4000)
    markov = controller_markov_parameters(d.r, d.u, d.y, 15)[0] if from_data else MARKOV
    assert controller_order(markov) == 4
    chosen, given_ = (
        indirect_subspace(d.r, d.u, d.y, 5, controller_markov=markov, f=15, loop_order=n) for n in (None, 9)
    )
    np.testing.assert_array_equal(chosen.A, given_.A)


def test_too_few_markov_parameters_leave_the_controllers_order_open() -> None:
    with pytest.raises(IdentificationError, match="do not show the controller's order"):
        controller_order(MARKOV[:7])
    assert controller_order(np.zeros((15, 1, 1))) == 0


def test_the_default_tends_to_the_plant_with_the_record() -> None:
    """Root mean square errors of the poles fall with the root of the rows; with n_cl = n they stay where they are."""
    errors = {}
    for rows in (10_000, 160_000):
        found = []
        with threadpool_limits(1):
            for seed in range(6):
                d = example_set(seed, rows=rows)
                for loop_order in (None, 5):
                    model = indirect_subspace(d.r, d.u, d.y, 5, controller_markov=MARKOV, f=15, loop_order=loop_order)
                    found.append(np.abs(PLANT.poles[:, None] - model.poles).min(axis=1))
        errors[rows] = np.sqrt(np.mean(np.reshape(found, (6, 2, 5)) ** 2, axis=(0, 2)))
    assert errors[160_000][0] < 0.5 * errors[10_000][0]  # a quarter is what independent noise gives
    assert errors[160_000][1] > 2.0 * errors[160_000][0]


def test_poles_of_long_records_are_found_to_a_few_thousandths() -> None:
    """At 400,000 rows n + n_c gives a pole error of .0015 to .003, n_cl = n one of .01 that no record makes smaller."""

    def error(seed: int, loop_order: int | None) -> float:
        d = example_set(seed, rows=400_000)
        model = indirect_subspace(d.r, d.u, d.y, 5, controller_markov=MARKOV, f=15, loop_order=loop_order)
        return float(np.max(np.abs(PLANT.poles[:, None] - model.poles).min(axis=1)))

    with threadpool_limits(1):
        assert np.median([error(seed, None) for seed in range(3)]) < 0.004
        assert error(0, 5) > 0.009


def test_controller_markov_parameters_follow_from_noisy_data_exactly() -> None:
    d = simulate_loop(PLANT, CONTROLLER, *np.random.default_rng(3).standard_normal((2, 1500, 1)))
    markov, order = controller_markov_parameters(d.r, d.u, d.y, 12)
    assert order == 4
    np.testing.assert_allclose(markov, CONTROLLER.markov_parameters(12), atol=1e-8)


def test_controller_markov_parameters_are_refused_where_r_is_not_what_moved_u() -> None:
    d = example_set(4)
    other = np.random.default_rng(0).standard_normal(d.r.shape)
    with pytest.raises(IdentificationError, match="not a linear function"):
        controller_markov_parameters(other, d.u, d.y, 12)


@pytest.mark.parametrize("instrument", ["r", "u and y"])
def test_without_feedback_the_method_is_moesp(instrument: str) -> None:
    """Remark 5: H_c = 0 and r = u; PI-MOESP with past u, PO-MOESP with past u and y, exact without noise."""
    d = example_set(5, sd=0.0)
    found = indirect_subspace(
        d.u, d.u, d.y, 5, controller_markov=np.zeros((15, 1, 1)), f=15, loop_order=5, instrument=instrument
    )
    np.testing.assert_allclose(found.response(OMEGA), PLANT.response(OMEGA), rtol=1e-7)


def test_every_peer_that_uses_r_is_exact_without_noise() -> None:
    d = example_set(6, sd=0.0)
    models = [
        van_overschee_de_moor(d.r, d.u, d.y, 5, controller_markov=MARKOV, f=10),
        oku_tanaka(d.r, d.u, d.y, 5, f=20),
        orthogonal_decomposition(d.r, d.u, d.y, 5, f=20),
    ]
    for model in models:
        np.testing.assert_allclose(model.response(OMEGA), PLANT.response(OMEGA), rtol=1e-6)


def test_oku_and_orthogonal_decomposition_give_the_same_poles() -> None:
    """As the paper remarks of its figures 3 and 4."""
    d = example_set(7)
    first, second = oku_tanaka(d.r, d.u, d.y, 5, f=20), orthogonal_decomposition(d.r, d.u, d.y, 5, f=20)
    np.testing.assert_allclose(first.poles, second.poles, rtol=1e-8)


@pytest.mark.parametrize("method", [pbsid_opt, ssarx])
def test_direct_methods_tend_to_the_plant_with_the_record(method) -> None:
    d = example_set(8, rows=60_000)
    model = method(d.u, d.y, 5, p=40, f=10)
    np.testing.assert_allclose(model.response(OMEGA)[1:], PLANT.response(OMEGA)[1:], rtol=0.1)


def test_two_inputs_and_two_outputs_are_exact_without_noise() -> None:
    plant, controller = two_by_two()
    r = np.random.default_rng(9).standard_normal((1000, 2))
    d = simulate_loop(plant, controller, r, np.zeros((1000, 2)))
    markov, order = controller_markov_parameters(d.r, d.u, d.y, 10)
    found = indirect_subspace(d.r, d.u, d.y, 4, controller_markov=markov, f=10)
    assert order == 2
    np.testing.assert_allclose(found.response(OMEGA), plant.response(OMEGA), rtol=1e-9)


def test_noise_variance_and_refit_on_the_example() -> None:
    """Mean variance 0.107 (the paper prints 0.1023); refitting B and D brings every loop back to stability."""
    variances, raw, refitted = [], [], []
    loop = feedback(PLANT, CONTROLLER)
    for seed in range(30):
        d = example_set(seed)
        model = indirect_subspace(d.r, d.u, d.y, 5, controller_markov=MARKOV, f=15, loop_order=9)
        variances.append(model.innovation_covariance[0, 0])
        for found, errors in ((model, raw), (refit_inputs(model, d.u, d.y), refitted)):
            closed = feedback(found, CONTROLLER)
            stable = spectral_radius(closed.A) < 1.0
            errors.append(h2_norm(difference(closed, loop)) / h2_norm(loop) if stable else np.inf)
    assert np.mean(variances) == pytest.approx(0.1074, abs=0.003)
    assert np.all(np.isfinite(refitted))
    assert np.median(refitted) < 0.16
    assert np.median(raw) > 2.0 * np.median(refitted)


def test_refusals_name_their_reason() -> None:
    d = example_set(10)
    with pytest.raises(IdentificationError, match="too short"):
        indirect_subspace(d.r[:60], d.u[:60], d.y[:60], 5, controller_markov=MARKOV, f=15)
    with pytest.raises(IdentificationError, match="not persistently exciting"):
        indirect_subspace(np.ones_like(d.r), d.u, d.y, 5, controller_markov=MARKOV, f=15)
    with pytest.raises(IdentificationError, match="loop order"):
        indirect_subspace(d.r, d.u, d.y, 5, controller_markov=MARKOV, f=6, loop_order=9)
