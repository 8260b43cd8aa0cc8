"""Axes of the live page end at round numbers that hold all that is shown."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.live.axis_ends import linear_ends, log_ends, phase_ends
from autotune.report.figures import usual_range

SIZES = st.floats(1e-6, 1e6)


def is_round(value: float) -> bool:
    """Return whether a positive number is 1, 2 or 5 times a power of ten."""
    mantissa = value / 10.0 ** math.floor(math.log10(value) + 1e-9)
    return any(mantissa == pytest.approx(m, rel=1e-6) for m in (1.0, 2.0, 5.0, 10.0))


@given(low=st.floats(-1e6, 1e6), width=SIZES)
def test_ends_hold_the_range_and_are_whole_intervals(low: float, width: float) -> None:
    ends = linear_ends(low, low + width)
    step = ends["interval"]
    slack = 1e-6 * step + 1e-8 * abs(low)
    assert is_round(step)
    assert ends["min"] <= low + slack
    assert ends["max"] >= low + width - slack
    for end in (ends["min"], ends["max"]):
        assert abs(end - step * round(end / step)) <= slack
    assert ends["max"] - ends["min"] <= width + 2.0 * (step + slack)
    assert step <= 0.25 * width * (1.0 + 1e-9) <= 2.6 * step


@given(values=st.lists(SIZES, min_size=1, max_size=5))
def test_ends_of_a_logarithmic_axis_are_round_and_near(values: list[float]) -> None:
    ends = log_ends(np.array(values))
    assert is_round(ends["min"])
    assert is_round(ends["max"])
    assert min(values) / 3.1 <= ends["min"] < min(values)
    assert max(values) < ends["max"] <= 3.1 * max(values)


def test_a_range_as_people_draw_it() -> None:
    assert linear_ends(0.46, 10.5) == {"min": 0.0, "max": 12.0, "interval": 2.0}
    assert linear_ends(4.25, 5.35) == {"min": 4.2, "max": 5.4, "interval": 0.2}
    flat = linear_ends(5.0, 5.0)
    assert flat["min"] <= 5.0 < flat["max"]


@pytest.mark.parametrize("width", [math.inf, math.nan, 1e308, 5e-324])
def test_a_damaged_number_leaves_the_ends_to_the_chart_or_has_ends_that_are_numbers(width: float) -> None:
    assert all(math.isfinite(end) for end in linear_ends(-width, width).values())
    odd = np.array([width, -width, 0.0, 2.0])
    assert all(math.isfinite(end) for end in phase_ends(odd).values())
    assert all(math.isfinite(end) for end in log_ends(odd).values())
    assert usual_range(np.array([width, 1.0, 1.0]))[0] < 1.0


def test_what_is_not_finite_is_not_shown() -> None:
    assert phase_ends(np.array([math.nan, -170.0, -100.0])) == phase_ends(np.array([-170.0, -100.0]))
    assert log_ends(np.array([math.inf, 0.0, 2.0])) == log_ends(np.array([2.0]))
    assert usual_range(np.array([math.nan, 4.0, 6.0])) == usual_range(np.array([4.0, 6.0]))
    assert usual_range(np.array([math.inf])) == [0.0, 1.0]
