"""What a tank conceals: it overflows, or its pump gives less against a higher level."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from autotune.arrays import FloatArray
from autotune.diagnosis import diagnose
from autotune.equations import EquationModel
from autotune.recording import Recording
from tests.autotune.equations.models import one_state


def tank() -> EquationModel:
    state = [{"name": "h", "kind": "level", "derivative": "(K*u - h)/T"}]
    return one_state("", {"K": {"value": 1.1}, "T": {"value": 4.0}}, output="h", state=state)


def recorded(seed: int, slope: Callable[[float, float], float], highest: float, rows: int = 1200) -> Recording:
    """Euler's method in steps of a twentieth of the sample time."""
    random, t = np.random.default_rng(seed), 0.2 * np.arange(rows)
    u: FloatArray = np.repeat(random.normal(1.0, 0.4, rows // 30), 30)
    h, y = 1.0, np.empty(rows)
    for k in range(rows):
        y[k] = h
        for _ in range(20):
            h = min(h + 0.01 * slope(h, float(u[k])), highest)
    return Recording(t=t, u=u, y=y + 0.01 * random.normal(size=rows), name=f"rec{seed}.csv")


def test_a_tank_that_overflows_is_told_with_its_rim() -> None:
    found = diagnose(tank(), [recorded(i, lambda h, u: (u - h) / 5.0, 1.15) for i in (1, 2)])
    assert [(e.name, e.state) for e in found.effects] == [("plant.hard_stop", "h")]
    assert found.effects[0].parameters["high"].value == pytest.approx(1.15, abs=0.01)


def test_a_gain_that_falls_with_the_level_is_told_with_its_slope() -> None:
    recordings = [recorded(i, lambda h, u: (u * (1.0 - 0.25 * h) - h) / 5.0, 1e9) for i in (3, 4)]
    found = diagnose(tank(), recordings)
    assert [(e.name, e.input) for e in found.effects] == [("plant.position_dependent_gain", "u")]
    assert found.effects[0].parameters["slope"].value == pytest.approx(-0.25, rel=0.15)
