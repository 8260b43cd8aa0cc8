from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.config.procedure import LimitSettings
from autotune.errors import ExperimentStopped
from autotune.experiment.limits import Envelope, Watch

LIMITS = LimitSettings(u_min=0.0, u_max=10.0, u_safe=0.0, u_rate=50.0, y_min=1.0, y_max=9.0, swing=3.0, time_s=100.0)
PERIOD_S = 0.01
MOST = LIMITS.u_rate * PERIOD_S
anything = st.floats(allow_nan=True, allow_infinity=True)


def envelope(u_step: float = 0.0) -> Envelope:
    return Envelope(settings=LIMITS, sample_time_s=PERIOD_S, u_step=u_step)


@given(u=anything, previous=st.floats(0.0, 10.0))
def test_the_envelope_never_lets_an_out_of_range_or_too_fast_command_through(u: float, previous: float) -> None:
    allowed = math.isfinite(u) and 0.0 <= u <= 10.0 and abs(u - previous) <= MOST * (1.0 + 1e-6)
    try:
        envelope().check_command(u, previous)
    except ExperimentStopped:
        # nothing well within the limits is stopped
        assert not (allowed and abs(u - previous) <= MOST * (1.0 - 1e-6))
    else:
        assert allowed


@given(
    u=st.floats(allow_nan=False, allow_infinity=False),
    previous=st.floats(0.0, 10.0),
    u_step=st.sampled_from([0.0, 10.0 / 4096, 0.1, 0.7]),
)
def test_the_nearest_allowed_command_always_passes(u: float, previous: float, u_step: float) -> None:
    nearest = envelope(u_step).nearest(u, previous)
    envelope(u_step).check_command(nearest, previous)


@given(u=st.floats(0.0, 10.0))
def test_an_allowed_command_is_left_alone(u: float) -> None:
    assert envelope().nearest(u, u) == u


def test_the_nearest_command_is_on_the_converters_grid() -> None:
    assert envelope(0.1).nearest(5.0449, 5.0) == pytest.approx(5.0)
    assert envelope(0.1).nearest(5.0551, 5.0) == pytest.approx(5.1)


def test_a_command_that_is_not_a_number_stops() -> None:
    with pytest.raises(ExperimentStopped, match="not a number"):
        envelope().nearest(math.nan, 5.0)


def test_limits_on_y_apply_where_the_procedure_says() -> None:
    low = (0.5,) * 5
    envelope().check_measurement(low, Watch())
    with pytest.raises(ExperimentStopped, match=r"y_min\.\.y_max"):
        envelope().check_measurement(low, Watch(in_range=True))
    with pytest.raises(ExperimentStopped, match="swing"):
        envelope().check_measurement((8.5,) * 5, Watch(y_centre=5.0))


def test_one_wild_reading_does_not_stop_but_three_of_five_do() -> None:
    watch = Watch(y_centre=5.0, in_range=True)
    envelope().check_measurement((5.0, 9.9, 5.0, 9.9, 5.0), watch)
    with pytest.raises(ExperimentStopped):
        envelope().check_measurement((5.0, 9.9, 9.9, 9.9, 5.0), watch)


def test_time_is_limited() -> None:
    envelope().check_time(100.0)
    with pytest.raises(ExperimentStopped, match="time over"):
        envelope().check_time(100.1)
