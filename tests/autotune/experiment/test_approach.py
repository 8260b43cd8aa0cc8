"""On the way to the operating point y keeps its limits, and every exit leaves the rig at its safe output."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.config import Config, load_config
from autotune.errors import AutotuneError, ExperimentStopped, LinkError, OperatorStop
from autotune.experiment.loop import ABORT
from autotune.experiment.result import State, Status
from autotune.experiment.rig import Reading
from autotune.experiment.run import bring_to_operating_point, run_experiment
from autotune.recording import read_recording
from drivers.simulated import SimulatedRig
from sim.ball import make_ball
from sim.plant import Plant
from sim.tank import make_two_tank
from tests.autotune.experiment.rigs import CONFIG, U_REST, ball_config, open_loop, textbook_plant

TANKS = CONFIG.with_name("two_tank_sim.toml")


class WatchedRig(SimulatedRig):
    """A rig that does not say what it applies, and whose plant's true y is kept as long as a session lasts."""

    def __init__(self, plant: Plant, *, u_safe: float) -> None:
        super().__init__(plant, u_safe=u_safe)
        self.went: list[float] = []

    def read(self) -> Reading:
        """Take one sample."""
        self.went.append(self.plant.y_true)
        return replace(super().read(), u_applied=math.nan)

    def farthest(self, y: float) -> float:
        """Return how far y was from a value at most [y unit]."""
        return max(abs(one - y) for one in self.went)


def commission(rig: SimulatedRig, config: Config, folder: Path) -> str:
    """Bring a rig to its operating point; return what ended that, nothing where it is there."""
    try:
        with open_loop(rig, folder / "recording.csv", config) as loop:
            bring_to_operating_point(loop, config)
    except AutotuneError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("seed", range(6))
def test_tanks_whose_command_was_guessed_wrongly_keep_their_swing(seed: int, tmp_path: Path) -> None:
    """The pump's gain is up to a tenth off, so that u_guess alone would lead y up to 3.8 cm away; 2 are allowed."""
    config = load_config(TANKS)
    rig = WatchedRig(make_two_tank(seed=seed, start="level"), u_safe=0.0)
    assert commission(rig, config, tmp_path) == ""
    assert rig.farthest(config.operating_point.y) <= config.limits.swing


def textbook(written: str, *, time_s: float, gain: float, off: float) -> tuple[WatchedRig, Config]:
    """Return a plant at rest at its operating point, and a configuration that ``init`` could have written of it."""
    swing = 1.25 * gain
    far = 4.0 * swing
    plant = textbook_plant(written, u_start=U_REST, noise=0.01 * swing)
    config = ball_config(
        signals={"sample_time_s": time_s / 40.0, "u_step": 0.0},
        limits={"u_safe": U_REST, "y_min": -far, "y_max": far, "swing": swing, "time_s": 1000.0 * time_s},
        operating_point={"y": 0.0, "u_guess": U_REST + off, "u_uncertainty": 0.5, "approach": "hold", "plant_sign": 0},
    )  # fmt: skip
    return WatchedRig(plant, u_safe=U_REST), config


@pytest.mark.parametrize("off", [-0.5, 0.0, 0.5])
@pytest.mark.parametrize(
    ("written", "time_s", "gain"),
    [
        ("5/(10s+1) e^-1s", 11.0, 5.0),
        ("-3/(20s+1) e^-4s", 24.0, 3.0),
        ("2/(s(0.3s+1))", 0.3, 2.4),
        ("0.001/s e^-60s", 60.0, 0.24),
        ("2(1-0.5s)/((2s+1)(s+1))", 3.5, 2.0),
        ("0.05/((3600s+1)(300s+1))", 3900.0, 0.05),
    ],
    ids=["lag", "falling", "integrating", "integrating, dead time", "inverse response", "slow"],
)
def test_a_plant_that_u_guess_does_not_hold_is_brought_back_within_the_swing(
    written: str, time_s: float, gain: float, off: float, tmp_path: Path
) -> None:
    rig, config = textbook(written, time_s=time_s, gain=gain, off=off)
    assert commission(rig, config, tmp_path) == ""
    assert rig.farthest(0.0) <= config.limits.swing


@pytest.mark.parametrize("off", [-3.0, 3.0])
@pytest.mark.parametrize(("written", "time_s", "gain"), [("2/(s(0.3s+1))", 0.3, 2.4), ("5/(10s+1) e^-1s", 11.0, 5.0)])
def test_a_guess_far_off_ends_at_the_swing_and_is_named(
    written: str, time_s: float, gain: float, off: float, tmp_path: Path
) -> None:
    rig, config = textbook(written, time_s=time_s, gain=gain, off=off)
    said = commission(rig, config, tmp_path)
    assert "limits.swing" in said
    assert "operating_point.u_guess" in said
    assert rig.command == U_REST
    # judged by the median of five readings, so two samples late
    assert rig.farthest(0.0) <= 1.25 * config.limits.swing


def test_a_rig_that_says_what_it_applies_is_begun_with_where_it_is(tmp_path: Path) -> None:
    config, plant = load_config(TANKS), make_two_tank(seed=2, start="level")
    held = plant.u_applied
    assert abs(held - config.operating_point.u_guess) > 0.1
    with open_loop(SimulatedRig(plant, u_safe=0.0), tmp_path / "recording.csv", config) as loop:
        bring_to_operating_point(loop, config)
    np.testing.assert_allclose(read_recording(tmp_path / "recording.csv").u[:60], held)


def cut(rig: StruckRig) -> None:
    """Cut the link for good."""
    rig.is_cut = True


def fail(rig: StruckRig) -> None:
    """Fail as a defect of a driver does."""
    raise ZeroDivisionError("a defect")


#: what strikes while the operating point is approached, what ends the session then, and what its line says
STRIKES: dict[str, tuple[Callable[[StruckRig], None], type[BaseException], str]] = {
    "Ctrl-C": (lambda rig: signal.raise_signal(signal.SIGINT), OperatorStop, "stopped by Ctrl-C"),
    "SIGTERM": (lambda rig: signal.raise_signal(signal.SIGTERM), OperatorStop, "stopped by SIGTERM"),
    "Abort": (lambda rig: signal.raise_signal(ABORT), OperatorStop, "stopped by Abort"),
    "dead link": (cut, LinkError, "Go to the rig: its safe output was not confirmed"),
    "defect": (fail, ZeroDivisionError, "a defect"),
    "y beyond its limits": (lambda rig: rig.jam(100.0), ExperimentStopped, "y"),
    "not a number": (lambda rig: rig.jam(math.nan), ExperimentStopped, "not a number"),
}


class StruckRig(SimulatedRig):
    """A rig that something strikes so many commands after a state was entered."""

    def __init__(self, plant: Plant, state: State, strike: Callable[[StruckRig], None], commands: int = 20) -> None:
        super().__init__(plant, u_safe=0.0)
        self.is_cut = False
        self.made_safe = 0
        self._state, self._strike, self._left, self._seen = state, strike, commands, State.CONNECT
        self._jammed: float | None = None

    def watch(self, status: Status) -> None:
        """Look at the progress bar."""
        self._seen = status.state

    def jam(self, y: float) -> None:
        """Have the sensor say something else from now on [y unit]."""
        self._jammed = y

    def read(self) -> Reading:
        """Take one sample."""
        self._require_link()
        reading = super().read()
        return reading if self._jammed is None else replace(reading, y=self._jammed)

    def write(self, u: float) -> None:
        """Hold ``u`` [u unit] from now on."""
        self._require_link()
        super().write(u)
        if self._seen == self._state:
            self._left -= 1
            if self._left == 0:
                self._strike(self)

    def make_safe(self) -> None:
        """Hold the safe output."""
        self.made_safe += 1
        self._require_link()
        super().make_safe()

    def _require_link(self) -> None:
        if self.is_cut:
            raise LinkError("link cut", where="simulated rig", remedy="look at the cable")


@pytest.mark.parametrize("state", [State.PREFLIGHT, State.APPROACH, State.MIDPOINT])
@pytest.mark.parametrize("approach", ["hold", "ramp"])
@pytest.mark.parametrize("struck", STRIKES)
def test_every_exit_of_the_approach_asks_for_the_safe_output(
    struck: str, approach: str, state: State, tmp_path: Path
) -> None:
    strike, kind, said = STRIKES[struck]
    held = approach == "hold"
    config = load_config(TANKS) if held else ball_config()
    rig = StruckRig(make_two_tank(seed=1, start="level") if held else make_ball(seed=1), state, strike)
    with pytest.raises(kind, match=said):
        run_experiment(rig, config, tmp_path / "recording.csv", on_status=rig.watch)
    assert rig.made_safe == 1
    recording = read_recording(tmp_path / "recording.csv")
    ended = recording.metadata["ended"]
    if struck == "dead link":  # the device's own dead-man timer has to act, and a person is told
        assert "not confirmed" in ended["output"]
        return
    assert rig.command == config.limits.u_safe
    assert recording.u[-1] == config.limits.u_safe
    assert ended["output"] == "safe output"
    assert ended["exit_status"] == {OperatorStop: 130, ZeroDivisionError: 1}.get(kind, 3)
