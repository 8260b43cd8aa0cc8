"""Start states that a descent eliminates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.diagnosis.fitting.descent import _freed

ROWS, WINDOWS = 60, 2
EDGES = ROWS * np.arange(WINDOWS), ROWS * np.arange(1, WINDOWS + 1)


@given(decades=st.floats(0.0, 6.0), seed=st.integers(0, 99))
def test_a_start_state_comes_to_rest_beside_one_that_is_felt_far_more(decades: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    felt = rng.normal(size=(WINDOWS * ROWS, 3)) * np.array([10.0**decades, 1.0, 1.0])
    states = rng.normal(size=(WINDOWS, 3))
    left = np.einsum("wrs,ws->wr", felt.reshape(WINDOWS, ROWS, 3), states).reshape(-1, 1)
    gains = _freed(left, felt, *EDGES, 0.0)
    assert gains[:, 1:, 0] == pytest.approx(states[:, 1:], abs=2e-3)


def test_a_start_state_that_nothing_is_felt_of_stays() -> None:
    rng = np.random.default_rng(1)
    felt = np.column_stack([rng.normal(size=WINDOWS * ROWS), np.zeros(WINDOWS * ROWS)])
    assert np.all(_freed(rng.normal(size=(WINDOWS * ROWS, 1)), felt, *EDGES, 0.0)[:, 1] == 0.0)
