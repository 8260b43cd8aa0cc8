from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import cont2discrete

from autotune.controller import PIDController
from autotune.design.law import PILaw
from autotune.experiment.prediction import predict, sampled
from autotune.experiment.verify import beside
from autotune.models import TransferFunction

BALL = TransferFunction(num=(-65.5,), den=(2.02e-5, 0.007328, 0.3836, 1.0, 0.0))


def test_the_hold_is_discretised_as_in_the_textbook() -> None:
    num, den = sampled(TransferFunction(num=(2.0,), den=(3.0, 1.0)), 0.5)
    expected_num, expected_den, _ = cont2discrete(([2.0], [3.0, 1.0]), 0.5)
    np.testing.assert_allclose(den, expected_den, rtol=1e-12)
    np.testing.assert_allclose(num[:2], expected_num.ravel(), atol=1e-12)


@given(delay=st.floats(0, 2.0), Ts=st.floats(0.05, 0.5))
def test_a_step_through_any_dead_time_is_exact_at_the_samples(delay: float, Ts: float) -> None:
    num, den = sampled(TransferFunction(num=(2.0,), den=(3.0, 1.0), delay_s=delay), Ts)
    markov = np.zeros(80)
    for k in range(80):  # the difference equation, term by term
        markov[k] = (num[k] if k < num.size else 0.0) - sum(den[i] * markov[k - i] for i in range(1, min(k, 1) + 1))
    t = Ts * np.arange(80)
    exact = np.where(t > delay, 2.0 * (1 - np.exp(-(t - delay) / 3.0)), 0.0)
    np.testing.assert_allclose(np.cumsum(markov), exact, atol=1e-7)


@pytest.mark.parametrize(
    "controller",
    [
        PIDController(K=-0.025, Ti_s=3.6),
        PIDController(K=-0.025, Ti_s=3.6, setpoint_weight=0.4),
        PIDController(K=-0.03, Ti_s=3.6, Td_s=0.2, Tf_s=0.05),
        PIDController(K=-0.02, Ti_s=float("inf")),
    ],
)
def test_the_prediction_is_the_law_stepped_sample_by_sample_on_the_plant(controller: PIDController) -> None:
    law = PILaw(controller=controller, sample_time_s=0.01)
    count = 1500
    setpoint = np.where(np.arange(count) >= 10, 1.0, 0.0)
    disturbance = np.where(np.arange(count) >= 700, 0.03, 0.0)
    prediction = predict(BALL, [BALL], law, setpoint, disturbance, 0.0, np.random.default_rng(0), u_rest=0.0)
    num, den = sampled(BALL, 0.01)
    y, u = np.zeros(count), np.zeros(count)
    state = law.initial(0.0, 0.0, 0.0)
    for k in range(count):
        y[k] = sum(num[i] * (u[k - i] + disturbance[k - i]) for i in range(1, num.size) if k >= i)
        y[k] -= sum(den[i] * y[k - i] for i in range(1, den.size) if k >= i)
        u[k], state = law.step(state, setpoint[k], y[k])
    np.testing.assert_allclose(prediction.y, y, atol=1e-6)
    np.testing.assert_allclose(prediction.u, u, atol=1e-6)
    np.testing.assert_allclose(prediction.y_draws[0], y, atol=1e-6)


@given(
    K=st.floats(0.3, 6.0),
    step=st.floats(-3.0, 3.0),
    load=st.floats(-2.0, 2.0),
    up=st.floats(0.5, 5.0),
    down=st.floats(0.5, 5.0),
    rate=st.one_of(st.just(float("inf")), st.floats(0.5, 20.0)),
)
def test_the_prediction_holds_the_command_to_its_limits_as_the_law_that_runs_does(
    K: float, step: float, load: float, up: float, down: float, rate: float
) -> None:
    plant, u_rest, T_s, count = TransferFunction(num=(1.0,), den=(1.0, 2.5, 1.0), delay_s=0.25), 5.0, 0.2, 120
    law = PILaw(
        controller=PIDController(K=K, Ti_s=2.5), sample_time_s=T_s, u_min=5.0 - down, u_max=5.0 + up, u_rate=rate
    )
    late = np.arange(count) >= count // 2
    setpoint, disturbance = np.full(count, step), np.where(late, load, 0.0)
    prediction = predict(plant, [plant], law, setpoint, disturbance, 0.0, np.random.default_rng(0), u_rest=u_rest)
    num, den = sampled(plant, T_s)
    y, u, sent = np.zeros(count), np.zeros(count), np.zeros(count)
    state, before = law.initial(u_rest, 0.0, 0.0), u_rest
    for k in range(count):
        y[k] = sum(num[i] * (sent[k - i] - u_rest) for i in range(1, num.size) if k >= i)
        y[k] -= sum(den[i] * y[k - i] for i in range(1, den.size) if k >= i)
        u[k], state = beside(law, float(disturbance[k])).step(state, step, y[k])
        before = sent[k] = min(max(u[k] + disturbance[k], before - rate * T_s), before + rate * T_s)
    np.testing.assert_allclose(prediction.u, u - u_rest, atol=1e-9)
    np.testing.assert_allclose(prediction.y, y, atol=1e-9)
    assert np.all(sent <= law.u_max + 1e-12)
    assert np.all(sent >= law.u_min - 1e-12)


def test_the_band_holds_a_fresh_noisy_run_95_per_cent_of_the_time() -> None:
    law = PILaw(controller=PIDController(K=-0.025, Ti_s=3.6), sample_time_s=0.01)
    quiet = np.zeros(2000)
    rng = np.random.default_rng(1)
    band = predict(BALL, [BALL] * 200, law, quiet, quiet, 0.2, rng, u_rest=0.0)
    fresh = predict(BALL, [BALL] * 20, law, quiet, quiet, 0.2, rng, u_rest=0.0)
    inside = np.mean((fresh.y_draws > band.low) & (fresh.y_draws < band.high))
    assert inside == pytest.approx(0.95, abs=0.02)
