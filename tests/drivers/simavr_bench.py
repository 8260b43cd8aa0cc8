"""The firmware executed in simavr in virtual time, with any simulated plant behind its converters."""

from __future__ import annotations

import ctypes
import os
import select
import subprocess
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import numpy as np

from autotune.config import Config
from autotune.config.rig import SerialSettings
from drivers import twin_of
from drivers.device_rig import DeviceLawRig
from drivers.line_protocol import Decoder, Frame, Kind, encode
from drivers.serial_rig import SerialLineRig
from sim.ball import Ball
from sim.plant import make_plant

F_CPU = 16_000_000
U_FULL = 16_000
_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_uint32)


class Uno:
    """An Arduino Uno with the firmware.

    Parameters
    ----------
    elf : Path
        The built firmware.
    folder : Path
        Where the harness is compiled.
    plant : callable
        Takes the count of the output over the PWM period that ends, a millisecond, and returns the sensor's voltage in
        mV, 0..5000.
    """

    def __init__(self, elf: Path, folder: Path, plant: Callable[[int], int], *, baud: int = 115200) -> None:
        library = folder / "harness.so"
        if not library.exists():
            source = Path(__file__).with_name("simavr_harness.c")
            warnings = ["-Wall", "-Wextra", "-Werror"]
            command = ["gcc", "-O2", *warnings, "-shared", "-fPIC", "-o", library, source, "-lsimavr", "-lelf"]
            subprocess.run(command, check=True)
        self._library = ctypes.CDLL(str(library))
        self._library.harness_new.restype = ctypes.c_void_p
        self._library.harness_cycle.restype = ctypes.c_uint64
        self._callback = _CALLBACK(plant)  # kept: the library holds no reference
        self._it = ctypes.c_void_p(self._library.harness_new(str(elf).encode(), baud, self._callback))
        assert self._it
        self._tail = ctypes.c_uint32(0)
        self._buffer = np.empty(1 << 20, np.uint8)
        self._decoder = Decoder()
        self._sequence = 0
        self.advance(0.01)  # before it has started it hears nothing

    @property
    def time_s(self) -> float:
        """Virtual time [s]."""
        return self._library.harness_cycle(self._it) / F_CPU

    def run(self, seconds: float) -> list[Frame]:
        """Run for a virtual time; return the frames that came."""
        self.advance(seconds)
        return self._decoder.feed(self.received())

    def advance(self, seconds: float) -> None:
        """Run for a virtual time [s]."""
        until = self._library.harness_cycle(self._it) + round(seconds * F_CPU)
        assert self._library.harness_run(self._it, ctypes.c_uint64(until)) == 0

    def received(self) -> bytes:
        """Return the bytes that the device sent since the last call."""
        count = self._library.harness_received(
            self._it, ctypes.byref(self._tail), self._buffer.ctypes.data_as(ctypes.c_void_p), len(self._buffer)
        )
        return self._buffer[:count].tobytes()

    def send(self, data: bytes) -> None:
        """Put bytes on the line."""
        self._library.harness_send(self._it, data, len(data))

    def ask(self, kind: Kind, *values: float) -> Frame:
        """Send a request; return its answer, waiting at most 50 ms for it."""
        self._sequence += 1
        self.send(encode(Frame(kind=kind, sequence=self._sequence, values=values)))
        for _ in range(100):
            for frame in self.run(0.0005):
                if frame.sequence == self._sequence and frame.kind != Kind.ROW:
                    return frame
        raise AssertionError(f"no answer to {kind.name}")

    @property
    def duty(self) -> int:
        """Count of the output, 0..16000."""
        return int(self._library.harness_duty(self._it))

    def reset(self) -> None:
        """Press the reset button."""
        self._library.harness_reset(self._it)


class UnoPort:
    """The Uno's line as a serial port and its time as a clock, both virtual: waiting lets the Uno live.

    Parameters
    ----------
    uno : Uno
        What is at the other end.
    """

    STEP_S = 2.5e-4

    def __init__(self, uno: Uno) -> None:
        self.timeout: float | None = 0.1
        self._uno = uno
        self._buffer = bytearray()

    def now(self) -> float:
        """Return the virtual time [s]."""
        return self._uno.time_s

    def sleep_until(self, t_s: float) -> None:
        """Let the Uno live until then [s]."""
        if t_s > self._uno.time_s:
            self._uno.advance(t_s - self._uno.time_s)

    @property
    def in_waiting(self) -> int:
        """Bytes that have arrived."""
        self._buffer += self._uno.received()
        return len(self._buffer)

    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes, as soon as there is one."""
        until_s = self._uno.time_s + (self.timeout or 0.0)
        while not self.in_waiting and self._uno.time_s < until_s:
            self._uno.advance(self.STEP_S)
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        return data

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._uno.send(data)

    def close(self) -> None:
        """Leave the Uno as it is."""


class BallBehind:
    """A ball behind the converters, and what went through them.

    Parameters
    ----------
    ball : Ball
        Its 0 to 10 V come to the converter through a divider by two.
    """

    def __init__(self, ball: Ball) -> None:
        self.ball = ball
        self.counts: list[int] = []
        self.u: list[int] = []

    def __call__(self, count: int) -> int:
        self.ball.advance(10.0 * count / U_FULL, 1e-3)
        millivolts = round(min(max(self.ball.measure(), 0.0), 10.0) * 500)
        self.u.append(count)
        self.counts.append(millivolts * 1023 // 5000)
        return millivolts


def twin_ball(config: Config, start: str | None = None) -> BallBehind:
    """Return the configuration's ball; its noise is that of the twin."""
    twin = twin_of(config.rig)
    made = make_plant("ball", seed=twin.seed, noise=twin.noise, start=start, converters=False)
    assert isinstance(made, Ball)
    return BallBehind(made)


def virtual_rig(uno: Uno, config: Config, **changes: object) -> SerialLineRig:
    """Return the driver on an executed Uno in virtual time; ``changes`` are of the table ``[rig]``."""
    assert isinstance(config.rig, SerialSettings)
    settings = config.rig.model_copy(update=changes)
    port, limits = UnoPort(uno), config.limits
    kind = DeviceLawRig if settings.relay == "device" else SerialLineRig
    return kind(
        settings, u_range=(limits.u_min, limits.u_max), u_safe=limits.u_safe, clock=port, port=lambda _settings: port
    )


class UnoOnLine:
    """The Uno on a serial device, its virtual time paced by the wall clock, until the context ends."""

    def __init__(self, uno: Uno, port: str) -> None:
        self.uno = uno
        self._line = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._line)
        self._stop, self._reset = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._live, name="simavr", daemon=True)

    def __enter__(self) -> UnoOnLine:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._line)

    def restart(self) -> None:
        """Press the reset button."""
        self._reset.set()

    def _live(self) -> None:
        start_s = time.perf_counter() - self.uno.time_s
        while not self._stop.is_set():
            ready, _, _ = select.select([self._line], [], [], 0.0005)
            arrived = os.read(self._line, 4096) if ready else b""
            if self._reset.is_set():
                self._reset.clear()
                self.uno.reset()
            behind_s = time.perf_counter() - start_s - self.uno.time_s
            if behind_s > 0:
                self.uno.advance(behind_s)
            self.uno.send(arrived)  # now: where the computer was busy the request is not older than it is
            sent = self.uno.received()
            if sent:
                os.write(self._line, sent)
