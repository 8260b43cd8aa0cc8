"""What a link's latency lets be measured."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.experiment.loop import Timing
from autotune.experiment.preflight import highest_frequency_rad_s
from autotune.experiment.rig import Reading
from autotune.experiment.run import run_experiment
from drivers.simulated import SimulatedRig
from sim.ball import make_ball
from tests.autotune.experiment.rigs import ball_config

NO_LATENCY = Timing(latency_s=(0.0, 0.0, 0.0), lateness_s=(0.0, 0.0, 0.0), missed=0, unusable=0)


def test_the_dead_time_that_a_latency_hides_is_a_phase_error_at_the_supported_frequency() -> None:
    slow = replace(NO_LATENCY, latency_s=(2e-3, 2e-3, 2e-3))
    omega = highest_frequency_rad_s(slow, 0.01, 0.004, exact=False)
    assert omega * 2e-3 == pytest.approx(0.004)
    assert highest_frequency_rad_s(replace(slow, latency_s=(2e-3, 8e-3, 9e-3)), 0.01, 0.004, exact=False) < omega
    assert highest_frequency_rad_s(slow, 0.01, 0.004, exact=True) > 10.0 * omega


@pytest.mark.parametrize("timing", [NO_LATENCY, replace(NO_LATENCY, latency_s=(math.nan, math.nan, math.nan))])
def test_without_latency_the_samples_of_a_period_are_the_limit(timing: Timing) -> None:
    assert highest_frequency_rad_s(timing, 0.01, 0.004, exact=False) == pytest.approx(2.0 * math.pi / 0.08)


class LateRig(SimulatedRig):
    """The ball behind a link that takes 3 ms to say what it has measured."""

    def read(self) -> Reading:
        return replace(super().read(), latency_s=3e-3)


def test_a_point_beyond_what_the_link_supports_is_warned_of(tmp_path: Path) -> None:
    config = ball_config(experiment={"points": 3})
    done = run_experiment(LateRig(make_ball(seed=1), u_safe=0.0), config, tmp_path / "r.csv")
    said = [warning for warning in done.warnings if "this link supports" in warning]
    supported = config.experiment.gain_sd / 3e-3
    assert len(said) == sum(point.omega_rad_s > supported for point in done.points) > 0
    assert f"{supported:.3g} rad/s" in said[0]
    assert "this link supports points up to" in (tmp_path / "r.csv").read_text()
