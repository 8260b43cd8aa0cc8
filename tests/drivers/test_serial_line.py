"""What a bad serial line does to the driver: it costs time, or it is an error, and never a sample."""

from __future__ import annotations

import math
import os
import pty
import random
import select
import signal
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.config import load_config
from autotune.controller import PIDController
from autotune.errors import InputError, LinkError, NotTaken
from autotune.experiment.rig import HoldsGains
from drivers import open_rig
from drivers.serial_rig import SerialLineRig
from sim.serial_line import Direction
from tests.drivers.bench import U_RANGE, U_SAFE, Bench, rig_of, rtu_settings, serial_bench, serial_settings

COUNT = 20.0 / 16000  # of the output


def serial(bench: Bench) -> SerialLineRig:
    assert isinstance(bench.rig, SerialLineRig)
    return bench.rig


def test_commands_are_rounded_to_the_outputs_counts() -> None:
    with serial_bench() as bench:
        bench.rig.open()
        bench.rig.write(0.25 + 0.4 * COUNT)
        assert bench.output() == pytest.approx(0.25, abs=1e-9)
        with pytest.raises(InputError, match="u_span"):
            bench.rig.write(10.5)
        with pytest.raises(InputError, match="u_span"):
            bench.rig.write(math.nan)
        assert bench.output() == pytest.approx(0.25, abs=1e-9)


def test_limits_outside_the_span_are_refused_before_anything_is_sent() -> None:
    with pytest.raises(InputError, match="u = 12 is outside"):
        open_rig(serial_settings("/dev/null"), u_range=(-10.0, 12.0), u_safe=0.0)


def test_noise_and_torn_frames_cost_repetitions_and_no_wrong_sample() -> None:
    noise = random.Random(3)

    def tamper(frame: bytes, direction: Direction) -> list[tuple[float, bytes]]:
        kind = noise.randrange(30)
        if kind == 0:
            at = noise.randrange(len(frame))
            return [(0.0, frame[:at] + bytes((frame[at] ^ 1 << noise.randrange(8),)) + frame[at + 1 :])]
        if kind == 1:
            return [(0.0, frame[: noise.randrange(len(frame))])]
        if kind == 2:
            return [(0.0, noise.randbytes(5)), (0.001, frame)]
        return [(0.0, frame)]

    with serial_bench(tamper=tamper, timeout_s=0.15, retries=10, deadman_s=5.0) as bench:
        rig = serial(bench)
        rig.open()
        assert bench.device is not None
        suspects = 0
        for k in range(60):
            u = COUNT * (k - 30)
            rig.write(u)
            reading = rig.read()
            assert reading.u_applied == pytest.approx(u, abs=1e-9)
            assert reading.y == pytest.approx(bench.device.plant.y_true, abs=0.2)
            suspects += reading.suspect
        assert suspects > 0


def test_a_late_answer_is_not_the_next_requests() -> None:
    late = {"on": False}

    def tamper(frame: bytes, direction: Direction) -> list[tuple[float, bytes]]:
        if direction == "to host" and late["on"]:
            late["on"] = False
            return [(0.3, frame)]
        return [(0.0, frame)]

    with serial_bench(tamper=tamper, timeout_s=0.2, retries=1, deadman_s=10.0) as bench:
        rig = serial(bench)
        rig.open()
        rig.write(0.25)
        late["on"] = True
        first = rig.read()
        assert first.suspect
        for u in (0.5, -0.5):
            rig.write(u)
            reading = rig.read()
            assert reading.u_applied == pytest.approx(u, abs=1e-9)
            assert not reading.suspect


@pytest.fixture
def looped_line() -> Iterator[str]:
    """Yield the name of a serial device whose every byte comes back, as of an adapter with RX and TX joined."""
    far, near = pty.openpty()
    tty.setraw(far)
    tty.setraw(near)
    left = threading.Event()

    def back() -> None:
        while not left.is_set():
            if select.select([far], [], [], 0.05)[0]:
                os.write(far, os.read(far, 4096))

    thread = threading.Thread(target=back)
    thread.start()
    yield os.ttyname(near)
    left.set()
    thread.join()
    os.close(near)
    os.close(far)


@pytest.mark.parametrize("kind", ["serial", "modbus_rtu"])
def test_a_line_that_echoes_is_called_so_and_never_an_answer(looped_line: str, kind: str) -> None:
    settings = serial_settings(looped_line, start_s=0.05, timeout_s=0.05)
    rig = rig_of(settings if kind == "serial" else rtu_settings(looped_line))
    with pytest.raises(NotTaken, match=r"the line echoes what is sent.*part RX from TX"):
        rig.open()
    assert isinstance(rig, HoldsGains)
    with pytest.raises(LinkError, match="the line echoes what is sent"):
        rig.write_gains(PIDController(K=1.0, Ti_s=1.0))
    rig.close()


def test_a_device_behind_a_line_that_echoes_is_heard() -> None:
    asked = b""

    def tamper(frame: bytes, direction: Direction) -> list[tuple[float, bytes]]:
        nonlocal asked
        if direction == "to device":
            asked = frame
            return [(0.0, frame)]
        return [(0.0, asked), (0.0, frame)]  # two wires: what the host sent arrives at it too

    with serial_bench(tamper=tamper) as bench:
        rig = serial(bench)
        rig.open()
        rig.write(0.25)
        reading = rig.read()
        assert reading.u_applied == pytest.approx(0.25, abs=1e-9)
        assert not reading.suspect


def test_a_device_that_restarts_ends_the_session() -> None:
    with serial_bench() as bench:
        bench.rig.open()
        bench.rig.write(0.5)
        bench.restart()
        bench.rig.clock.sleep_until(bench.rig.clock.now() + 0.05)
        with pytest.raises(LinkError, match="restarted"):
            bench.rig.read()
        assert bench.output() == pytest.approx(U_SAFE)
        with pytest.raises(LinkError, match="not in command"):
            bench.rig.write(0.5)
        bench.rig.make_safe()
        bench.rig.close()
        bench.rig.open()  # a new session is the remedy
        assert math.isfinite(bench.rig.read().y)


def test_unplugging_is_an_error_and_plugging_in_a_new_session() -> None:
    rig = None
    with serial_bench() as bench:
        rig = bench.rig
        rig.open()
        rig.read()
        # the end of the context takes the line away altogether
        bench.rig.close = lambda: None  # type: ignore[method-assign]  # the cable is pulled, nobody says goodbye
    with pytest.raises(LinkError, match="serial line"):
        rig.read()
    with pytest.raises(LinkError, match="not open"):
        rig.write(0.0)
    with pytest.raises(LinkError, match="cannot be opened"):
        rig.make_safe()
    SerialLineRig.close(rig)  # type: ignore[arg-type]  # it is one


def test_nobody_there_is_said_in_one_line() -> None:
    rig = open_rig(serial_settings("/dev/no-such-port"), u_range=U_RANGE, u_safe=U_SAFE)
    with pytest.raises(LinkError, match="cannot be opened") as caught:
        rig.open()
    assert "\n" not in str(caught.value)


def test_autotune_rig_serves_the_configurations_microcontroller(tmp_path: Path) -> None:
    line = tmp_path / "line"
    text = (Path(__file__).parents[2] / "configs" / "ball_serial.toml").read_text()
    path = tmp_path / "ball_serial.toml"
    path.write_text(text.replace("/tmp/autotune-ball-serial", str(line)))
    config = load_config(path)
    with subprocess.Popen(
        [sys.executable, "-m", "autotune.cli", "rig", str(path)], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("serving a microcontroller")
            probed = CliRunner().invoke(app, ["probe", str(path)])
            assert probed.exit_code == 0, probed.output
            assert "nothing written" in probed.output
            assert "commanded by nobody" in probed.output
            rig = open_rig(config.rig, u_range=(0.0, 10.0), u_safe=0.0)
            rig.open()
            assert rig.read().y == pytest.approx(10.0, abs=0.4)  # on the floor
            rig.make_safe()
            rig.close()
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(20)
    assert not line.exists()


def test_only_a_pi_fits_into_the_device() -> None:
    with serial_bench() as bench:
        rig = serial(bench)
        rig.open()
        before = rig.read_gains()
        for refused in (
            PIDController(K=1.0, Ti_s=2.0, Td_s=0.1, Tf_s=0.01),
            PIDController(K=1.0, Ti_s=2.0, setpoint_weight=0.5),
        ):
            with pytest.raises(InputError, match="PI"):
                rig.write_gains(refused)
        assert rig.read_gains() == before


def test_device_time_goes_on_through_its_wrap() -> None:
    with serial_bench() as bench:
        rig = serial(bench)
        rig.open()
        first = rig.read().device_time_s
        # 32 bits of microseconds are 71.6 minutes
        stamps = [rig._unwrap_stamp((first + 1000.0 * k) * 1e6 % 2**32) for k in range(12)]
        assert stamps == pytest.approx([first + 1000.0 * k for k in range(12)])
