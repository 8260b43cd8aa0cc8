"""A sensor or an actuator that has failed is noticed within a time, however many of its samples the link loses."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.config.procedure import LimitSettings
from autotune.errors import ExperimentStopped
from autotune.experiment.limits import Envelope
from autotune.experiment.monitor import FEWEST_REPEATS, RECENT, ReadingMonitor
from autotune.experiment.rig import Reading

T_S = 0.01
#: how many sample times lie between two readings that arrive: 1 where none is lost
PACES = st.lists(st.integers(1, 4), min_size=500, max_size=500)


def monitor(**limits: float) -> ReadingMonitor:
    given = {"u_min": 0.0, "u_max": 10.0, "u_safe": 0.0, "y_min": 1.0, "y_max": 9.0, "swing": 3.0}
    settings = LimitSettings.model_validate(given | limits)
    return ReadingMonitor(Envelope(settings=settings, sample_time_s=T_S).patience, T_S)


def stopped_after(one: ReadingMonitor, readings: list[Reading]) -> tuple[float, int]:
    """Return the time from the first reading to the one that stops it, and how many came."""
    for count, reading in enumerate(readings):
        try:
            one.judge(reading, 5.0)
        except ExperimentStopped:
            return reading.t_s - readings[0].t_s, count
    raise AssertionError("nothing stopped it")


def times(paces: list[int]) -> list[float]:
    t = [0.0]
    for pace in paces:
        t.append(t[-1] + pace * T_S)
    return t


def test_five_samples_in_a_row_are_ridden_through_where_they_come_on_time() -> None:
    good, *bad = (Reading(t_s=t, y=math.nan if t else 5.0) for t in times([1] * 20))
    assert stopped_after(monitor(), [good, *bad]) == (pytest.approx(6 * T_S), 6)


@given(PACES)
def test_a_sensor_that_is_gone_is_noticed_in_time_though_samples_are_lost(paces: list[int]) -> None:
    readings = [Reading(t_s=t, y=math.nan if t else 5.0) for t in times(paces)]
    for limits, longest_s in (({}, 0.15), ({"late_s": 0.06}, 0.06), ({"blind_s": 0.3}, 0.3)):
        after_s, count = stopped_after(monitor(**limits), readings)
        assert after_s <= longest_s + (0.5 + 4) * T_S
        assert after_s > longest_s or count == 6  # nor is less ridden through than is allowed


@given(PACES)
def test_a_sensor_that_stands_still_is_noticed_in_time_though_samples_are_lost(paces: list[int]) -> None:
    one = monitor()
    one.same_s = 0.6
    after_s, count = stopped_after(one, [Reading(t_s=t, y=5.0) for t in times(paces)])
    assert 0.6 - 1e-9 <= after_s <= 0.6 + 4 * T_S + 1e-9
    assert count >= FEWEST_REPEATS


def test_two_equal_readings_around_a_pause_are_no_frozen_sensor() -> None:
    one = monitor()
    one.same_s = 0.6
    for t in (0.0, 2.0, 4.0):
        one.judge(Reading(t_s=t, y=5.0), 5.0)


@given(PACES)
def test_an_actuator_that_does_not_follow_is_noticed_in_time_though_samples_are_lost(paces: list[int]) -> None:
    one = monitor()
    one.u_tolerance = 0.2
    after_s, _ = stopped_after(one, [Reading(t_s=t, y=5.0 + t, u_applied=3.0) for t in times(paces)])
    assert after_s <= 2.0 * (0.15 + 0.5 * T_S) + 4 * T_S


def test_one_reading_after_a_pause_does_not_blame_the_actuator() -> None:
    one = monitor()
    one.u_tolerance = 0.2
    one.judge(Reading(t_s=0.0, y=5.0, u_applied=5.0), 5.0)
    one.judge(Reading(t_s=1.0, y=5.1, u_applied=3.0), 5.0)  # the device shows the command of before
    one.judge(Reading(t_s=1.01, y=5.0, u_applied=5.0), 5.0)


@given(st.integers(0, 100), st.sampled_from((-1.0, 1.0)))
def test_a_plant_that_went_on_while_samples_were_lost_is_no_jump_of_the_sensor(lost: int, sign: float) -> None:
    one = monitor()
    one.jump = 1.5
    speed = sign * one.jump / RECENT  # per sample: as fast as the loop calls credible
    for k in (*range(10), *range(10 + lost, 20 + lost)):
        y, usable = one.judge(Reading(t_s=k * T_S, y=5.0 + k * speed), 5.0)
        assert usable
        assert y == 5.0 + k * speed


@given(st.integers(0, 10))
def test_a_sensor_that_jumps_while_samples_are_lost_is_still_one(lost: int) -> None:
    one = monitor()
    one.jump = 1.5
    readings = [Reading(t_s=k * T_S, y=5.0 if k < 10 else 5.0 + 1.1 * one.jump * (1 + lost / RECENT))
                for k in (*range(10), *range(10 + lost, 30 + lost))]  # fmt: skip
    assert stopped_after(one, readings)[1] < 20


def test_a_plant_that_turns_within_few_samples_is_no_jump_of_the_sensor() -> None:
    """Eight samples a period, the fewest that a link supports, and the relay's triangle nearly as wide as the swing."""
    one = monitor()
    one.jump = 1.5  # half of the swing
    period = [0.0, 1.2, 2.4, 1.2, 0.0, -1.2, -2.4, -1.2]
    assert all(one.judge(Reading(t_s=k * T_S, y=y), 0.0)[1] for k, y in enumerate(5 * period))


def test_one_wild_reading_does_not_make_the_next_good_one_wild() -> None:
    one = monitor()
    one.jump = 1.5
    said = [
        one.judge(Reading(t_s=k * T_S, y=y), 0.0)[1] for k, y in enumerate([0.0] * 6 + [1.4, 0.0, 9.0, -1.4, 0.0, 1.6])
    ]
    assert said == [True] * 8 + [False, True, True, False]
