"""References: the prefilter is the set-point weight, and flat trajectories are followed exactly within their limits."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.controller import PIDController
from autotune.design.reference import flat_transition, prefilter
from autotune.errors import DesignError
from autotune.models import TransferFunction
from tests.autotune.design.plants import BALL, REDUCED

LAGS = TransferFunction(num=(2.0,), den=(0.5, 1.5, 1.0))


@given(
    K=st.floats(0.1, 5.0),
    Ti=st.floats(0.1, 10.0),
    b=st.floats(0.0, 1.0),
    Td=st.floats(0.0, 1.0),
    Tf=st.floats(0.0, 0.5),
)
def test_prefilter_turns_the_controller_into_the_weighted_one(
    K: float, Ti: float, b: float, Td: float, Tf: float
) -> None:
    controller = PIDController(K=K, Ti_s=Ti, Td_s=Td, Tf_s=Tf, setpoint_weight=b)
    omega = np.geomspace(1e-2, 1e2, 30)
    from_r = controller.response(omega) * prefilter(controller).response(omega)
    np.testing.assert_allclose(from_r, K * (b + 1.0 / (1j * omega * Ti)), rtol=1e-9)


def test_weight_zero_takes_the_overshoot_out_of_the_set_point_response() -> None:
    controller = PIDController(K=-0.0366, Ti_s=4.04)
    t = np.linspace(0.0, 40.0, 4001)

    def peak(weight: float) -> float:
        c = PIDController(K=controller.K, Ti_s=controller.Ti_s, setpoint_weight=weight)
        C, F = c.transfer_function(), prefilter(c)
        H = control.tf(BALL.num, BALL.den)
        loop = control.feedback(H * control.tf(C.num, C.den), 1)
        _, y = control.step_response(loop * control.tf(F.num, F.den), t)
        return float(np.max(y))

    assert peak(1.0) > 1.25
    assert peak(0.0) < 1.08


@given(
    to=st.floats(-3.0, 3.0).filter(lambda value: abs(value) > 0.1),
    u_rate=st.sampled_from([math.inf, 20.0, 2.0]),
    y_speed=st.sampled_from([math.inf, 1.0]),
    plant=st.sampled_from([LAGS, BALL]),
)
@settings(max_examples=20)
def test_transition_keeps_every_limit_and_touches_one(
    to: float, u_rate: float, y_speed: float, plant: TransferFunction
) -> None:
    found = flat_transition(
        plant, y_start=0.0, y_end=to, u_rest=5.0, u_min=0.0, u_max=10.0, u_rate=u_rate, y_speed=y_speed
    )
    dt = found.t_s[1]
    assert np.all((found.u >= -1e-9) & (found.u <= 10.0 + 1e-9))
    assert np.max(np.abs(np.diff(found.u))) / dt <= u_rate * (1.0 + 1e-9)
    assert np.max(np.abs(np.diff(found.y))) / dt <= y_speed * (1.0 + 1e-9)
    assert np.all(np.diff(found.y) * np.sign(to) >= -1e-12)
    use = {
        "command": max(np.max(found.u) - 5.0, 5.0 - np.min(found.u)) / 5.0,
        "rate": np.max(np.abs(np.diff(found.u))) / dt / u_rate,
        "speed": np.max(np.abs(np.diff(found.y))) / dt / y_speed,
    }
    assert use[found.binding] == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("plant", [LAGS, BALL], ids=["lags", "ball"])
def test_plant_driven_by_the_command_follows_the_trajectory(plant: TransferFunction) -> None:
    found = flat_transition(plant, y_start=1.0, y_end=2.5, u_rest=5.0, u_min=0.0, u_max=10.0)
    system = control.ss(control.tf(plant.num, plant.den))
    _, y = control.forced_response(system, found.t_s, found.u - 5.0)
    np.testing.assert_allclose(y + 1.0, found.y, atol=2e-3)
    assert found.u[0] == pytest.approx(5.0)


def test_an_output_out_of_reach_is_answered_with_the_furthest_one() -> None:
    with pytest.raises(DesignError, match="furthest output that can be held is 10"):
        flat_transition(LAGS, y_start=0.0, y_end=20.0, u_rest=5.0, u_min=0.0, u_max=10.0)


def test_a_plant_with_zeros_is_refused() -> None:
    with pytest.raises(DesignError, match="not flat"):
        flat_transition(REDUCED, y_start=0.0, y_end=1.0, u_rest=5.0, u_min=0.0, u_max=10.0)
