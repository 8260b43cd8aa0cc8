"""The firmware built for the ATmega328P and executed in simavr: converters, ticks, line, dead-man, relay, PI."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import LinkError
from autotune.experiment.relay import RelaySettings
from drivers.device_rig import DeviceLawRig
from drivers.line_protocol import Kind
from sim.ball import Ball, BallSettings
from tests.drivers.bench import U_RANGE, firmware_bench
from tests.drivers.firmware_build import build_uno
from tests.drivers.laws import relay_outputs
from tests.drivers.simavr_bench import U_FULL, BallBehind, Uno

pytestmark = pytest.mark.system("gcc", "gcc-avr", "avr-libc", "libsimavr-dev", "libelf-dev")
HOVER = 8000


def noisy_ball(noise: float = 0.1) -> BallBehind:
    return BallBehind(Ball(BallSettings(hover=5.0, noise=noise, bits=None, start=5.0), seed=3))


def test_the_hex_is_the_same_bytes_every_time(tmp_path: Path) -> None:
    first, second = build_uno(tmp_path / "a"), build_uno(tmp_path / "elsewhere" / "b")
    assert first.with_suffix(".hex").read_bytes() == second.with_suffix(".hex").read_bytes()
    assert first.with_suffix(".hex").stat().st_size > 1000


def test_counts_come_in_and_go_out_exactly(uno_elf: Path) -> None:
    held = []

    def plant(count: int) -> int:
        held.append(count)
        return 1234

    uno = Uno(uno_elf, uno_elf.parent, plant)
    assert uno.ask(Kind.HELLO).values == (3, 1000, 1023, U_FULL, 1)
    uno.ask(Kind.TAKE, 0, 0, U_FULL, 500)
    for u in (0, 1, 2, 7999, U_FULL - 1, U_FULL):
        uno.ask(Kind.EXCHANGE, u)
        uno.run(0.003)
        assert held[-1] == u
        assert uno.ask(Kind.READ).values[1:3] == (1234 * 1023 // 5000, u)


def test_ticks_are_a_millisecond_by_the_processors_clock(uno_elf: Path) -> None:
    uno = Uno(uno_elf, uno_elf.parent, lambda _count: 2500)
    uno.ask(Kind.TAKE, 0, 0, U_FULL, 60_000)
    first, began = uno.ask(Kind.READ).values[0], uno.time_s
    uno.run(5.0)
    assert uno.ask(Kind.READ).values[0] - first == pytest.approx(1e6 * (uno.time_s - began), abs=1500)


def test_a_silent_host_leaves_the_safe_output_within_the_dead_man_time(uno_elf: Path) -> None:
    ball = noisy_ball()
    uno = Uno(uno_elf, uno_elf.parent, ball)
    uno.ask(Kind.TAKE, 123, 0, U_FULL, 300)
    uno.ask(Kind.EXCHANGE, HOVER)
    began = len(ball.u)
    uno.run(0.5)
    held = ball.u[began:]
    assert held[:296] == [HOVER] * 296
    assert set(held[303:]) == {123}


def test_a_reset_is_safe_and_is_told(uno_elf: Path) -> None:
    uno = Uno(uno_elf, uno_elf.parent, lambda _count: 2500)
    uno.ask(Kind.TAKE, 100, 0, U_FULL, 60_000)
    before = uno.ask(Kind.EXCHANGE, HOVER)
    uno.run(0.01)
    uno.reset()
    uno.run(0.01)
    assert uno.duty == 0
    after = uno.ask(Kind.READ)
    assert after.values[4] == before.values[4] + 1
    assert int(after.values[3]) & 3 == 0


@pytest.mark.parametrize(("smoothing", "delay"), [(1, 0.0), (4, 25.0), (16, 60.5)])
def test_every_switching_instant_on_the_device_is_the_ideal_laws(uno_elf: Path, smoothing: int, delay: float) -> None:
    ball = noisy_ball()
    uno = Uno(uno_elf, uno_elf.parent, ball)
    uno.ask(Kind.TAKE, 0, 0, U_FULL, 60_000)
    uno.ask(Kind.EXCHANGE, HOVER)
    settings = RelaySettings(
        y_centre=511.5,
        midpoint=float(HOVER),
        amplitude=1000.0,
        hysteresis=15.0,
        delay_samples=delay,
        smoothing=smoothing,
        plant_sign=-1,
    )
    numbers = (settings.y_centre, settings.midpoint, settings.amplitude, settings.hysteresis, settings.delay_samples)
    sample = uno.ask(Kind.RELAY, *numbers, smoothing, -1, 5, 60_000, 0, 0xFFFF)
    first = int(sample.values[0]) // 1000  # ticks before the relay's first
    frames = uno.run(20.0)
    assert [frame.kind for frame in frames] == [Kind.ROW] * len(frames)
    assert np.all(np.diff([frame.sequence for frame in frames]) == 1)
    assert len(frames) == pytest.approx(4000, abs=2)
    # the tick after sees the plant's count `first`; its output acts over the period after that
    wanted = np.round(relay_outputs(settings, np.array(ball.counts[first:-2], float)))
    held = np.array(ball.u[first + 2 :])
    assert np.ptp(wanted) == 2000.0
    instants, ideal = np.flatnonzero(np.diff(held)), np.flatnonzero(np.diff(wanted))
    assert len(ideal) >= 20
    assert len(instants) == len(ideal)
    assert np.max(np.abs(instants - ideal)) <= 1


def test_the_devices_pi_holds_the_ball(uno_elf: Path) -> None:
    ball = noisy_ball(noise=0.02)
    uno = Uno(uno_elf, uno_elf.parent, ball)
    uno.ask(Kind.TAKE, 0, 0, U_FULL, 500)
    uno.ask(Kind.EXCHANGE, HOVER)
    per_count = (10 / 1023) / (10 / U_FULL)
    uno.ask(Kind.SET_GAINS, -0.02 * per_count, 4.0)
    uno.ask(Kind.REGULATE, 0.4 * 1023, 0, 0, 0, 0xFFFF)
    uno.run(40.0)
    assert ball.ball.y_true == pytest.approx(4.0, abs=0.1)
    uno.ask(Kind.SAFE)
    uno.run(0.01)
    assert uno.duty == 0


def test_the_relay_on_the_device_is_run_through_the_driver(uno_elf: Path) -> None:
    with firmware_bench(uno_elf, relay="device") as bench:
        rig = bench.rig
        assert isinstance(rig, DeviceLawRig)
        rig.open()
        assert rig.tick_s == 1e-3
        y = rig.exchange(0.0).y
        settings = RelaySettings(y_centre=y, midpoint=0.0, amplitude=0.5, hysteresis=0.02, delay_samples=40.0)
        began = rig.start_relay(settings, row_s=0.005, time_s=1.0, y_range=U_RANGE)
        rows = [rig.row() for _ in range(100)]
        stamps = [began.device_time_s, *(row.reading.device_time_s for row in rows)]
        assert np.diff(stamps) == pytest.approx(0.005)
        assert {row.reading.u_applied for row in rows[1:]} <= {-0.5, 0.5}
        assert all(-0.5 <= row.u_mean <= 0.5 for row in rows)
        sample = rig.exchange(0.25)  # the host takes it back
        assert sample.u_applied == pytest.approx(0.25)
        assert bench.output() == pytest.approx(0.25)
        rig.start_relay(settings, row_s=0.005, time_s=0.2, y_range=U_RANGE)
        with pytest.raises(LinkError, match="its time is over"):
            deque(iter(rig.row, None), maxlen=0)
        assert bench.output() == pytest.approx(-0.5)  # safe


def test_a_reset_button_ends_the_session(uno_elf: Path) -> None:
    with firmware_bench(uno_elf) as bench:
        bench.rig.open()
        bench.rig.write(0.5)
        bench.restart()
        bench.rig.clock.sleep_until(bench.rig.clock.now() + 0.1)
        with pytest.raises(LinkError, match="restarted"):
            bench.rig.read()
