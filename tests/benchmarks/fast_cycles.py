"""Short cycles on loopback: a relay every 10, 5 and 2 ms on Modbus TCP against the slave in C, on S7 and on OPC UA.

S7 is served by python-snap7 in a process of its own, every 20 and 10 ms; OPC UA by asyncua, likewise, without security
and signed and encrypted, every 50 and 20 ms.

Half before and half after each row of Modbus a bare loop in C runs for as long, before others and with its memory
locked, on the same slave and on none: deadlines that it misses are this computer's (a virtual one stands still now and
then), and the tool's are to be seen beside them. *missed* are sample times without a row; *reading* is the time of a
sample on the link; *decision* is the time from a sample's stamp to its command in the device, acknowledged: the row is
on its way to the disk before the command is sent. Figures are of the machine as it is: its load is printed beside them.
``FAST_S=60`` runs each for so long; 20 s where nothing is said. ``FAST=Modbus`` runs links whose name has the pattern.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from autotune.config.procedure import LimitSettings
from autotune.config.rig import ModbusTcpSettings
from autotune.errors import AutotuneError
from autotune.experiment.limits import Envelope
from autotune.experiment.loop import ControlLoop
from autotune.experiment.rig import Rig
from autotune.experiment.timing import Timing
from autotune.recording import RecordingWriter
from drivers import open_rig
from tests.benchmarks.modbus_cycle import SLAVE, compiled, slave
from tests.drivers.test_opcua import ball, certificates_of_the_page
from tests.drivers.test_s7 import ball as ball_behind_s7

CYCLES_S, S7_CYCLES_S, OPC_CYCLES_S = (0.01, 0.005, 0.002), (0.02, 0.01), (0.05, 0.02)
#: rows of a half period of the relay
HALF = 10


def run_cycles(rig: Rig, sample_time_s: float, seconds: float, folder: Path) -> Timing:
    """Run a relay of no plant's for so long, and return how late it was."""
    limits = LimitSettings(
        u_min=0.0, u_max=10.0, u_safe=0.0, y_min=-100.0, y_max=100.0, swing=100.0, time_s=2 * seconds + 10
    )
    writer = RecordingWriter(folder / f"{sample_time_s:g}.csv", ("t", "u", "y"))
    envelope = Envelope(settings=limits, sample_time_s=sample_time_s)
    with ControlLoop(rig=rig, envelope=envelope, writer=writer) as loop:
        while loop.tick.t_s < seconds:
            loop.step(loop.nearest(3.0 if loop.tick.k // HALF % 2 else 1.0))
        return loop.timing


@dataclass(frozen=True)
class Bare:
    """What a bare loop in C missed, of how many deadlines, and how late it was woken at worst [s]."""

    missed: int = 0
    deadlines: int = 0
    worst_s: float = 0.0

    def __add__(self, other: Bare) -> Bare:
        worst_s = max(self.worst_s, other.worst_s)
        return Bare(self.missed + other.missed, self.deadlines + other.deadlines, worst_s)

    def __str__(self) -> str:
        return f"{self.missed} of {self.deadlines} missed, woken late by {1e3 * self.worst_s:.2f} ms at worst"


def run_bare(sample_time_s: float, seconds: float) -> tuple[Bare, Bare]:
    """Run a bare loop in C for so long, with the requests of a cycle and with none."""

    def run(*port: int) -> Bare:
        words = map(str, (program, sample_time_s, seconds, *port))
        said = subprocess.run(list(words), stdout=subprocess.PIPE, text=True, check=True).stdout.split()
        return Bare(int(said[1]), int(said[0]) + int(said[1]), float(said[2]))

    with tempfile.TemporaryDirectory() as folder, slave("tcp", before_others=True) as port:
        program = compiled(Path(__file__).with_name("bare_loop.c"), Path(folder))
        return run(port), run()


@contextmanager
def modbus(folder: Path) -> Iterator[Rig]:
    """Yield a rig on the slave in C."""
    with slave("tcp", before_others=True) as port:
        settings = ModbusTcpSettings(kind="modbus_tcp", port=port, timeout_s=1.0, registers=SLAVE)
        yield open_rig(settings, u_range=(0.0, 10.0), u_safe=0.0)


@contextmanager
def opc_ua(folder: Path, *, secured: bool) -> Iterator[Rig]:
    """Yield a rig on the ball behind a server in a process of its own."""
    certificates_of_the_page(folder)
    config = ball(folder, secured=secured)
    with served(folder):
        yield open_rig(config.rig, u_range=(0.0, 10.0), u_safe=0.0)


@contextmanager
def s7(folder: Path) -> Iterator[Rig]:
    """Yield a rig on the ball behind a Siemens CPU in a process of its own."""
    config = ball_behind_s7(folder)
    with served(folder):
        yield open_rig(config.rig, u_range=(0.0, 10.0), u_safe=0.0)


@contextmanager
def served(folder: Path) -> Iterator[None]:
    """Serve the twin of the folder's configuration in a process of its own."""
    command = [sys.executable, "-m", "autotune.cli", "rig", str(folder / "ball.toml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        server.stdout.readline()  # it serves
        try:
            yield
        finally:
            server.terminate()


def main() -> None:
    """Print a line for each link and cycle time."""
    seconds = float(os.environ.get("FAST_S", "20"))
    links = [("Modbus TCP", modbus, cycle_s) for cycle_s in CYCLES_S]
    links += [("S7", s7, cycle_s) for cycle_s in S7_CYCLES_S]
    for secured in (False, True):
        name = f"OPC UA, {'Basic256Sha256, encrypted' if secured else 'no security'}"
        links += [(name, partial(opc_ua, secured=secured), cycle_s) for cycle_s in OPC_CYCLES_S]
    first = float("nan")
    for name, link, sample_time_s in links:
        if not re.search(os.environ.get("FAST", ""), name):
            continue
        before = run_bare(sample_time_s, 0.5 * seconds) if link is modbus else None
        try:
            with tempfile.TemporaryDirectory() as folder, link(Path(folder)) as rig:
                timing = run_cycles(rig, sample_time_s, seconds, Path(folder))
        except AutotuneError as error:  # this computer was too busy for it
            print(f"{name}, {1e3 * sample_time_s:g} ms: {error}; load average {os.getloadavg()[0]:.1f}", flush=True)
            continue
        decision, late = 1e3 * np.array(timing.decision_s), 1e3 * np.array(timing.lateness_s)
        reading = 1e3 * timing.latency_s[0]
        first = reading if name == links[0][0] and sample_time_s == links[0][2] else first
        print(
            f"{name}, {1e3 * sample_time_s:g} ms: {timing.missed} of {timing.rows + timing.missed} missed;"
            f" reading {reading:.2f} ms median, {reading / first:.1f} times that of Modbus TCP;"
            f" decision {decision[0]:.2f} ms median, {decision[1]:.2f} ms in 99 %, {decision[2]:.2f} ms at worst;"
            f" woken late by {late[0]:.3f} ms, {late[1]:.2f} ms in 99 %; load average {os.getloadavg()[0]:.1f}",
            flush=True,
        )
        if before is not None:
            asking, idle = (a + b for a, b in zip(before, run_bare(sample_time_s, 0.5 * seconds), strict=True))
            print(f"  bare loop in C: with the same requests {asking}; with none {idle}", flush=True)


if __name__ == "__main__":
    main()
