from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import cont2discrete

from sim.ball import DENOMINATOR, GAIN, TAU_BALL, TAU_SONAR, TAU_TURBINE, Ball, BallSettings, linear_ball, make_ball
from sim.plant import Plant, make_plant
from tests.sim.imperfections import Fault, FaultyPlant


def test_the_chain_is_equation_23() -> None:
    chain = np.polymul(np.polymul([TAU_BALL, 1.0], [TAU_TURBINE, 1.0]), np.polymul([TAU_SONAR, 1.0], [1.0, 0.0]))
    assert chain == pytest.approx(DENOMINATOR, rel=1e-9)
    assert -1.0 / np.array([TAU_BALL, TAU_TURBINE, TAU_SONAR]) == pytest.approx([-2.7503, -59.994, -300.03], rel=1e-4)


def test_its_phase_passes_135_and_180_degrees_where_the_paper_puts_them() -> None:
    response = -linear_ball().response(np.array([2.4893, 11.6817]))
    assert np.degrees(np.angle(response)) % 360.0 == pytest.approx([225.0, 180.0], abs=0.01)


@given(dt_s=st.sampled_from([0.001, 0.01, 0.1, 1.0]), commands=st.lists(st.floats(-5.0, 5.0), min_size=1, max_size=30))
def test_free_flight_is_the_exact_zero_order_hold_response(dt_s: float, commands: list[float]) -> None:
    ball = linear_ball(hover=5.2)
    system = (np.array([GAIN]), np.array(DENOMINATOR))
    num, den, _ = cont2discrete(system, dt_s, method="zoh")
    past_u, past_y = np.zeros(4), np.zeros(4)
    for u in commands:
        ball.advance(5.2 + u, dt_s)
        past_u = np.concatenate([[u], past_u[:3]])
        y = float(num[0][1:] @ past_u - den[1:] @ past_y)
        past_y = np.concatenate([[y], past_y[:3]])
        assert ball.y_true - 5.0 == pytest.approx(y, rel=1e-6, abs=1e-6 * max(1.0, abs(y)))


@given(split=st.floats(0.01, 0.99), u=st.floats(0.0, 10.0))
def test_a_step_may_be_cut_anywhere(split: float, u: float) -> None:
    whole, cut = (Ball(BallSettings(hover=4.8, noise=0.0), seed=0) for _ in range(2))
    whole.advance(u, 1.0)
    cut.advance(u, split)
    cut.advance(u, 1.0 - split)
    assert cut.height == pytest.approx(whole.height, abs=1e-3)


def test_the_ball_lies_on_the_floor_until_the_hover_voltage_lifts_it() -> None:
    ball = make_ball(seed=5)
    ball.advance(ball.u_rest - 0.01, 5.0)
    assert ball.height == 10.0
    ball.advance(ball.u_rest + 0.02, 0.5)
    assert ball.height < 10.0


def test_lift_off_happens_when_the_turbines_flow_passes_hover() -> None:
    ball = Ball(BallSettings(hover=5.0, noise=0.0, bits=None), seed=0)
    # the turbine runs up from 0 to 10 V: flow passes 5 V after tau ln 2
    wait_s = TAU_TURBINE * math.log(2.0)
    ball.advance(10.0, wait_s - 1e-6)
    assert ball.height == 10.0
    ball.advance(10.0, 0.01)
    assert ball.height < 10.0


@given(commands=st.lists(st.floats(0.0, 10.0), min_size=1, max_size=40), seed=st.integers(0, 50))
def test_the_ball_never_leaves_the_tube(commands: list[float], seed: int) -> None:
    ball = make_ball(seed=seed)
    for u in commands:
        ball.advance(u, 0.05)
        assert 0.0 <= ball.height <= 10.0
        assert 0.0 <= ball.measure() < 10.0


def test_hover_voltages_are_drawn_within_half_a_volt_of_nominal_and_the_same_for_the_same_seed() -> None:
    hovers = np.array([make_ball(seed=seed).u_rest for seed in range(300)])
    assert 4.5 <= hovers.min() < 4.55
    assert 5.45 < hovers.max() <= 5.5
    assert make_ball(seed=4).u_rest == make_ball(seed=4).u_rest


def test_noise_is_uniform_of_the_given_half_width() -> None:
    ball = make_ball(seed=1, noise=0.35, start="afloat")
    readings = np.array([ball.measure() for _ in range(20000)]) - 5.0
    assert np.abs(readings).max() == pytest.approx(0.35, abs=0.003)
    assert readings.std() == pytest.approx(0.35 / math.sqrt(3.0), rel=0.02)


def test_a_noise_of_minus_zero_is_none() -> None:
    assert make_ball(noise=-0.0).measure() == make_ball(noise=0.0).measure()


def test_both_converters_have_twelve_bits_over_ten_volts() -> None:
    ball = make_ball(seed=1)
    ball.advance(5.0004, 0.01)
    assert ball.u_applied * 4096 / 10 == pytest.approx(round(5.0004 * 4096 / 10))
    codes = np.array([ball.measure() for _ in range(100)]) * 4096 / 10
    assert codes == pytest.approx(np.round(codes))
    ball.advance(25.0, 0.01)
    assert ball.u_applied == pytest.approx(10.0, abs=10 / 4096)


def test_a_plant_or_a_start_nobody_knows_is_refused() -> None:
    with pytest.raises(ValueError, match="no simulated plant"):
        make_plant("balloon")
    with pytest.raises(ValueError, match="on the floor or afloat"):
        make_plant("ball", start="upstairs")


def faulty(*faults: Fault) -> FaultyPlant:
    return FaultyPlant(make_ball(seed=2, start="afloat"), faults)


def test_a_plant_with_faults_is_a_plant() -> None:
    assert isinstance(faulty(), Plant)
    assert isinstance(make_plant("ball"), Plant)


def test_faults_come_and_go_on_schedule() -> None:
    plant = faulty(Fault(kind="not a number", start_s=0.1, end_s=0.2))
    bad = []
    for _ in range(30):
        plant.advance(plant.u_rest, 0.01)
        bad.append(math.isnan(plant.measure()))
    assert bad.index(True) in (8, 9, 10)
    assert sum(bad) in (9, 10, 11)
    assert not bad[-1]


def test_a_frozen_sensor_repeats_a_stuck_actuator_keeps_and_an_inverted_one_mirrors() -> None:
    frozen = faulty(Fault(kind="frozen sensor"))
    assert len({frozen.measure() for _ in range(5)}) == 1
    stuck = faulty(Fault(kind="stuck actuator"))
    before = stuck.u_applied
    stuck.advance(9.0, 0.01)
    assert stuck.u_applied == pytest.approx(before, abs=10 / 4096)
    inverted = faulty(Fault(kind="inverted actuator", value=5.0))
    inverted.advance(6.0, 0.01)
    assert inverted.u_applied == pytest.approx(4.0, abs=10 / 4096)


def test_a_cut_link_is_said_while_it_is_cut() -> None:
    assert faulty(Fault(kind="cut link")).is_cut_off
    assert not faulty(Fault(kind="cut link", start_s=1.0)).is_cut_off
