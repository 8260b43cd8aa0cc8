"""Another master that writes the command now and then: found, told with its times, and kept out of every point."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.config import Config
from autotune.controller import PIDController
from autotune.errors import AutotuneError, ExperimentStopped, LinkError
from autotune.experiment.foreign import CommandWatch
from autotune.experiment.judgement import Verification
from autotune.experiment.result import ExperimentResult
from autotune.experiment.rig import Reading, TrialGains
from autotune.experiment.run import run_experiment
from autotune.experiment.verify import run_verification
from autotune.pipeline.deployment import deploy
from autotune.recording import read_recording
from drivers.register_link import Answer
from drivers.registers import Block
from sim.plant import make_plant
from tests.autotune.experiment.test_verify import CONFIG as BALL
from tests.autotune.experiment.test_verify import FIT as BALL_FIT
from tests.autotune.experiment.test_verify import PI
from tests.drivers.test_own_controller import REGISTERS
from tests.drivers.virtual_device import DirectLink, virtual_rig

#: what the other master writes: 1.0
ONE = [0x3F80, 0]


class WriteOnly(DirectLink):
    """A device that takes commands and does not show them."""

    def read(self, block: Block) -> Answer:
        if (block.table, block.address) == ("holding", 0):
            raise LinkError("does not have that address", where=self.where)
        return super().read(block)


def disturbed_rig(
    times_s: Sequence[float],
    *,
    without: tuple[str, ...] = (),
    shows_command: bool = True,
    written: tuple[str, int, list[int]] = ("holding", 0, ONE),
) -> Any:
    """Return a rig of the ball into which another master writes at these times, 1 V where nothing is said."""
    registers = {name: given for name, given in REGISTERS.items() if name not in without}
    rig, device = virtual_rig(make_plant("ball", seed=1, noise=0.1), registers=registers, gains=(-0.01, 6.0))
    left, clock = list(times_s), rig.clock
    if not shows_command:
        rig._link = WriteOnly(device, clock)  # type: ignore[arg-type]  # it is a virtual one
    sleep = clock.sleep_until

    def sleep_until(t_s: float) -> None:
        while left and left[0] <= t_s:
            sleep(left.pop(0))
            if device.by_host or device.value["automatic"]:
                device.write(*written, clock.now())
        sleep(t_s)

    clock.sleep_until = sleep_until  # type: ignore[method-assign]  # whoever waits lives through it
    return rig


def commanding(times_s: Sequence[float]) -> tuple[AutotuneError | None, list[Reading]]:
    """Command 4 V for ten seconds; return the error that ended it, if any, and the readings."""
    rig, readings = disturbed_rig(times_s), []
    rig.open()
    start_s = rig.clock.now()
    try:
        while rig.clock.now() - start_s < 10.0:
            rig.write(4.0)
            rig.clock.sleep_until(rig.clock.now() + 0.01)
            readings.append(rig.read())
    except LinkError as error:
        return error, readings
    return None, readings


def swept(rig: Any, folder: Path, points: int = 3) -> ExperimentResult:
    wanted = BALL.experiment.model_copy(update={"points": points, "budget_s": 30.0})
    config: Config = BALL.model_copy(update={"experiment": wanted})
    return run_experiment(rig, config, folder / "sweep.csv")


def test_a_master_that_writes_five_times_a_second_ends_the_session_and_its_times_are_told() -> None:
    error, readings = commanding([0.5 + 0.2 * k for k in range(50)])
    assert error is not None
    assert re.search(r"another master writes the command: its register held 1 at [\d.]+ s, 1 at [\d.]+ s", str(error))
    assert len(readings) < 200


def test_one_foreign_command_is_told_by_the_sample_after_it() -> None:
    error, readings = commanding([3.0])
    assert error is None
    (found,) = [one for one in readings if math.isfinite(one.foreign_u)]
    assert found.foreign_u == 1.0
    assert found.t_s == pytest.approx(3.0, abs=0.05)
    assert found.suspect


def test_alone_nothing_is_said_of_another_master() -> None:
    error, readings = commanding(())
    assert error is None
    assert not any(one.suspect or math.isfinite(one.foreign_u) for one in readings)


@pytest.mark.parametrize(
    ("without", "shows_command"), [((), True), (("u_applied",), True), ((), False)], ids=["both", "u", "u_applied"]
)
def test_a_foreign_command_during_the_sweep_is_in_no_point_and_said_with_its_time(
    tmp_path: Path, without: tuple[str, ...], shows_command: bool
) -> None:
    rig = disturbed_rig((), without=without, shows_command=shows_command)
    alone = swept(rig, tmp_path)
    assert not any("another master" in said for said in alone.warnings)
    when_s = 0.5 * (alone.segments[1].start_s + alone.segments[1].end_s)
    other = tmp_path / "other"
    other.mkdir()
    found = swept(disturbed_rig([when_s], without=without, shows_command=shows_command), other)
    (said,) = (one for one in found.warnings if "another master" in one)
    told = re.search(r"another master wrote the command: it was 1 at ([\d.]+) s where [\d.]+ was commanded", said)
    assert told is not None
    assert float(told[1]) == pytest.approx(when_s, abs=0.5)
    assert not any(one.start_s <= float(told[1]) <= one.end_s for one in found.segments)
    assert read_recording(other / "sweep.csv").metadata["foreign_commands"] == [said]
    for one, point in zip(found.points, alone.points, strict=True):
        assert abs(one.response) == pytest.approx(abs(point.response), rel=0.05)


@pytest.mark.parametrize("shows_command", [True, False], ids=["u", "u_applied"])
def test_five_foreign_commands_a_second_end_a_sweep(tmp_path: Path, shows_command: bool) -> None:
    # not a whole number of samples apart: right before the next command of the session it would act for no time
    rig = disturbed_rig([25.0 + 0.2037 * k for k in range(1000)], shows_command=shows_command)
    with pytest.raises(
        (ExperimentStopped, LinkError), match=r"another master writes the command: i.* 1 at 2"
    ) as caught:
        swept(rig, tmp_path)
    assert "end the other session; only one master may command" in str(caught.value)


def test_a_verification_that_another_master_disturbed_judges_no_gains(tmp_path: Path) -> None:
    run_verification(disturbed_rig(()), BALL, PI, BALL_FIT, tmp_path / "alone.csv")
    recording = read_recording(tmp_path / "alone.csv")
    when_s = recording.metadata["test_start_s"] + 3.0
    with pytest.raises(ExperimentStopped, match="another master writes the command: it was 1 at"):
        run_verification(disturbed_rig([when_s]), BALL, PI, BALL_FIT, tmp_path / "disturbed.csv")


def trial_disturbed(written: tuple[str, int, list[int]], after_s: float, folder: Path) -> tuple[str, Any]:
    """Hand gains over, with another master that writes so long after their trial begins; return what was said."""

    def handed_over(times_s: Sequence[float], place: Path) -> tuple[str, Any]:
        rig = disturbed_rig(times_s, written=written)

        def trial(held: PIDController, gains: TrialGains | None) -> Verification:
            return run_verification(rig, BALL, held, BALL_FIT, place / "trial.csv", gains=gains)

        try:
            done = deploy(rig, PI, place / "journal.jsonl", agree=lambda *_: None, try_out=trial)
        except AutotuneError as error:
            return str(error), rig
        return "kept" if done.kept else "not kept", rig

    for name in ("alone", "disturbed"):
        (folder / name).mkdir()
    assert handed_over((), folder / "alone")[0] == "kept"
    recording = read_recording(folder / "alone" / "trial.csv")
    start_s, end_s = recording.metadata["test_start_s"], float(recording.t[-1])
    return handed_over([start_s + after_s if after_s > 0.0 else end_s + after_s], folder / "disturbed")


@pytest.mark.parametrize(
    ("written", "after_s", "said"),
    [
        (("holding", 14, [5200]), 2.0, "another master writes setpoint.*holds 5.2 at"),
        # right before the trial ends, when no response shows it any more
        (("holding", 14, [5200]), -0.02, "another master writes setpoint.*holds 5.2 at"),
        (("holding", 16, ONE), 2.0, "another master writes load.*holds 1 at"),
        (("coil", 1, [0]), 2.0, "another master writes automatic.*holds 0 at"),
        (("holding", 10, [0, 0xBF80]), -0.02, "the rig holds K = -1,.* after the trial where K = "),
    ],
    ids=["set-point", "set-point at the end", "load", "automatic", "gains at the end"],
)
def test_a_trial_in_which_another_master_asks_for_something_else_keeps_no_gains(
    tmp_path: Path, written: tuple[str, int, list[int]], after_s: float, said: str
) -> None:
    found, rig = trial_disturbed(written, after_s, tmp_path)
    assert re.search(said, found), found
    assert "the old gains are in place again" in found
    held = rig.read_gains()
    assert (held.K, held.Ti_s) == (pytest.approx(-0.01), pytest.approx(6.0))
    assert rig._link._device.output == BALL.limits.u_safe


def test_a_set_point_that_follows_y_in_manual_is_asked_for_once_more_and_is_no_other_master(tmp_path: Path) -> None:
    rig, device = virtual_rig(make_plant("ball", seed=1, noise=0.1), registers=REGISTERS, gains=(-0.01, 6.0))
    clock, scan_s, in_manual_s = rig.clock, 0.02, [0.0]
    sleep, y_followed = clock.sleep_until, []

    def sleep_until(t_s: float) -> None:
        sleep(t_s)
        if not device.value["automatic"]:
            in_manual_s[0] = clock.now()
        if clock.now() - in_manual_s[0] < scan_s:  # the program has not seen yet that it is in automatic
            y_followed.append(device.plant.measure())
            device.show("setpoint", y_followed[-1])

    clock.sleep_until = sleep_until  # type: ignore[method-assign]  # whoever waits lives through it

    def trial(held: PIDController, gains: TrialGains | None) -> Verification:
        return run_verification(rig, BALL, held, BALL_FIT, tmp_path / "trial.csv", gains=gains)

    done = deploy(rig, PI, tmp_path / "journal.jsonl", agree=lambda *_: None, try_out=trial)
    assert np.std(y_followed) > 0.1
    assert done.kept


def seen(u: Sequence[float], shown: Sequence[float], tolerance: float = 0.2) -> list[float]:
    """Return the foreign outputs that are told of commands and outputs every 10 ms."""
    watch = CommandWatch()
    watch.ridden_through = 10**9
    for k, (command, output) in enumerate(zip(u, shown, strict=True)):
        watch.look(Reading(t_s=0.01 * k, y=0.0, u_applied=output), command, tolerance)
    return [one.u for one in watch.found]


RELAY = np.repeat(np.tile([3.0, 7.0], 20), 15)


def test_an_actuator_that_is_late_slow_or_noisy_is_no_second_master() -> None:
    rng = np.random.default_rng(1)
    late = np.concatenate([np.full(4, 3.0), RELAY[:-4]])
    slow = [3.0]
    for command in RELAY[1:]:
        slow.append(slow[-1] + min(max(command - slow[-1], -0.3), 0.3))
    noisy = RELAY + 0.1 * rng.standard_normal(RELAY.size)
    pulses = np.where(rng.random(600) < 0.5, 3.0, 7.0)
    for u, shown in (
        (RELAY, late),
        (RELAY, slow),
        (RELAY, noisy),
        (pulses, np.concatenate([pulses[:1].repeat(3), pulses[:-3]])),
    ):
        assert seen(u, shown) == []


@pytest.mark.parametrize("foreign", [0.0, 1.0, 9.0])
def test_every_output_beyond_the_commands_is_told(foreign: float) -> None:
    shown = RELAY.copy()
    shown[50:400:37] = foreign
    assert seen(RELAY, shown) == [foreign] * len(range(50, 400, 37))
