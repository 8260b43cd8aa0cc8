from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.errors import InputError
from autotune.experiment.relay import RelaySettings, RelayState, relay_step
from autotune.identification.frequency.limit_cycle_points import limit_cycle_points
from sim.ball import linear_ball

IDEAL = RelaySettings(y_centre=0.0, midpoint=0.0, amplitude=1.0)


def commands(relay: RelaySettings, y: list[float]) -> list[float]:
    state, out = RelayState(), []
    for value in y:
        state, u = relay_step(state, relay, value)
        out.append(u)
    return out


def test_a_relay_raises_the_command_below_the_centre_and_lowers_it_above() -> None:
    assert commands(IDEAL, [-1.0, 1.0, -1.0]) == [1.0, -1.0, 1.0]
    assert commands(replace(IDEAL, plant_sign=-1), [-1.0, 1.0, -1.0]) == [-1.0, 1.0, -1.0]


def test_hysteresis_ignores_crossings_smaller_than_itself() -> None:
    relay = replace(IDEAL, hysteresis=0.5)
    assert commands(relay, [-1.0, 0.4, -0.4, 0.4, 0.6, 0.4, -0.4, -0.6]) == [1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0]


def test_levels_are_midpoint_plus_and_minus_amplitude() -> None:
    relay = replace(IDEAL, midpoint=5.0, amplitude=0.3)
    assert commands(relay, [-1.0, 1.0]) == pytest.approx([5.3, 4.7])


@given(delay=st.floats(0.0, 40.0), half=st.integers(3, 25))
def test_a_delay_shifts_the_command_by_itself_whatever_its_fraction(delay: float, half: int) -> None:
    y = ([-1.0] * half + [1.0] * half) * 8
    prompt = np.array(commands(IDEAL, y))
    delayed = np.array(commands(replace(IDEAL, delay_samples=delay), y))
    # the ideal delayed command has the area of the prompt one, delay samples later; until its first switch it is high
    area = np.concatenate([[0.0], np.cumsum(prompt)])
    grid = np.arange(len(y) + 1, dtype=float)
    wanted = np.where(grid < delay, grid, delay + np.interp(grid - delay, grid, area))
    assert np.concatenate([[0.0], np.cumsum(delayed)]) == pytest.approx(wanted, abs=1e-9)


@given(delay=st.floats(0.0, 20.0), y=st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=60))
def test_no_command_leaves_the_two_levels(delay: float, y: list[float]) -> None:
    out = commands(replace(IDEAL, delay_samples=delay, hysteresis=0.2, smoothing=3), y)
    assert all(-1.0 <= u <= 1.0 for u in out)


def test_smoothing_is_a_moving_average() -> None:
    relay = replace(IDEAL, smoothing=3)
    # the average of the last three turns positive with the second high reading
    assert commands(relay, [-1.0, -1.0, -1.0, 1.0, 1.0, 1.0]) == [1.0, 1.0, 1.0, 1.0, -1.0, -1.0]


@pytest.mark.parametrize("wrong", [{"amplitude": 0.0}, {"hysteresis": -1.0}, {"delay_samples": -1.0}, {"smoothing": 0}])
def test_a_relay_that_makes_no_sense_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        replace(IDEAL, **wrong)  # type: ignore[arg-type]  # the parameters are of mixed type


@settings(max_examples=25)
@given(
    amplitude=st.floats(0.01, 1.0),
    hysteresis=st.floats(0.0, 2.0),
    delay=st.floats(0.0, 150.0),
    smoothing=st.integers(1, 20),
    lopsided=st.floats(-0.3, 0.3),
)
def test_without_noise_the_point_is_exact_for_any_relay_that_oscillates(
    amplitude: float, hysteresis: float, delay: float, smoothing: int, lopsided: float
) -> None:
    ball = linear_ball()
    relay = RelaySettings(
        y_centre=5.0,
        midpoint=5.0 + lopsided * amplitude,
        amplitude=amplitude,
        hysteresis=hysteresis,
        delay_samples=delay,
        smoothing=smoothing,
        plant_sign=-1,
    )
    state, rows, switches = RelayState(), [], []
    while len(switches) < 14:
        y = ball.measure()
        level = state.level
        state, u = relay_step(state, relay, y)
        if state.level != level:
            switches.append(len(rows))
        rows.append((len(rows) * 0.01, u, y))
        ball.advance(u, 0.01)
    t, u, y = np.array(rows[switches[7] - 2 :]).T
    point = limit_cycle_points(t, u, y).points[0]
    ratio = point.response / ball.response(np.array([point.omega_rad_s]))[0]
    assert abs(abs(ratio) - 1.0) < 1e-3
    assert abs(math.degrees(math.atan2(ratio.imag, ratio.real))) < 0.1
