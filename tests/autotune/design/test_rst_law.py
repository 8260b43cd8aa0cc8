"""The RST law as it runs: its static gains, bumpless start, anti-windup, and the response of the loop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from autotune.design.margins import margins
from autotune.design.rst import RST, comparison_rst
from autotune.design.rst_law import RSTLaw
from autotune.errors import DesignError, InputError
from sim.ball import linear_ball
from tests.autotune.design.plants import BALL

LAW = RSTLaw(controller=comparison_rst(BALL), sample_time_s=0.01)


def _closed_loop(law: RSTLaw, load: float, step: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    ball = linear_ball()
    state = law.initial(ball.u_applied, 5.0, 5.0)
    y, commands = [], []
    for _ in range(round(seconds / law.sample_time_s)):
        y.append(ball.measure() - 5.0)
        u, state = law.step(state, 5.0 + step, y[-1] + 5.0)
        commands.append(u)
        ball.advance(u + load, law.sample_time_s)
    return np.array(y), np.array(commands)


def test_law_between_its_limits_is_the_difference_equation_of_r_and_y() -> None:
    rng = np.random.default_rng(3)
    r, y = rng.normal(size=(2, 60))
    state = LAW.initial(0.0, 0.0, 0.0)
    commands = []
    for k in range(60):
        u, state = LAW.step(state, float(r[k]), float(y[k]))
        commands.append(u)
    R, S, T = LAW.coefficients
    assert np.array(commands) == pytest.approx(lfilter(T, S, r) - lfilter(R, S, y), rel=1e-7, abs=1e-12)


def test_tustin_keeps_the_margins_but_for_the_hold() -> None:
    continuous, sampled = margins(BALL, LAW.controller.feedback()), margins(BALL, LAW.discrete())
    # the hold delays by half a sample
    lost = math.degrees(0.5 * LAW.sample_time_s * continuous.crossover_rad_s)
    assert math.degrees(continuous.phase_rad - sampled.phase_rad) == pytest.approx(lost, rel=0.02)
    assert sampled.h2 == pytest.approx(continuous.h2, rel=5e-3)


def test_rest_stays_rest() -> None:
    y, u = _closed_loop(LAW, 0.0, 0.0, 2.0)
    assert np.abs(y).max() < 1e-6
    assert u == pytest.approx(5.0, abs=1e-8)


def test_loop_follows_a_step_without_error_and_rejects_a_load_with_the_norm_of_its_margins() -> None:
    y, _ = _closed_loop(LAW, 0.0, 1.0, 15.0)
    assert y[-1] == pytest.approx(1.0, abs=1e-4)
    y, _ = _closed_loop(LAW, 0.05, 0.0, 20.0)
    norm = math.sqrt(LAW.sample_time_s * float(np.sum(y**2))) / 0.05
    assert norm == pytest.approx(margins(BALL, LAW.discrete()).h2, rel=0.01)


def test_limited_command_does_not_wind_up() -> None:
    narrow = replace(LAW, u_min=4.98, u_max=5.02)
    y, u = _closed_loop(narrow, 0.0, 4.0, 20.0)
    assert u.min() == pytest.approx(4.98)  # the step is large enough to be limited
    assert y.max() < 4.0 * 1.03
    assert y[-1] == pytest.approx(4.0, abs=1e-3)
    wound_up, _ = _closed_loop(replace(narrow, tracking_time_s=1e6), 0.0, 4.0, 20.0)
    assert wound_up.max() > 4.0 * 1.15


def test_a_placed_controller_becomes_the_law_that_runs() -> None:
    law = LAW.controller.law(0.01, u_min=4.0, u_max=6.0)
    assert law == replace(LAW, u_min=4.0, u_max=6.0)
    assert law.to_json()["R"] == pytest.approx(LAW.coefficients[0])


@pytest.mark.parametrize("wrong", [{"sample_time_s": 0.0}, {"u_min": 1.0, "u_max": 0.0}])
def test_settings_that_make_no_law_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        replace(LAW, **wrong)


@pytest.mark.parametrize(
    ("R", "S", "reason"),
    [
        ((1.0, 1.0), (1.0, 1.0), "root of S at 0"),
        ((1.0, 1.0, 1.0), (1.0, 0.0), "proper"),
        ((1.0, 1.0), (1.0, 0.0, 0.0), "second root"),
        ((1.0, 1.0), (1.0, -1.0, 0.0), "right half plane"),
        ((1.0,), (1.0, 0.0), "tracking time"),
    ],
)
def test_controllers_that_cannot_run_are_refused(R: tuple[float, ...], S: tuple[float, ...], reason: str) -> None:
    with pytest.raises(DesignError, match=reason):
        RSTLaw(controller=RST(R=R, S=S, T=(R[-1],)), sample_time_s=0.01)
