"""What is a number, and deviations beside a prior where one number says a million times more than another."""

from __future__ import annotations

from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.arrays import deviations_beside_prior, is_real


@given(st.lists(st.floats(-9.0, 9.0), min_size=1, max_size=5), st.integers(0, 2**32 - 1))
def test_numbers_that_go_their_own_ways_have_the_deviations_of_each_alone(exponents: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    directions = np.linalg.qr(rng.standard_normal((20, len(exponents))))[0]
    sizes = 10.0 ** np.array(exponents)
    found = deviations_beside_prior(directions * sizes)
    np.testing.assert_allclose(found, 1.0 / np.sqrt(1.0 + sizes**2), rtol=1e-5)


@pytest.mark.parametrize("size", [1.0, 1e4, 1e8, 1e12])
def test_two_numbers_of_which_rows_tell_the_sum_alone_keep_half_of_what_was_believed(size: float) -> None:
    column = np.linspace(-1.0, 1.0, 50)
    J = size * np.column_stack([column, column])
    # the difference keeps its prior, variance 1/2 for each; an inverse of J' J + I loses it to rounding from 1e8 on
    found = deviations_beside_prior(J)
    np.testing.assert_allclose(found, np.sqrt(0.5 + 0.5 / (1.0 + 2.0 * size**2 * float(column @ column))), rtol=1e-3)


def test_rows_that_say_nothing_leave_what_was_believed() -> None:
    np.testing.assert_allclose(deviations_beside_prior(np.zeros((7, 3))), 1.0)


@pytest.mark.parametrize(
    "value", [1, 0.5, float("nan"), float("inf"), np.float32(1.0), np.int64(3), Fraction(1, 3), Decimal("0.1")]
)
def test_a_number_is_what_floating_point_holds(value: Any) -> None:
    assert is_real(value)


@pytest.mark.parametrize("value", [None, True, "1.0", b"1", 1j, 10**400, [1.0], {}, float, object(), np.zeros(2)])
def test_what_only_looks_like_a_number_is_none(value: Any) -> None:
    assert not is_real(value)
