"""Relay and PI on the executed microcontroller, set and followed by the host, in virtual time."""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.config import Config, load_config
from autotune.controller import PIDController
from autotune.errors import ExperimentStopped, LinkError
from autotune.experiment.device import DeviceOscillation, in_ticks, try_on_device
from autotune.experiment.limits import Watch
from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import Oscillation
from autotune.experiment.relay import RelaySettings
from autotune.experiment.rig import RunsLaws
from autotune.experiment.run import envelope_of
from autotune.identification.frequency.limit_cycle_points import limit_cycle_points
from autotune.recording import RecordingWriter, read_recording
from drivers.device_rig import DeviceLawRig
from drivers.line_protocol import Command, Decoder, Frame, Kind
from tests.drivers.simavr_bench import BallBehind, Uno, twin_ball, virtual_rig

pytestmark = pytest.mark.system("gcc", "gcc-avr", "avr-libc", "libsimavr-dev", "libelf-dev")
CONFIGS = Path(__file__).parents[2] / "configs"
GAINS = PIDController(K=-0.025, Ti_s=3.6)


class Bench:
    """The quiet ball afloat behind an Uno, and the loop on it."""

    def __init__(self, elf: Path, folder: Path, **changes: object) -> None:
        given = load_config(CONFIGS / "ball_serial.toml")
        twin = given.rig.twin.model_copy(update={"noise": 0.02})  # type: ignore[union-attr]  # a serial rig's
        rig = given.rig.model_copy(update={"twin": twin, "relay": "device"} | changes)
        limits = given.limits.model_copy(update={"u_rate": 600.0})  # the first command takes it to its hover at once
        self.config: Config = given.model_copy(update={"rig": rig, "limits": limits})
        self.ball: BallBehind = twin_ball(self.config, "afloat")
        hover = round(1600 * self.ball.ball.u_rest)
        self.uno = Uno(elf, elf.parent, lambda count: self.ball(count or hover))  # somebody holds it until a host comes
        self.rig = virtual_rig(self.uno, self.config)
        self.path = folder / "recording.csv"
        writer = RecordingWriter(self.path, ("t", "u", "y", "r"))
        self.loop = ControlLoop(rig=self.rig, envelope=envelope_of(self.config), writer=writer, extra=("r",))

    def oscillation(self, **changes: object) -> DeviceOscillation:
        given = {"midpoint": self.ball.ball.u_rest, "amplitude": 0.2, "hysteresis": 0.02, "delay_samples": 8.25}
        settings = RelaySettings(y_centre=5.0, plant_sign=-1, smoothing=10, **(given | changes))  # type: ignore[arg-type]
        self.loop.watch = Watch(y_centre=5.0, in_range=True)
        before = Oscillation(self.loop, settings, patience_s=5.0)
        assert isinstance(self.rig, DeviceLawRig)
        return DeviceOscillation(self.rig, before)


def test_a_limit_cycle_on_the_device_is_the_plants_response_to_the_last_tick(uno_elf: Path, tmp_path: Path) -> None:
    bench = Bench(uno_elf, tmp_path)
    with bench.loop as loop:
        oscillation = bench.oscillation()
        while len(oscillation.edges) < 8:
            oscillation.step()
        t, u, y = loop.history(oscillation.edges[1] - 2)
        loop.step(loop.nearest(bench.ball.ball.u_rest))  # the host takes it back
    point = limit_cycle_points(t, u, y).points[0]
    exact = complex(bench.ball.ball.response(np.array([point.omega_rad_s]))[0])
    assert abs(point.response / exact) == pytest.approx(1.0, abs=5e-3)
    dead_time_s = -float(np.angle(point.response / exact)) / point.omega_rad_s
    assert abs(dead_time_s) < 1e-3
    recording = read_recording(bench.path)
    held = recording.between(float(t[0]), float(t[-1]))
    assert np.diff(held.t) == pytest.approx(0.01)
    assert np.isfinite(recording.y[:-1]).all()
    assert recording.metadata["ended"]["output"] == "safe output"
    assert bench.uno.duty == 0


def test_a_sample_that_the_host_missed_before_shifts_no_row_of_the_device(uno_elf: Path, tmp_path: Path) -> None:
    bench = Bench(uno_elf, tmp_path)
    with bench.loop as loop:
        loop.step(loop.nearest(bench.ball.ball.u_rest))
        bench.rig.clock.sleep_until(bench.rig.clock.now() + 2.5 * loop.sample_time_s)
        loop.step(loop.nearest(bench.ball.ball.u_rest))
        missed, oscillation = loop.tick.slot - loop.tick.k, bench.oscillation()
        assert missed > 0
        for _ in range(50):
            oscillation.step()
        assert loop.tick.slot - loop.tick.k == missed


def test_gains_are_tried_on_the_device_and_not_kept(uno_elf: Path, tmp_path: Path) -> None:
    bench = Bench(uno_elf, tmp_path)
    with bench.loop as loop:
        loop.step(loop.nearest(bench.ball.ball.u_rest))
        k = np.arange(250)
        setpoint, load = np.where(k < 20, 5.0, 5.3), np.where(k < 200, 0.0, 0.05)
        assert isinstance(bench.rig, RunsLaws)
        y, u = try_on_device(loop, bench.rig, GAINS, setpoint, load, lambda k: None)
        total = loop.history(loop.tick.k - 1)[1][0]
    assert u[:20] == pytest.approx(bench.ball.ball.u_rest, abs=2e-3)  # without a bump
    assert np.mean(u[22:25]) - np.mean(u[:20]) == pytest.approx(GAINS.K * 0.3, abs=1.5e-3)  # K (r - y) at once
    assert np.nanmean(y[150:200]) == pytest.approx(5.3, abs=0.15)
    assert total == pytest.approx(u[-1] + 0.05, abs=1e-3)  # the load is in the recorded command
    assert bench.rig.read_gains() != GAINS


def test_rows_lost_on_the_line_are_gaps_with_the_right_mean_command(
    uno_elf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(uno_elf, tmp_path)
    feed, rows = Decoder.feed, 0

    def lossy(decoder: Decoder, data: bytes) -> list[Frame]:
        nonlocal rows
        kept = []
        for frame in feed(decoder, data):
            rows += frame.kind == Kind.ROW
            if frame.kind != Kind.ROW or rows not in (20, 21, 60):
                kept.append(frame)
        return kept

    monkeypatch.setattr(Decoder, "feed", lossy)
    with bench.loop as loop:
        loop.step(loop.nearest(bench.ball.ball.u_rest))
        oscillation = bench.oscillation()
        while rows < 90:
            oscillation.step()
        t, u, y = (values[1:] for values in loop.history())
        start = round(1000 * loop._device_start_s)
    assert np.diff(t[1:]) == pytest.approx(0.01)
    assert np.isnan(y).sum() == 3
    # tick by tick, what the plant got is what the recorded commands add up to
    ticks = start + np.round(1000 * t[1:]).astype(int)
    plant = [np.mean(bench.ball.u[low:high]) / 1600.0 for low, high in pairwise(ticks)]
    assert np.sum(u[1:-1]) == pytest.approx(np.sum(plant), abs=1e-9)


def test_a_law_whose_first_acknowledgement_is_lost_goes_on_from_where_it_began(
    uno_elf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(uno_elf, tmp_path)
    feed, lost = Decoder.feed, 0

    def lossy(decoder: Decoder, data: bytes) -> list[Frame]:
        nonlocal lost
        kept = []
        for frame in feed(decoder, data):
            runs = frame.kind == Kind.SAMPLE and frame.values[3] & 3 == Command.RELAY
            lost += runs
            if not runs or lost > 1:
                kept.append(frame)
        return kept

    monkeypatch.setattr(Decoder, "feed", lossy)
    with bench.loop as loop:
        loop.step(loop.nearest(bench.ball.ball.u_rest))
        oscillation = bench.oscillation()
        while loop.tick.k < 80:
            oscillation.step()
        t, u, y = (values[1:] for values in loop.history())
        start = round(1000 * loop._device_start_s)
    assert lost > 1
    assert np.diff(t[2:]) == pytest.approx(0.01)  # from the law's first tick on, though it was asked for twice
    assert np.isnan(y).sum() == 1  # of its beginning
    ticks = start + np.round(1000 * t[2:]).astype(int)
    plant = [np.mean(bench.ball.u[low:high]) / 1600.0 for low, high in pairwise(ticks)]
    assert np.sum(u[2:-1]) == pytest.approx(np.sum(plant), abs=1e-9)


def test_a_silent_host_ends_the_law_on_the_device(uno_elf: Path, tmp_path: Path) -> None:
    bench = Bench(uno_elf, tmp_path)
    with bench.loop:
        oscillation = bench.oscillation()
        oscillation.step()
        bench.uno.advance(0.7)
        assert bench.uno.duty == 0
        with pytest.raises(LinkError, match="dead-man ran out"):
            deque(iter(oscillation.step, None), maxlen=0)


def test_what_the_limits_forbid_is_not_started_on_the_device(uno_elf: Path, tmp_path: Path) -> None:
    bench = Bench(uno_elf, tmp_path)
    with bench.loop as loop:
        loop.step(loop.nearest(bench.ball.ball.u_rest))
        for changes, what in (({"amplitude": 6.0}, "saturated"), ({"amplitude": 3.5}, "u_rate")):
            with pytest.raises(ExperimentStopped, match=what):
                bench.oscillation(**changes).step()
            loop.step(loop.nearest(bench.ball.ball.u_rest))


@given(smoothing=st.integers(1, 80), delay=st.floats(20.0, 200.0), ticks=st.integers(1, 20), longest=st.integers(1, 32))
def test_the_relay_on_the_device_lags_as_much_as_the_one_that_was_asked_for(
    smoothing: int, delay: float, ticks: int, longest: int
) -> None:
    asked = RelaySettings(
        y_centre=5.0, midpoint=5.0, amplitude=0.2, hysteresis=0.1, delay_samples=delay, smoothing=smoothing
    )
    run = in_ticks(asked, float(ticks), longest)
    assert run.smoothing <= longest
    # the mean of M readings is (M - 1)/2 old, and a crossing is seen half a reading late
    assert run.delay_samples + 0.5 * run.smoothing == pytest.approx(ticks * (delay + 0.5 * smoothing))
    assert run.hysteresis >= asked.hysteresis
    assert not math.isnan(run.hysteresis)
