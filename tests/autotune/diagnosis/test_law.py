"""The control law recomputed from r and y, on loops that run here by their difference equations."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.controller import PIDController
from autotune.diagnosis.law import law_effect
from autotune.recording import Recording

STATED = PIDController(K=0.8, Ti_s=2.0)


def loop(gain: float, rows_before: int, noise: float = 0.02) -> Recording:
    """PI of ``gain`` times the stated K on a lag of 1 s, its command computed ``rows_before`` samples ahead."""
    rng, dt, rows = np.random.default_rng(4), 0.02, 3000
    r = np.where(np.arange(rows) // 300 % 2 == 0, 1.0, 2.0)
    x, integral, u, y, e = 0.0, 0.0, np.zeros(rows), np.zeros(rows), np.zeros(rows)
    for k in range(rows):
        y[k] = x + noise * rng.standard_normal()
        e[k] = r[k] - y[k]
        if k >= rows_before:
            known = e[k - rows_before]
            integral += 0.5 * dt * (known + (e[k - rows_before - 1] if k > rows_before else known))
            u[k] = gain * STATED.K * (known + integral / STATED.Ti_s) + 0.01 * rng.standard_normal()
        x += (1.0 - np.exp(-dt)) * (u[k] - x)
    return Recording(t=dt * np.arange(rows), u=u, y=y, extra={"r": r})


@pytest.mark.parametrize("rows_before", [0, 1])
def test_a_law_that_is_as_stated_is_left_alone_whichever_sample_its_command_came_from(rows_before: int) -> None:
    assert law_effect([loop(1.0, rows_before)], STATED) is None


@pytest.mark.parametrize("rows_before", [0, 1])
def test_another_gain_is_found_with_its_size(rows_before: int) -> None:
    found = law_effect([loop(1.3, rows_before)], STATED)
    assert found is not None
    factor = found.parameters["gain_factor"]
    assert abs(factor.value - 1.3) < 4.0 * factor.sd
