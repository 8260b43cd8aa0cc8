"""A soft PLC: the compiled program, scanned in cycles, behind a Modbus server that nobody here wrote.

As such PLCs do it: the host's registers are taken when a scan begins, the program runs, and what it says of itself is
shown when the next scan ends; %QW and %IW are integers of 16 bits that wrap.
"""

from __future__ import annotations

import ctypes
import math
import random
import re
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from pyModbusTCP.server import DataBank, ModbusServer

from tests.drivers.bench import LIMIT_S
from tests.drivers.iec_compiler import generated_c, library

STRUCTURED_TEXT = Path(__file__).parents[2] / "drivers" / "firmware" / "structured_text"
FULL_SCALE, FULL_COUNT = 10.0, 32767
_STATUS = ("MW1", "MW2", "MD0", "MD1")


def compiled_program(folder: Path, scan_s: float) -> ctypes.CDLL:
    """Build the program of the PLC for a cycle time; ``at_NAME`` are its located variables."""
    source = "".join((STRUCTURED_TEXT / name).read_text() for name in ("relay.st", "pi.st", "rig.st", "program.st"))
    source = source.replace("CYCLE : LREAL := 0.01;", f"CYCLE : LREAL := {scan_s!r};")
    source = source.replace("INTERVAL := T#10ms", f"INTERVAL := T#{round(1000 * scan_s)}ms")
    headers = generated_c(source, folder)
    located = re.findall(r"__LOCATED_VAR\((\w+),(\w+),", (folder / "LOCATED_VARIABLES.h").read_text())
    shim = folder / "plc.c"
    lines = ['#include "iec_std_lib.h"', "TIME __CURRENT_TIME;", "BOOL __DEBUG;"]
    lines += [f"{kind} at{name[1:]}; {kind} *{name} = &at{name[1:]};" for kind, name in located]
    shim.write_text("\n".join(lines) + "\n")
    program = library([shim, folder / "Config0.c", folder / "Res0.c"], headers, folder / "plc.so")
    program.config_init__()
    return program


class ScannedPlc:
    """A PLC that scans until the context ends, with a plant on its analog channels.

    Parameters
    ----------
    plant : Lags
        Takes 0 .. 10 and shows 0 .. 10.
    folder : Path
        Where the program is built.
    scan_s : float
        Cycle of the task [s].
    """

    def __init__(self, plant: Lags, folder: Path, scan_s: float) -> None:
        self.scan_s = scan_s
        self._plant = plant
        self._program = compiled_program(folder, scan_s)
        self._bank = DataBank()
        self._server = ModbusServer("127.0.0.1", 0, no_block=True, data_bank=self._bank)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, name="plc", daemon=True)
        self._shown: dict[str, list[int]] = {}
        self._tick = 0
        self._scanned = threading.Condition()
        self._written = {f"MW{i}": 1 for i in (0, 3, 4, 5)} | {f"MD{i}": 2 for i in range(2, 7)}

    def __enter__(self) -> ScannedPlc:
        self._server.start()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ends.set()
        self._thread.join()
        self._server.stop()

    @property
    def port(self) -> int:
        """Port of the Modbus server."""
        return int(self._server._service.server_address[1])

    @property
    def channel(self) -> int:
        """What the analog output is given, %QW0."""
        return self._int("QW0").value

    @property
    def output(self) -> float:
        """The analog output."""
        return self.channel * FULL_SCALE / FULL_COUNT

    def written(self, name: str) -> float:
        """Return a located variable."""
        return float(self._at(name).value)

    def until(self, holds: Callable[[], bool], what: str, limit_s: float = LIMIT_S) -> None:
        """Wait until something holds after a scan."""
        with self._scanned:
            assert self._scanned.wait_for(holds, limit_s), what

    def _run(self) -> None:
        deadline_s = time.perf_counter()
        while not self._ends.is_set():
            with self._scanned:
                self.scan()
                self._scanned.notify_all()
            deadline_s += self.scan_s
            self._ends.wait(max(0.0, deadline_s - time.perf_counter()))

    def scan(self) -> None:
        """Take the registers, run the program once, show what it said one scan ago."""
        for name, count in self._written.items():
            words = self._bank.get_holding_registers(_address(name), count)
            self._at(name).value = _value(name, words)
        self._int("IW0").value = round(self._plant.measure() * FULL_COUNT / FULL_SCALE)
        before = {name: self._int(name).value for name in ("MW3", "MW4")}
        self._program.config_run__(ctypes.c_ulong(self._tick))
        self._tick += 1
        for name, value in before.items():  # what the program writes of the host's own is shown at once
            if self._int(name).value != value:
                self._bank.set_holding_registers(_address(name), [self._int(name).value])
        for name, words in self._shown.items():
            self._bank.set_holding_registers(_address(name), words)
        self._shown = {name: _words(name, self._at(name).value) for name in (*_STATUS, "QW0")}
        self._plant.advance(self.output, self.scan_s)

    def _at(self, name: str) -> ctypes.c_int16 | ctypes.c_float:
        return self._int(name) if "W" in name else ctypes.c_float.in_dll(self._program, f"at_{name}")

    def _int(self, name: str) -> ctypes.c_int16:
        return ctypes.c_int16.in_dll(self._program, f"at_{name}")


def _address(name: str) -> int:
    place = name.rstrip("0123456789")
    number = int(name[len(place) :])
    return {"QW": 0, "MW": 1024, "MD": 2048}[place] + number * (2 if place == "MD" else 1)


def _words(name: str, value: float) -> list[int]:
    if "W" in name:
        return [int(value) & 0xFFFF]
    return list(struct.unpack(">HH", struct.pack(">f", value)))


def _value(name: str, words: list[int]) -> float:
    if "W" in name:
        return struct.unpack(">h", struct.pack(">H", words[0]))[0]
    return struct.unpack(">f", struct.pack(">HH", *words))[0]


class Lags:
    """A plant of two lags and noise; it starts at rest at 0 and takes what the analog output gives.

    Parameters
    ----------
    taus_s : (float, float)
        Time constants [s].
    noise : float
        Standard deviation of the noise.
    """

    def __init__(self, taus_s: tuple[float, float], noise: float = 0.005) -> None:
        self._taus_s = taus_s
        self._states = [0.0, 0.0]
        self._noise = noise
        self._random = random.Random(1)

    def advance(self, u: float, dt_s: float) -> None:
        """Hold u for a time [s]."""
        steps = 4
        for _ in range(steps):
            for i, tau_s in enumerate(self._taus_s):
                into = u if i == 0 else self._states[0]
                self._states[i] += (into - self._states[i]) * -math.expm1(-dt_s / steps / tau_s)

    def measure(self) -> float:
        """Return one measurement."""
        return self._states[1] + self._random.gauss(0.0, self._noise)
