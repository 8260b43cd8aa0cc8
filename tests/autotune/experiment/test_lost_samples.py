"""Samples that the computer or the link loses: delay, periods and windows count time, not rows."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import LinkError
from autotune.experiment.relay import RelaySettings, RelayState, relay_step
from autotune.experiment.result import ExperimentResult, Status
from autotune.experiment.rig import Reading
from autotune.experiment.run import run_experiment
from autotune.recording import read_recording
from drivers.simulated import SimulatedRig
from sim.plant import make_plant
from tests.autotune.experiment.rigs import EACH, ball_config
from tests.sim.imperfections import Fault, FaultyPlant


class BusyComputer(SimulatedRig):
    """A rig whose host is held up before a share of its samples, by two or three sample times."""

    def __init__(self, share: float, *, seed: int = 3) -> None:
        super().__init__(make_plant("ball", seed=1), u_safe=0.0)
        self.share = share
        self._random = random.Random(seed)

    def read(self) -> Reading:
        reading = replace(super().read(), u_applied=math.nan)
        # the loop is behind when it comes to wait for its next sample
        if self._random.random() < self.share:
            self.clock.sleep_until(self.clock.now() + 0.01 * self._random.choice((2.4, 3.3)))
        return reading


def swept(folder: Path, share: float) -> ExperimentResult:
    return run_experiment(BusyComputer(share), ball_config(**EACH), folder / f"{share:g}.csv")


def test_forty_percent_of_lost_samples_do_not_stretch_the_relays_delay(tmp_path: Path) -> None:
    lost = swept(tmp_path, 0.5)
    whole = swept(tmp_path, 0.0)
    rows = len(read_recording(tmp_path / "0.5.csv"))
    assert lost.timing.missed / (rows + lost.timing.missed) > 0.4
    assert whole.timing.missed == 0
    truth = make_plant("ball", seed=1)
    for mine, other in zip(lost.points, whole.points, strict=True):
        # the same phases are hit, but for the lag of fewer samples, and the points lie on the plant
        assert abs(np.angle(mine.response / other.response)) < math.radians(6.0)
        expected = truth.response(np.array([mine.omega_rad_s]))[0]
        assert abs(mine.response - expected) < 5.0 * math.sqrt(float(np.trace(mine.covariance))) + 0.02 * abs(expected)
    assert any("missed" in warning for warning in lost.warnings)
    assert not any("missed" in warning for warning in whole.warnings)


def test_a_delay_is_as_long_over_missed_samples_as_over_whole_ones() -> None:
    settings = RelaySettings(y_centre=0.0, midpoint=0.0, amplitude=1.0, delay_samples=6.0)
    whole, gappy = RelayState(), RelayState()
    y = np.where(np.arange(60) % 24 < 12, -1.0, 1.0)
    commands = []
    for value in y:
        whole, u = relay_step(whole, settings, float(value))
        commands.append(u)
    for k in range(0, 60, 3):  # two of three samples are missed
        gappy, u = relay_step(gappy, settings, float(y[k]), slots=3 if k else 1)
        assert u == commands[k]


def test_an_average_looks_back_over_time_and_not_over_rows() -> None:
    settings = RelaySettings(y_centre=0.0, midpoint=0.0, amplitude=1.0, smoothing=4)
    state, _ = relay_step(RelayState(), settings, -1.0)
    state, u = relay_step(state, settings, 0.1, slots=4)  # the first reading is too old to count
    assert u == -1.0
    assert [number for number, _ in state.recent] == [4]


def test_a_swing_that_is_left_while_samples_are_lost_is_the_links_and_not_the_actuators(tmp_path: Path) -> None:
    rig = BusyComputer(0.0)

    def fall_asleep(progress: Status) -> None:
        if progress.message.startswith("point 2"):
            rig.share = 1.0

    rig.plant = FaultyPlant(rig.plant, [Fault(kind="inverted actuator", start_s=45.0, value=5.0)])
    with pytest.raises(LinkError, match=r"link too slow: \d+ % of the latest samples were missed, and y"):
        run_experiment(rig, ball_config(**EACH), tmp_path / "asleep.csv", on_status=fall_asleep)


class StalledNowAndThen(BusyComputer):
    """A rig whose host is held up for .14 s, as long as the loop may be late, once in 1.3 s."""

    is_armed = False
    last_s = 0.0

    def read(self) -> Reading:
        reading = super().read()
        if self.is_armed and self.clock.now() - self.last_s > 1.3:
            self.last_s = self.clock.now()
            self.clock.sleep_until(self.clock.now() + 0.14)
        return reading


def test_late_samples_that_lead_y_out_of_its_swing_are_the_links_and_not_the_actuators(tmp_path: Path) -> None:
    rig = StalledNowAndThen(0.0)

    def arm(progress: Status) -> None:
        rig.is_armed = progress.message.startswith("point")

    with pytest.raises(LinkError, match=r"link too slow: a sample came 0\.1\d* s late, and y = .* left the swing"):
        run_experiment(rig, ball_config(**EACH), tmp_path / "stalled.csv", on_status=arm)
