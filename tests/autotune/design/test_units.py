"""A controller is the same loop whatever the units and signs of command and reading are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

import autotune as at
from autotune.controller import PIDController
from autotune.design.kernels import sampled_plant
from autotune.design.noise import LoopFacts, default_noise_gain
from autotune.design.robust import design_on_points
from autotune.design.specification import spec1
from autotune.models import TransferFunction
from autotune.recording import Recording
from tests.autotune.design.plants import BALL, measured

T = 0.5 * np.arange(1200)


def levels() -> tuple[np.ndarray, np.ndarray]:
    """Return a command of random levels, and what two lags and a dead time make of it."""
    rng = np.random.default_rng(3)
    u = 5.0 + 0.7 * np.repeat(rng.choice([-1.0, 1.0], 60), 20)
    x = lfilter([0.05], [1.0, -0.95], np.concatenate([np.zeros(5), u[:-5] - 5.0]))
    return u, 20.0 + 3.0 * lfilter([0.1], [1.0, -0.9], x) + 0.02 * rng.standard_normal(T.size)


def step() -> tuple[np.ndarray, np.ndarray]:
    """Return one step, and what a lag and a dead time make of it."""
    u = np.where(T < 50.0, 5.0, 6.0)
    x = lfilter([0.02], [1.0, -0.98], np.concatenate([np.zeros(8), u[:-8] - 5.0]))
    return u, 20.0 + 3.0 * x + 0.02 * np.random.default_rng(4).standard_normal(T.size)


def tuned(u: np.ndarray, y: np.ndarray) -> PIDController:
    found = at.tune(Recording(t=T, u=u, y=y, name="test")).controller
    assert isinstance(found, PIDController)
    return found


@pytest.mark.parametrize("recorded", [levels, step])
@pytest.mark.parametrize(("of_u", "of_y"), [(1.0, -2.5), (-4.0, 1e-4)])
def test_a_recording_in_other_units_gives_the_same_loop(recorded, of_u: float, of_y: float) -> None:
    u, y = recorded()
    here, there = tuned(u, y), tuned(of_u * u, of_y * y)
    # along a constraint the error is flat: gains are known to a few parts in 1e5
    assert there.K * of_y / of_u == pytest.approx(here.K, rel=2e-4)
    assert there.Ti_s == pytest.approx(here.Ti_s, rel=2e-4)


@given(
    gain=st.floats(1e-12, 1e12), sign=st.sampled_from((-1.0, 1.0)), lag=st.floats(0.01, 1e3),
    delay=st.sampled_from((0.0, 2.0)), level=st.booleans(),
)  # fmt: skip
@settings(max_examples=80)
def test_a_plants_frequencies_and_its_noise_gain_follow_its_units(
    gain: float, sign: float, lag: float, delay: float, level: bool
) -> None:
    """A level over a valve in pascal moves by 1e-12 m per Pa: its dead time stays what it is."""
    den = (1.0, 0.0) if level and delay else (lag, 1.0)
    one = TransferFunction(num=(2.0,), den=den, delay_s=delay)
    other = TransferFunction(num=(2.0 * sign * gain,), den=den, delay_s=delay)
    np.testing.assert_allclose(sampled_plant(other, 50.0 / gain).omega, sampled_plant(one, 50.0).omega, rtol=1e-9)
    most = default_noise_gain(one, LoopFacts())[0]
    assert default_noise_gain(other, LoopFacts())[0] * gain == pytest.approx(most, rel=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_design_on_points_does_not_hang_on_their_last_digit(seed: int) -> None:
    """A guarantee that makes steps as the gain grows has corners in which a search ends, elsewhere for each digit."""

    def gains(factor: float) -> tuple[float, float]:
        points = [replace(p, response=p.response * factor) for p in measured(BALL, seed)]
        found = design_on_points(points, spec1(0.5)).controller
        return found.K * factor, found.Ti_s

    here = gains(1.0)
    for factor in (1.0 + 1e-12, 1.0 - 3e-12, 1.0 + 2e-11):
        assert gains(factor) == pytest.approx(here, rel=2e-5)
