"""Faults of plants: a short session on a PLC that scans, in a process of its own, and what its own side says of it."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pyModbusTCP.client import ModbusClient

from autotune.errors import AutotuneError
from autotune.experiment.leaving import SAFE
from autotune.experiment.limits import Envelope
from autotune.experiment.loop import ControlLoop
from autotune.recording import RecordingWriter, read_recording
from tests.drivers.bench import DEADMAN_S, U_SAFE, rig_of
from tests.drivers.campaign import ATTEMPTS, NeverBegunError, Outcome
from tests.drivers.lines import LIMITS
from tests.drivers.scanning_plc import DOOR, plc_settings

SAMPLE_S, SESSION_S, STOPPED_S = 0.02, 1.2, 2.0
ROOT = Path(__file__).parents[2]


class PlcProcess:
    """The PLC in a process of its own, on a port that it keeps over restarts."""

    def __init__(self, folder: Path, options: dict[str, Any]) -> None:
        self.file = folder / "plc.txt"
        self.held_s = 0.0
        self._options: dict[str, Any] = {"deadman_s": DEADMAN_S - 0.04, "safe": U_SAFE} | options
        self.process = self._begun()
        self.under_way: threading.Thread | None = None
        self._undo: list[threading.Timer] = []

    def _begun(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.drivers.scanning_plc", json.dumps(self._options), str(self.file)]
        process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        self._options["port"] = int(process.stdout.readline())
        return process

    @property
    def port(self) -> int:
        return int(self._options["port"])

    def tell(self, line: str) -> None:
        """Have it do something."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def restart(self) -> None:
        """Kill it and start another one, which comes up at its safe output."""
        self.gone()
        self.process = self._begun()

    def gone(self) -> None:
        """Kill it, as a power failure does; an output module then falls back by itself."""
        self.process.kill()
        self.process.communicate()
        with self.file.open("a") as file:
            file.write(f"{time.monotonic()} {U_SAFE} nobody\n")

    def stop(self) -> None:
        """Stop it for some time."""
        self.held_s = STOPPED_S
        self.process.send_signal(signal.SIGSTOP)
        timer = threading.Timer(STOPPED_S, self.process.send_signal, [signal.SIGCONT])
        timer.start()
        self._undo.append(timer)

    def history(self) -> list[tuple[float, float, str]]:
        """Return time on the computer's monotonic clock [s], output and who moves it."""
        entries = [line.split() for line in self.file.read_text().splitlines()]
        return [(float(t_s), float(u), mode) for t_s, u, mode in entries]

    def settled(self) -> None:
        """Wait until it moves nothing any more."""
        if self.under_way is not None:
            self.under_way.join()
        until = time.monotonic() + 10.0
        while time.monotonic() < until:
            history = self.history()
            if history and history[-1][2] == "nobody" and not any(timer.is_alive() for timer in self._undo):
                return
            time.sleep(0.02)

    def end(self) -> None:
        """End it."""
        if self.under_way is not None:
            self.under_way.join()
        for timer in self._undo:
            timer.join()
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.communicate()


def _second_master(plc: PlcProcess) -> None:
    """Another program writes command and heartbeat, each 5 ms for a second."""
    other = ModbusClient(host="127.0.0.1", port=plc.port, unit_id=1, auto_open=True)
    for beat in range(7000, 7200):
        other.write_multiple_registers(0, [100, beat])
        time.sleep(0.005)
    other.close()


def _meanwhile(strike: Callable[[PlcProcess], None]) -> Callable[[PlcProcess], None]:
    """Return a strike that takes its time while the session goes on."""

    def begin(plc: PlcProcess) -> None:
        plc.under_way = threading.Thread(target=strike, args=[plc])
        plc.under_way.start()

    return begin


@dataclass(frozen=True, kw_only=True)
class PlantFault:
    """A fault, what the PLC and the rig's table are like, and the ends that are right for it."""

    name: str
    strike: Callable[[PlcProcess], None] = lambda plc: None
    ends: tuple[str, ...]
    plc: dict[str, Any] = field(default_factory=dict)
    rig: dict[str, Any] = field(default_factory=dict)


_GO = "Go to the rig: its safe output was not confirmed"
_RESET = (rf"connection was lost .*{_GO}", rf"no connection .*{_GO}")
_ONE_SOCKET = {"late": 2, "accept_s": 0.1, "sockets": 1}
PLANT_FAULTS = (
    *(
        PlantFault(name=f"PLC status {late} scans late", ends=("completed",), plc={"late": late, "scan_s": 0.02})
        for late in (1, 2, 3)
    ),
    PlantFault(name="PLC accepts each 100 ms, one socket", ends=("completed",), plc=_ONE_SOCKET),
    PlantFault(
        name="PLC resets once before a request", ends=("completed",), strike=lambda plc: plc.tell("once before")
    ),
    PlantFault(name="PLC resets once, answer lost", ends=("completed",), strike=lambda plc: plc.tell("once after")),
    PlantFault(name="PLC resets for good, requests lost", ends=_RESET, strike=lambda plc: plc.tell("reset before")),
    PlantFault(name="PLC resets for good, answers lost", ends=_RESET, strike=lambda plc: plc.tell("reset after")),
    PlantFault(name="rig process gone", ends=_RESET, strike=lambda plc: plc.gone()),
    PlantFault(
        name="rig process restarts",
        # once it is back its safe output is seen, and nobody need go to the rig
        ends=("took the actuator back", "echoes heartbeat", "connection was lost", "no connection"),
        strike=_meanwhile(PlcProcess.restart),
    ),
    PlantFault(
        name="rig process stopped for 2 s",
        ends=("no answer", "took the actuator back", "link too slow", "echoes heartbeat"),
        strike=lambda plc: plc.stop(),
    ),
    PlantFault(
        name="second master",
        ends=("echoes heartbeat .*another master", "holds another one.*one master", "another master"),
        strike=_meanwhile(_second_master),
    ),
    PlantFault(
        name="permissive lost",
        ends=("permissive 'guard door' is lost",),
        strike=lambda plc: plc.tell("door 0"),
        rig={"permissives": [DOOR]},
    ),
)


def run_plant_fault(fault: PlantFault, seed: int) -> Outcome:
    """Run one session with the fault at a moment drawn from the seed; begun again where the computer was too busy."""
    moment_s = random.Random(seed).uniform(0.1, 0.7 * SESSION_S)
    for _ in range(ATTEMPTS):
        with tempfile.TemporaryDirectory() as folder, _served(Path(folder), fault.plc) as plc:
            try:
                return _session(plc, fault, moment_s, Path(folder) / "session.csv")
            except NeverBegunError:
                continue
    raise NeverBegunError


@contextmanager
def _served(folder: Path, options: dict[str, Any]) -> Iterator[PlcProcess]:
    plc = PlcProcess(folder, options)
    try:
        yield plc
    finally:
        plc.end()


def _session(plc: PlcProcess, fault: PlantFault, moment_s: float, path: Path) -> Outcome:
    rig = rig_of(plc_settings(plc.port, **({"timeout_s": 0.2} | fault.rig)))
    envelope = Envelope(settings=LIMITS.model_copy(update={"late_s": 0.5}), sample_time_s=SAMPLE_S)
    writer = RecordingWriter(path, ("t", "u", "y"), {})
    struck_s, error = float("inf"), None
    try:
        with ControlLoop(rig=rig, envelope=envelope, writer=writer) as loop:
            tick = loop.tick
            while tick.t_s < SESSION_S:
                if tick.t_s >= moment_s and struck_s == float("inf"):
                    struck_s = time.monotonic()
                    fault.strike(plc)
                tick = loop.step(loop.nearest(-0.4 if tick.y > 0.0 else 0.4))
    except AutotuneError as caught:
        error = caught
    if struck_s == float("inf"):
        raise NeverBegunError from error
    plc.settled()
    recording = read_recording(path)
    said = "completed" if error is None else str(error)
    output = recording.metadata["ended"]["output"]
    if (output != SAFE) != (_GO in said):
        said = f"the line does not say that the output was {output}: {said}"
    history = plc.history()
    return Outcome(
        ended=said,
        exit_status=0 if error is None else error.exit_status,
        safe_after_s=_safe_after(history, struck_s, plc.held_s),
        beyond_limits=sum(not LIMITS.u_min <= u <= LIMITS.u_max for _, u, _ in history),
        bad_samples=0,
        rows=len(recording),
    )


def _safe_after(history: list[tuple[float, float, str]], struck_s: float, held_s: float) -> float:
    """Return the time from the last command that was taken to the safe output, the time it was stopped left out [s]."""
    others = [k for k, (_, u, mode) in enumerate(history) if abs(u - U_SAFE) > 1e-9]
    if others and others[-1] == len(history) - 1:
        return float("inf")
    last = others[-1] if others else 0
    return max(0.0, history[min(last + 1, len(history) - 1)][0] - history[last][0] - held_s)
