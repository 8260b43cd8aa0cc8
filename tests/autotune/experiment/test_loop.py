from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import ExperimentStopped, LinkError, OperatorStop
from autotune.experiment.limits import Watch
from autotune.experiment.loop import ControlLoop, Tick, Timing
from autotune.recording import read_recording
from tests.autotune.experiment.rigs import ball_config, ball_rig, open_loop
from tests.sim.imperfections import Fault


def go(loop: ControlLoop, *commands: float) -> None:
    """Send the commands as they are and leave."""
    with loop:
        for u in commands:
            loop.step(u)


def run(loop: ControlLoop, law: Callable[[Tick], float]) -> None:
    """Run a law until something ends it."""
    with loop:
        while True:
            loop.step(loop.nearest(law(loop.tick)))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return tmp_path / "recording.csv"


def test_a_row_holds_the_measurement_before_and_the_command_after_its_time(recording: Path) -> None:
    with open_loop(ball_rig(), recording) as loop:
        seen = [loop.tick]
        for u in (1.0, 2.0, 3.0):
            seen.append(loop.step(loop.nearest(u)))
    rows = read_recording(recording)
    assert rows.t == pytest.approx([tick.t_s for tick in seen])
    assert rows.y == pytest.approx([tick.y for tick in seen])
    assert rows.u == pytest.approx([1.0, 2.0, 3.0, 0.0], abs=0.002)  # the last row's command is the safe one


def test_a_sample_is_on_disk_before_its_command_is_sent(recording: Path) -> None:
    rows_at_write: list[int] = []
    rig = ball_rig()
    write = rig.write

    def look_and_write(u: float) -> None:
        rows_at_write.append(len(recording.read_text().splitlines()) - 1)
        write(u)

    rig.write = look_and_write  # type: ignore[method-assign]  # the real write, seen from outside
    with open_loop(rig, recording) as loop:
        for _ in range(5):
            loop.step(loop.nearest(1.0))
    assert rows_at_write == [1, 2, 3, 4, 5]


def test_the_end_of_the_block_makes_the_rig_safe_and_says_so(recording: Path) -> None:
    rig = ball_rig()
    with open_loop(rig, recording) as loop:
        loop.step(loop.nearest(1.5))
        assert rig.command == pytest.approx(1.5, abs=0.002)
    assert rig.command == 0.0
    assert read_recording(recording).metadata["ended"] == {
        "reason": "completed",
        "exit_status": 0,
        "output": "safe output",
    }


def test_a_command_outside_the_envelope_never_reaches_the_rig(recording: Path) -> None:
    rig = ball_rig()
    loop = open_loop(rig, recording)
    with pytest.raises(ExperimentStopped, match=r"limit reached: the command 10\.5"):
        go(loop, 1.0, 10.5)
    assert rig.command == 0.0
    assert "10.5" in read_recording(recording).metadata["ended"]["reason"]


def test_any_exception_in_the_law_leaves_the_rig_safe_and_passes_on(recording: Path) -> None:
    rig = ball_rig()
    loop = open_loop(rig, recording)
    with pytest.raises(ZeroDivisionError):
        run(loop, lambda tick: 3.0 if tick.k < 5 else 1 / 0)
    assert rig.command == 0.0
    assert read_recording(recording).metadata["ended"]["verdict"] == "ZeroDivisionError"


@pytest.mark.parametrize(("number", "name"), [(signal.SIGINT, "Ctrl-C"), (signal.SIGTERM, "SIGTERM")])
def test_signals_stop_the_loop_with_status_130(recording: Path, number: signal.Signals, name: str) -> None:
    rig = ball_rig()
    before = signal.getsignal(number)
    loop = open_loop(rig, recording)

    def law(tick: Tick) -> float:
        if tick.k == 3:
            os.kill(os.getpid(), number)
        return 3.0

    with pytest.raises(OperatorStop, match=name) as stop:
        run(loop, law)
    assert stop.value.exit_status == 130
    assert rig.command == 0.0
    assert signal.getsignal(number) is before
    assert len(read_recording(recording)) < 10


def test_a_cut_link_ends_in_a_link_error_and_a_readable_recording(recording: Path) -> None:
    rig = ball_rig(faults=[Fault(kind="cut link", start_s=0.5)])
    loop = open_loop(rig, recording)
    with pytest.raises(LinkError) as stop:
        run(loop, lambda tick: 3.0)
    assert stop.value.exit_status == 3
    rows = read_recording(recording)
    assert rows.t[-1] == pytest.approx(0.5)
    assert rows.u[-1] == 0.0


def test_a_device_that_does_not_confirm_the_safe_output_is_an_error_and_is_written_down(recording: Path) -> None:
    rig = ball_rig()

    def refuse() -> None:
        raise LinkError("no answer")

    rig.make_safe = refuse  # type: ignore[method-assign]  # a device that falls silent at the very end
    loop = open_loop(rig, recording)
    with pytest.raises(LinkError, match="could not be confirmed"):
        go(loop, 1.0)
    assert "dead-man" in read_recording(recording).metadata["ended"]["output"]


def test_a_few_bad_readings_are_ridden_through_on_the_last_good_one(recording: Path) -> None:
    with open_loop(ball_rig(faults=[Fault(kind="not a number", start_s=0.095, end_s=0.125)]), recording) as loop:
        ticks = [loop.step(loop.nearest(1.0)) for _ in range(20)]
    bad = [tick for tick in ticks if not tick.usable]
    assert len(bad) == 3
    assert all(np.isfinite(tick.y) for tick in ticks)
    assert np.isnan(read_recording(recording).y).sum() == 3
    assert loop.timing.unusable == 3


def test_limits_on_y_stop_the_loop_where_they_are_watched(recording: Path) -> None:
    loop = open_loop(ball_rig(), recording)
    go(loop, 0.0)  # on the floor, at 10 V, nothing is watched yet
    watched = open_loop(ball_rig(), recording.with_name("watched.csv"))
    watched.watch = Watch(in_range=True)
    with pytest.raises(ExperimentStopped, match="y_min"):
        go(watched, 0.0)


def test_the_time_on_the_rig_is_limited(recording: Path) -> None:
    loop = open_loop(ball_rig(), recording, ball_config(limits={"time_s": 1.0}))
    with pytest.raises(ExperimentStopped, match="time over"):
        run(loop, lambda tick: 0.0)
    assert read_recording(recording).t[-1] == pytest.approx(1.0, abs=0.011)


def test_a_computer_that_falls_far_behind_is_a_link_too_slow(recording: Path) -> None:
    rig = ball_rig()
    loop = open_loop(rig, recording)

    def law(tick: Tick) -> float:
        rig.clock.sleep_until(rig.clock.now() + 0.2)  # twenty samples pass while the law thinks
        return 1.0

    with pytest.raises(LinkError, match="link too slow"):
        run(loop, law)


def test_a_missed_sample_is_counted_and_the_grid_kept(recording: Path) -> None:
    rig = ball_rig()
    with open_loop(rig, recording) as loop:
        loop.step(loop.nearest(1.0))
        rig.clock.sleep_until(rig.clock.now() + 0.035)
        late = loop.step(loop.nearest(1.0))
        after = loop.step(loop.nearest(1.0))
    assert loop.timing.missed == 2
    assert late.t_s == pytest.approx(0.045)
    assert after.t_s == pytest.approx(0.05)


def test_a_virtual_clock_is_waited_on_once_per_sample(recording: Path) -> None:
    """At a sample a minute, slices of a tenth of a second made a simulated rig 600 times as slow."""
    rig, waits = ball_rig(), []
    sleep_until = rig.clock.sleep_until

    def look_and_sleep(t_s: float) -> None:
        waits.append(t_s)
        sleep_until(t_s)

    rig.clock.sleep_until = look_and_sleep  # type: ignore[method-assign]  # the real one, seen from outside
    config = ball_config(signals={"sample_time_s": 2.0})
    with open_loop(rig, recording, config) as loop:
        for _ in range(5):
            loop.step(loop.nearest(0.0))
    assert waits == pytest.approx([2.0, 4.0, 6.0, 8.0, 10.0])


def test_the_time_from_a_reading_to_its_command_is_kept(recording: Path) -> None:
    rig = ball_rig()
    write = rig.write

    def slow_write(u: float) -> None:
        rig.clock.sleep_until(rig.clock.now() + 0.003)
        write(u)

    rig.write = slow_write  # type: ignore[method-assign]  # the real write, on a line that takes 3 ms
    with open_loop(rig, recording) as loop:
        for _ in range(5):
            loop.step(loop.nearest(1.0))
    assert loop.timing.decision_s == pytest.approx((0.003, 0.003, 0.003))
    assert Timing.from_table(loop.timing.to_table()) == loop.timing
    assert loop.timing.missed == 0
