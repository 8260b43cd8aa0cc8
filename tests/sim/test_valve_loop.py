"""The simulated valve loops against their own physics: where a valve rests, and where a loop begins to swing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.sim.valve_cases import KINDS, valve_case
from tests.sim.valve_loop import FloatArray, Surroundings, ValveKind, ValveLoop, simulate_loop, ultimate_gain

FAULTY: tuple[ValveKind, ...] = ("play", "choudhury", "he", "friction")


def around(n: int, step: float = 0.0) -> Surroundings:
    return Surroundings(setpoint=np.full(n, step), load=np.zeros(n), noise=np.zeros(n))


def swing(x: FloatArray) -> float:
    return float(np.ptp(x))


@settings(deadline=None, max_examples=20)
@given(lag=st.floats(3.0, 60.0), dead=st.floats(0.2, 1.5), integrating=st.booleans(), sign=st.sampled_from([-1.0, 1.0]))
def test_a_loop_swings_up_above_its_limit_of_gain_and_dies_down_below_it(lag, dead, integrating, sign):
    plant = ValveLoop(
        gain=sign / (lag if integrating else 1.0), lag_s=lag, second_lag_s=0.3 * lag, dead_time_s=round(dead * lag),
        integrating=integrating, Ti_s=6.0 * lag * (1.0 + dead),
    )  # fmt: skip
    limit, omega = ultimate_gain(plant)
    assert limit * sign > 0.0
    period = round(2.0 * np.pi / omega)
    early, late = slice(6 * period, 9 * period), slice(12 * period, 15 * period)
    small = 1e-3 * abs(plant.gain)  # far from the limits of the command
    calm = simulate_loop(replace(plant, K=0.9 * limit), around(15 * period, small))[1]
    wild = simulate_loop(replace(plant, K=1.05 * limit), around(15 * period, small))[1]
    assert swing(calm[late]) < swing(calm[early])
    assert swing(wild[late]) > swing(wild[early])


@pytest.mark.parametrize("valve", FAULTY)
@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), S=st.floats(1.0, 12.0), share=st.floats(0.1, 1.0))
def test_no_valve_is_further_from_its_command_than_its_friction_holds(valve, seed, S, share):
    J = 0.0 if valve == "play" else share * S
    loop = ValveLoop(valve=valve, S=S, J=J, gain=1.0, lag_s=10.0, dead_time_s=3.0, K=1.2, Ti_s=10.0)
    random = np.random.default_rng(seed)
    n = 600
    disturbed = Surroundings(
        setpoint=np.zeros(n), load=5.0 * np.sin(np.arange(n) / 15.0), noise=0.1 * random.normal(size=n)
    )
    u, _, position = simulate_loop(loop, disturbed)
    held = 0.5 * (S + J)
    assert np.abs(u - position).max() <= held + (1e-9 if valve != "friction" else 0.3 * held)


def test_stiction_makes_a_loop_swing_that_is_quiet_with_a_linear_valve():
    loop = ValveLoop(gain=1.0, lag_s=10.0, dead_time_s=3.0, K=1.0, Ti_s=10.0)
    calm, swings = (
        simulate_loop(replace(loop, valve=valve, S=6.0, J=4.0), around(2000, 3.0))[1][1500:]
        for valve in ("linear", "choudhury")
    )
    assert swing(calm) < 1e-6
    assert swing(swings) > 2.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_case_is_the_same_whenever_it_is_drawn_and_another_with_another_seed(kind):
    first, again, other = valve_case(kind, 3, 200), valve_case(kind, 3, 200), valve_case(kind, 4, 200)
    np.testing.assert_array_equal(first.y, again.y)
    assert not np.array_equal(first.y, other.y)
    assert first.y.size == first.u.size == first.r.size == 200
