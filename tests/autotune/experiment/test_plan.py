from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.errors import IdentificationError
from autotune.experiment.local_model import LocalModel, predict_crossing
from autotune.experiment.plan import Choice, Goal, allot, choose, expected_sd, phase_targets, time_s, within_reach
from autotune.experiment.relay import RelaySettings
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint
from sim.ball import linear_ball

GOAL = Goal(peak=2.6, noise_sd=0.2, sample_time_s=0.01, u_step=0.0, u_room=4.0)
NO_DOUBT = ((1e-9, 0.0), (0.0, 1e-9))


def known(*omegas: float) -> list[FrequencyPoint]:
    responses = linear_ball().response(np.array(omegas))
    return [
        FrequencyPoint(omega_rad_s=w, response=complex(r), covariance=NO_DOUBT)
        for w, r in zip(omegas, responses, strict=True)
    ]


@given(count=st.integers(3, 20), ends=st.tuples(st.floats(-130.0, -95.0), st.floats(-175.0, -140.0)))
def test_targets_lie_within_the_wanted_phases_the_most_lagging_first(count: int, ends: tuple[float, float]) -> None:
    targets = np.degrees(phase_targets(*ends, count))
    assert np.all((targets < ends[0]) & (targets > ends[1]))
    assert np.all(np.diff(targets) > 0)


@settings(max_examples=30)
@given(omega=st.floats(0.7, 8.0), phase_deg=st.floats(-158.0, -107.0))
def test_from_one_point_the_next_frequency_is_foreseen_well_enough_to_stay_in_the_wanted_range(
    omega: float, phase_deg: float
) -> None:
    foreseen, _ = predict_crossing(known(omega), -1, math.radians(phase_deg))
    reached = np.degrees(np.angle(-linear_ball().response(np.array([foreseen]))))[0]
    assert reached == pytest.approx(phase_deg, abs=14.0)


def test_between_known_points_the_frequency_is_foreseen_to_one_degree() -> None:
    foreseen, model = predict_crossing(known(1.0, 1.5, 2.3, 3.5, 5.0), -1, math.radians(-138.0))
    truth = linear_ball().response(np.array([foreseen]))[0]
    assert math.degrees(np.angle(-truth)) == pytest.approx(-138.0, abs=1.0)
    assert model.gain(foreseen) == pytest.approx(abs(truth), rel=0.05)


@pytest.mark.parametrize("phase_deg", [-111.0, -125.0, -140.0, -154.0])
def test_the_chosen_relay_keeps_y_within_the_planned_peak(phase_deg: float) -> None:
    omegas = np.geomspace(0.7, 7.0, 9)
    choice = choose(known(*omegas), math.radians(phase_deg), GOAL, midpoint=5.0, y_centre=5.0, plant_sign=-1)
    ball = linear_ball()
    orders = np.arange(1, 40, 2)
    square = 4.0 * choice.settings.amplitude / np.pi / orders
    phase = np.exp(1j * np.multiply.outer(np.linspace(0.0, 2.0 * np.pi, 400), orders))
    wave = np.imag(phase @ (square * ball.response(orders * choice.omega_rad_s)))
    assert np.abs(wave).max() == pytest.approx(GOAL.peak, rel=0.04)


def test_the_relays_lag_of_an_integrator_is_a_quarter_period_when_nothing_else_delays() -> None:
    # a pure integrator makes a triangle of the square wave, which crosses zero a quarter period before each switch
    model = LocalModel(k=1.0, tau_s=1e-9)
    assert model.crossing_s(2.0, 1.0, 0.0, 0.0) == pytest.approx(math.pi / 4.0, rel=0.01)
    assert model.crest(2.0) == pytest.approx(math.pi**2 / 8.0, rel=0.03)  # ten harmonics of it


def test_a_plant_that_does_not_lag_is_refused() -> None:
    leading = FrequencyPoint(omega_rad_s=1.0, response=1.0 + 0.1j, covariance=NO_DOUBT)
    with pytest.raises(IdentificationError, match="between -90 and -180"):
        predict_crossing([leading], 1, math.radians(-120.0))


def points_of(plant: TransferFunction, *omegas: float) -> list[FrequencyPoint]:
    responses = plant.response(np.array(omegas))
    return [
        FrequencyPoint(omega_rad_s=w, response=complex(r), covariance=NO_DOUBT)
        for w, r in zip(omegas, responses, strict=True)
    ]


def test_one_lag_is_measured_where_its_phases_are() -> None:
    lag = TransferFunction(num=(2.0,), den=(1.0, 1.0))
    first = points_of(lag, 12.0)
    high, low = within_reach((-105.0, -160.0), first[0], 1)
    assert math.degrees(np.angle(first[0].response)) == pytest.approx(low)
    assert -60.0 < high < -30.0
    for phase_deg in (high, 0.5 * (high + low)):
        foreseen, model = predict_crossing(first, 1, math.radians(phase_deg))
        truth = lag.response(np.array([foreseen]))[0]
        assert math.degrees(np.angle(truth)) == pytest.approx(phase_deg, abs=0.1)
        assert model.gain(foreseen) == pytest.approx(abs(truth), rel=0.02)
    assert within_reach((-105.0, -160.0), known(2.0)[0], -1) == (-105.0, -160.0)


def test_where_one_point_is_known_the_gain_is_foreseen_rather_too_large() -> None:
    """Under a dead time it stays: an integrator's fall upwards let a relay leave the swing."""
    lag = TransferFunction(num=(0.5,), den=(2.0, 1.0), delay_s=6.0)
    first = points_of(lag, 0.3)
    for phase_deg in (-155.0, -150.0, -145.0):
        foreseen, model = predict_crossing(first, 1, math.radians(phase_deg))
        assert foreseen > 0.3
        assert model.gain(foreseen) >= abs(lag.response(np.array([foreseen]))[0])


def test_a_first_setting_that_may_swing_less_than_foreseen_gets_periods_for_that() -> None:
    relay = RelaySettings(y_centre=0.0, midpoint=0.0, amplitude=1.0)
    one = Choice(settings=relay, phase_rad=-2.0, omega_rad_s=4.0, y_amplitude=2.4, turning_s=0.2)
    smaller = replace(one, y_amplitude=0.9 * 2.4)
    assert allot([one, one], GOAL, 0.004, 2, 1e3, 0.9) == allot([smaller, one], GOAL, 0.004, 2, 1e3)
    assert allot([one, one], GOAL, 0.004, 2, 1e3, 0.9)[0] > allot([one, one], GOAL, 0.004, 2, 1e3)[0]


@given(
    omegas=st.lists(st.floats(0.5, 8.0), min_size=1, max_size=6),
    left_s=st.floats(0.0, 200.0),
)
def test_rig_time_is_shared_without_being_overdrawn(omegas: list[float], left_s: float) -> None:
    relay = RelaySettings(y_centre=0.0, midpoint=0.0, amplitude=1.0)
    choices = [Choice(settings=relay, phase_rad=-2.0, omega_rad_s=w, y_amplitude=2.4, turning_s=0.2) for w in omegas]
    periods = allot(choices, GOAL, 0.004, 2, left_s)
    spent_s = sum(time_s(choice, count) for choice, count in zip(choices, periods, strict=True))
    least_s = sum(time_s(choice, 2) for choice in choices)
    assert spent_s <= max(left_s, least_s) + 1e-9
    assert all(count >= 2 for count in periods)
    # no point gets more than it needs
    for choice, count in zip(choices, periods, strict=True):
        if count > 2:
            samples = (count - 1) * 2.0 * math.pi / choice.omega_rad_s / GOAL.sample_time_s
            assert expected_sd(GOAL.noise_sd, choice.y_amplitude, samples) > 0.004


@pytest.mark.parametrize("noise_deg", [-0.9, 0.0, 0.9])
def test_one_lag_far_above_its_corner_is_one_lag_though_noise_turns_its_phase(noise_deg: float) -> None:
    omega = 25.0
    response = TransferFunction(num=(2.0,), den=(1.0, 1.0)).response(np.array([omega]))[0]
    turned = abs(response) * np.exp(-1j * math.radians(90.0 + noise_deg))
    first = FrequencyPoint(omega_rad_s=omega, response=complex(turned), covariance=NO_DOUBT)
    foreseen, _ = predict_crossing([first], 1, math.radians(-70.0))
    assert 1.0 / 3.0 < foreseen / math.tan(math.radians(70.0)) < 5.0
