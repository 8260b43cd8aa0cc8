"""The lines of the fault campaign with the controller in C behind them: what it did stands in a log of its own."""

from __future__ import annotations

import random
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from pyModbusTCP.client import ModbusClient

from autotune.config.procedure import LimitSettings
from autotune.config.registers import RegisterMap
from drivers import open_rig
from sim.register_device import OutputChange
from tests.drivers.bench import DEADMAN_S, LIMIT_S, tcp_settings
from tests.drivers.campaign import FAULTS, Fault
from tests.drivers.lines import TIMEOUT_S, Harm, Line, by_float, tcp_line
from tests.drivers.tcp_relay import TcpRelay, refuses, run_before_others
from tests.drivers.test_own_controller import PEER

#: of the campaign's sessions on this plant, which begins at rest at its safe output of 0
LIMITS = LimitSettings(u_min=0.0, u_max=10.0, u_safe=0.0, y_min=-1.0, y_max=9.5, swing=9.0, time_s=60.0)
RELAY = (4.5, 4.0, 5.0)
CYCLE_S = 0.01
_BUSY = ("is busy", "link too slow")


class ControllerProcess:
    """The controller in C in a process of its own, on a port that it keeps over restarts; says what it did.

    Parameters
    ----------
    program : Path
        Compiled.
    log : Path
        File that it writes every cycle to.
    deadman_s : float
        Time without a new heartbeat after which the host loses the output [s].
    """

    def __init__(self, program: Path, log: Path, deadman_s: float) -> None:
        self.on_change: Callable[[OutputChange], None] | None = None
        self._command = [program, "ideal"]
        self._rest = [str(deadman_s), log]
        self._log = log
        self.port = 0
        self._process = self._begun()
        self._others: list[threading.Thread] = []

    def _begun(self) -> subprocess.Popen[str]:
        command = [*self._command, str(self.port), *self._rest]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=run_before_others)
        assert process.stdout is not None
        self.port = int(process.stdout.readline().split()[1])
        return process

    def restart(self) -> None:
        """End it as a power failure does, and start it again: registers cleared, at its safe output."""
        self._process.kill()
        self._process.communicate()
        self._process = self._begun()

    def meanwhile(self, strike: Callable[[], None]) -> None:
        """Do something while the session goes on."""
        self._others.append(threading.Thread(target=strike))
        self._others[-1].start()

    def end(self) -> None:
        """Wait for what goes on, and end it."""
        for thread in self._others:
            thread.join()
        self._process.kill()
        self._process.communicate()

    def settle(self) -> None:
        """Wait until nobody moves the output."""
        until_s = time.monotonic() + LIMIT_S
        while self._cycles()[-1][3] != 0 and time.monotonic() < until_s:
            self._process.poll()
            threading.Event().wait(CYCLE_S)

    def _cycles(self) -> list[tuple[float, float, float, int, int]]:
        """Return time on the computer's monotonic clock [s], y, output, mode and heartbeat of every cycle."""
        fields = [line.split() for line in self._log.read_text().splitlines(keepends=True) if line.endswith("\n")]
        return [(float(t_s), float(y), float(u), int(mode), int(beat)) for t_s, y, u, mode, beat in fields]

    @property
    def history(self) -> list[OutputChange]:
        """What moved the actuator, from one change or heartbeat to the next."""
        found: list[OutputChange] = []
        before: tuple[float, ...] = ()
        for t_s, _, u, mode, beat in self._cycles():
            if before != (u, mode, beat):
                cause = ("given back", "command", "controller")[mode]
                found.append(OutputChange(t_s=t_s, output=u, cause=cause))
            before = (u, mode, beat)
        return found

    @property
    def output(self) -> float:
        """What the actuator is moved with now."""
        return self._cycles()[-1][2]

    @property
    def measured(self) -> dict[float, list[float]]:
        """When it showed which measurement [s]."""
        found: dict[float, list[float]] = {}
        for t_s, y, _, _, _ in self._cycles():
            found.setdefault(by_float(y), []).append(t_s)
        return found

    @staticmethod
    def shown(y: float) -> float:
        """Return a measurement as its registers show it."""
        return by_float(y)


def write_u(port: int, times: int, every_s: float) -> None:
    """Be another master that writes 1 V as the command so many times."""
    other = ModbusClient(host="127.0.0.1", port=port, auto_open=True)
    for _ in range(times):
        other.write_multiple_registers(0, [0x3F80, 0])
        threading.Event().wait(every_s)
    other.close()


@contextmanager
def controller_line(
    program: Path, folder: Path, seed: int, *, without: tuple[str, ...] = (), deadman_s: float = DEADMAN_S
) -> Iterator[Line]:
    """Yield a rig on the controller in C with a relay in between, without some signals in its map."""
    # a cycle until the dead-man is looked at, one until it is seen, and what a busy computer adds
    device = ControllerProcess(program, folder / "log.txt", deadman_s - 4 * CYCLE_S)
    try:
        with TcpRelay(device.port) as relay, ExitStack() as undo:
            mapped = {name: given for name, given in PEER.items() if name not in without}
            settings = tcp_settings(relay.port, RegisterMap.model_validate(mapped), timeout_s=TIMEOUT_S)
            settings = settings.model_copy(update={"scan_time_s": CYCLE_S})
            rig = open_rig(settings, u_range=(LIMITS.u_min, LIMITS.u_max), u_safe=LIMITS.u_safe)

            def harm(how: Harm) -> None:
                relay.tamper = how  # type: ignore[assignment]  # a direction is one of two words

            def refuse(code: int, times: int) -> None:
                left = iter(range(times))
                relay.tamper = refuses(code, lambda: next(left, None) is not None)

            yield Line(
                rig=rig, settings=settings, device=device, plant=device, random=random.Random(seed),
                settle=device.settle, set_harm=harm, refuse=refuse, reset=relay.reset, restart=device.restart,
                undo=undo, limits=LIMITS, relay=RELAY,
            )  # fmt: skip
            rig.close()
    finally:
        device.end()


def faults_on_controller(program: Path, folder: Path) -> tuple[Fault, ...]:
    """Return the campaign's faults of a TCP line, and those of masters, on the controller in C."""

    def on(**changes: Any) -> Callable[[int], Any]:
        def line(seed: int) -> Any:
            place = Path(tempfile.mkdtemp(dir=folder))
            return controller_line(program, place, seed, **changes)

        return line

    def writes(times: int) -> Callable[[Line], None]:
        def strike(line: Line) -> None:
            device = line.device
            assert isinstance(device, ControllerProcess)
            device.meanwhile(lambda: write_u(device.port, times, 0.2))

        return strike

    def busy(line: Line) -> None:
        until_s = time.monotonic() + 0.35
        line.set_harm(refuses(6, lambda: time.monotonic() < until_s))  # type: ignore[arg-type]  # as above

    of_tcp = (replace(fault, line=on()) for fault in FAULTS if fault.line is tcp_line)
    alone = {"without": ("heartbeat", "heartbeat_echo", "trial"), "deadman_s": 1e9}
    return (
        *of_tcp,
        Fault(name="second master, once", line=on(), ends=("completed",), strike=writes(1)),
        Fault(
            name="second master, 5 a second",
            line=on(),
            ends=("another master writes the command",),
            strike=writes(10),
            session_s=3.0,
        ),
        Fault(
            name="busy for .35 s, no dead-man",
            line=on(**alone),
            ends=(*_BUSY, "completed"),
            strike=busy,
            # nothing but the host's own repetition makes it safe
            within_s=2.0,
        ),
    )
