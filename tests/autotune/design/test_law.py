"""The discrete law: it is C at s = (1 - 1/z)/T_s, hands over without a bump, and never leaves its limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.controller import PIDController
from autotune.design.law import PILaw
from autotune.errors import InputError

gains = st.floats(0.01, 10.0)
signals = st.floats(-10.0, 10.0)


@given(K=gains, Ti=gains, Td=st.floats(0.0, 2.0), Tf=st.floats(0.0, 1.0), omega=st.floats(0.01, 30.0))
def test_discrete_law_is_the_continuous_one_at_the_backward_difference(
    K: float, Ti: float, Td: float, Tf: float, omega: float
) -> None:
    T_s = 0.05
    s = (1.0 - np.exp(-1j * omega * T_s)) / T_s
    law = PILaw(controller=PIDController(K=K, Ti_s=Ti, Td_s=Td, Tf_s=Tf), sample_time_s=T_s)
    expected = K * (1.0 + 1.0 / (Ti * s) + Td * s) / (1.0 + Tf * s)
    assert law.discrete().response(np.array([omega]))[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("Ti", [3.0, math.inf])
def test_steps_of_the_law_are_the_difference_equation_of_its_transfer_function(Ti: float) -> None:
    law = PILaw(controller=PIDController(K=-0.4, Ti_s=Ti, Td_s=0.3, Tf_s=0.1), sample_time_s=0.02)
    C = law.discrete()
    rng = np.random.default_rng(1)
    y = rng.normal(size=60)
    state = law.initial(0.0, 0.0, 0.0)
    u = np.zeros(60)
    for k in range(60):
        u[k], state = law.step(state, 0.0, float(y[k]))
        expected = sum(b * -y[k - i] for i, b in enumerate(C.num) if k >= i)
        expected -= sum(a * u[k - i] for i, a in enumerate(C.den) if 0 < i <= k)
        assert u[k] == pytest.approx(expected, abs=1e-9)


@given(K=gains, Ti=gains, b=st.floats(0.0, 1.0), u=signals, r=signals, y=signals)
def test_handing_over_leaves_the_command_where_it_was(
    K: float, Ti: float, b: float, u: float, r: float, y: float
) -> None:
    law = PILaw(controller=PIDController(K=K, Ti_s=Ti, setpoint_weight=b), sample_time_s=0.01)
    assert law.step(law.initial(u, r, y), r, y)[0] == pytest.approx(u, abs=1e-8)


@given(ys=st.lists(signals, min_size=1, max_size=40), rs=signals, start=st.floats(0.0, 5.0))
def test_command_stays_within_its_limits_and_its_rate(ys: list[float], rs: float, start: float) -> None:
    law = PILaw(
        controller=PIDController(K=3.0, Ti_s=0.2, Td_s=0.1), sample_time_s=0.1, u_min=0.0, u_max=5.0, u_rate=7.0
    )
    state = law.initial(start, rs, ys[0])
    for y in ys:
        before = state.u
        u, state = law.step(state, rs, y)
        assert 0.0 <= u <= 5.0
        assert abs(u - before) <= 0.7 + 1e-12


def test_integral_does_not_wind_up_while_the_actuator_is_saturated() -> None:
    # the plant cannot reach the set-point for 20 s; when that comes back, u must leave its limit at once
    controller = PIDController(K=2.0, Ti_s=1.0)

    def time_saturated(law: PILaw) -> float:
        y, state, late = 0.0, law.initial(0.0, 0.0, 0.0), 0
        for k in range(4000):
            r = 3.0 if k < 2000 else 0.5
            u, state = law.step(state, r, y)
            u = min(max(u, 0.0), 1.0)
            y += 0.01 * (u - y)
            late += k >= 2000 and u >= 1.0
        return late * 0.01

    with_tracking = time_saturated(PILaw(controller=controller, sample_time_s=0.01, u_min=0.0, u_max=1.0))
    without = time_saturated(PILaw(controller=controller, sample_time_s=0.01))
    assert with_tracking == 0.0
    assert without > 10.0


@given(u=st.floats(-4.0, 4.0), K1=gains, K2=gains, r=signals, y=signals)
def test_new_gains_take_over_without_a_bump(u: float, K1: float, K2: float, r: float, y: float) -> None:
    law = PILaw(controller=PIDController(K=K1, Ti_s=1.0), sample_time_s=0.01, u_min=-5.0, u_max=5.0)
    state = law.initial(u, r, y)
    u_before, state = law.step(state, r, y)
    other = replace(law, controller=PIDController(K=K2, Ti_s=0.5))
    assert other.step(other.initial(state.u, r, y), r, y)[0] == pytest.approx(u_before, abs=1e-8)


@pytest.mark.parametrize(
    "wrong",
    [{"sample_time_s": 0.0}, {"u_min": 1.0, "u_max": 1.0}, {"u_rate": 0.0}, {"tracking_time_s": -1.0}],
)
def test_impossible_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        PILaw(**({"controller": PIDController(K=1.0, Ti_s=1.0), "sample_time_s": 0.1} | wrong))


def test_a_measurement_that_is_not_a_number_is_refused() -> None:
    law = PILaw(controller=PIDController(K=1.0, Ti_s=1.0), sample_time_s=0.1)
    with pytest.raises(InputError, match="finite"):
        law.step(law.initial(0.0, 0.0, 0.0), 0.0, math.nan)
