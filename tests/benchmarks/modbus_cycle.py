"""The driver's control cycle against a bare read and write of the Modbus library, paired, on TCP loopback; and on RTU.

The driver reads a sample of three signals (four registers) in one request, checks it, writes command and heartbeat in
one request and checks that too; the bare cycle reads two registers and writes one and checks nothing. Both talk to the
same slave in C (libmodbus), in turns of one cycle each, so that the machine's load falls on both alike.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from pymodbus.client import ModbusTcpClient
from rich.console import Console
from rich.table import Table

from autotune.config.registers import RegisterMap
from autotune.config.rig import ModbusRtuSettings, ModbusTcpSettings
from autotune.experiment.priority import PRIORITY
from drivers import open_rig
from sim.serial_line import SerialLine

Times: TypeAlias = NDArray[np.float64]

SLAVE = RegisterMap.model_validate(
    {
        "y": {"table": "input", "address": 0, "type": "float32"},
        "u_applied": {"table": "input", "address": 2, "scale": 1e-3},
        "heartbeat_echo": {"table": "input", "address": 3, "type": "uint16"},
        "u": {"address": 0, "scale": 1e-3},
        "heartbeat": {"address": 1, "type": "uint16"},
    }
)


def compiled(source: Path, folder: Path) -> Path:
    """Compile a program in C that uses libmodbus, and return it."""
    program = folder / source.stem
    subprocess.run(["gcc", "-O2", "-I/usr/include/modbus", "-o", program, source, "-lmodbus"], check=True)
    return program


@contextmanager
def slave(*words: str, before_others: bool = False) -> Iterator[int]:
    """Compile and run the slave in C; yield its port.

    Before others it has the loop's priority, where the system grants it: as a device with a processor of its own, it
    does not wait for what else runs on this computer.
    """
    with tempfile.TemporaryDirectory() as folder:
        program = compiled(Path(__file__).parents[1] / "drivers" / "libmodbus_slave.c", Path(folder))
        with subprocess.Popen([program, *words], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            if before_others:
                with suppress(OSError):
                    os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(PRIORITY))
            yield int(process.stdout.readline().split()[1])
            process.kill()


def paired_cycles(cycles: int) -> tuple[Times, Times]:
    """Return the times of bare and of driven cycles on TCP [s], (N,) each, taken in turns."""
    with slave("tcp") as bare_port, slave("tcp") as driven_port:
        return _measure([bare_port, driven_port], cycles)


def serial_cycles(cycles: int) -> Times:
    """Return the times of driven cycles on a pseudo-terminal, whose bytes take no time of their own [s], (N,)."""
    with SerialLine() as line, slave("rtu", line.rig_device):
        settings = ModbusRtuSettings(
            kind="modbus_rtu", device=line.host_device, baud=115200, parity="N", timeout_s=2.0, registers=SLAVE
        )
        rig = open_rig(settings, u_range=(-10.0, 10.0), u_safe=0.0)
        rig.open()
        times = np.empty(cycles)
        for k in range(cycles):
            start = time.perf_counter()
            rig.read()
            rig.write(1e-3 * (k % 1000))
            times[k] = time.perf_counter() - start
        rig.make_safe()
        rig.close()
        return times[cycles // 10 :]


#: read of four registers (8 + 13 bytes), write of two (13 + 8), 10 bits a byte, silences of 1.75 ms between frames
WIRE_S = 42 * 10 / 115200 + 4 * 1.75e-3


def _measure(ports: list[int], cycles: int) -> tuple[Times, Times]:
    client = ModbusTcpClient("127.0.0.1", port=ports[0], timeout=2.0)
    client.connect()
    settings = ModbusTcpSettings(kind="modbus_tcp", port=ports[1], timeout_s=2.0, registers=SLAVE)
    rig = open_rig(settings, u_range=(-10.0, 10.0), u_safe=0.0)
    rig.open()
    times = np.empty((2, cycles))
    for k in range(cycles):
        start = time.perf_counter()
        client.read_input_registers(0, count=2)
        client.write_register(0, k % 1000)
        middle = time.perf_counter()
        rig.read()
        rig.write(1e-3 * (k % 1000))
        times[:, k] = middle - start, time.perf_counter() - middle
    client.close()
    rig.make_safe()
    rig.close()
    warm = cycles // 10
    return times[0, warm:], times[1, warm:]


def main() -> None:
    """Print medians, 99th percentiles and the paired ratio."""
    console = Console(highlight=False, width=110)
    if not Path("/usr/include/modbus/modbus.h").exists() or shutil.which("gcc") is None:
        console.print("modbus_cycle needs gcc and libmodbus-dev: apt-get install gcc libmodbus-dev")
        return
    cycles = int(os.environ.get("MODBUS_CYCLES", "5000"))
    bare, driven = paired_cycles(cycles)
    table = Table("cycle: read and write", "median [us]", "p99 [us]", title="Modbus control cycle")
    serial_times = serial_cycles(cycles // 5)
    for name, times in (("bare library", bare), ("driver", driven), ("driver, RTU on a pty", serial_times)):
        table.add_row(name, f"{1e6 * np.median(times):.0f}", f"{1e6 * np.quantile(times, 0.99):.0f}")
    console.print(table)
    ratios = np.median(driven) / np.median(bare), float(np.median(driven / bare))
    console.print(
        f"ratio of medians {ratios[0]:.2f}, median of paired ratios {ratios[1]:.2f} (wanted: at most 1.3), "
        f"{bare.size} pairs"
    )
    console.print(f"the same RTU cycle takes {1e6 * WIRE_S:.0f} us of wire at 115200 bit/s")
