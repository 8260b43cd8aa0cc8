"""The serial line and the firmware: switching error of the on-device relay, lateness of a 1 kHz host loop.

The first runs in simavr in virtual time; the second on a pseudo-terminal, whose bytes take no time of their own, for
``SERIAL_CYCLES`` cycles (3000).
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from autotune.config import load_config
from autotune.experiment.relay import RelaySettings
from drivers.line_protocol import Kind
from drivers.serial_rig import SerialLineRig
from tests.drivers.bench import serial_bench
from tests.drivers.firmware_build import build_uno
from tests.drivers.laws import relay_outputs
from tests.drivers.simavr_bench import U_FULL, Uno, twin_ball

CONFIG = Path(__file__).parents[2] / "configs" / "ball_serial.toml"


def switching(elf: Path) -> Table:
    """Return the errors of the on-device relay's switching instants."""
    table = Table("smoothing", "delay [ticks]", "switches", "largest error [ticks]", title="relay on the device, 60 s")
    for smoothing, delay in ((1, 0.0), (4, 25.0), (16, 60.5)):
        plant = twin_ball(load_config(CONFIG), "afloat")
        hover = round(plant.ball.u_rest / 10.0 * U_FULL)
        uno = Uno(elf, elf.parent, plant)
        uno.ask(Kind.TAKE, 0, 0, U_FULL, 60_000)
        uno.ask(Kind.EXCHANGE, hover)
        settings = RelaySettings(
            y_centre=511.5,
            midpoint=float(hover),
            amplitude=800.0,
            hysteresis=40.0,
            delay_samples=delay,
            smoothing=smoothing,
            plant_sign=-1,
        )
        numbers = (511.5, settings.midpoint, settings.amplitude, settings.hysteresis, delay)
        sample = uno.ask(Kind.RELAY, *numbers, smoothing, -1, 10, 60_000, 0, 0xFFFF)
        first = int(sample.values[0]) // 1000
        uno.run(59.5)
        ideal = np.flatnonzero(np.diff(np.round(relay_outputs(settings, np.array(plant.counts[first:-2], float)))))
        real = np.flatnonzero(np.diff(plant.u[first + 2 :]))
        error = f"{np.max(np.abs(real - ideal)):d}" if len(real) == len(ideal) else "another number of switches"
        table.add_row(str(smoothing), f"{delay:g}", str(len(ideal)), error)
    return table


def lateness(cycles: int) -> Table:
    """Return how late the cycles of a 1 kHz loop begin and how long one request takes."""
    late, took = np.empty(cycles), np.empty(cycles)
    with serial_bench(deadman_s=5.0) as bench:
        rig = bench.rig
        assert isinstance(rig, SerialLineRig)
        rig.open()
        deadline = rig.clock.now()
        for k in range(cycles):
            deadline = max(deadline + 1e-3, rig.clock.now() - 1e-3)
            rig.clock.sleep_until(deadline)
            late[k] = rig.clock.now() - deadline
            start = time.perf_counter()
            rig.exchange(1e-3 * (k % 100))
            took[k] = time.perf_counter() - start
    table = Table("", "median", "p99", "worst", title=f"host loop at 1 kHz, {cycles} cycles [us]")
    for name, values in (("lateness", late), ("request and sample", took)):
        table.add_row(name, *(f"{1e6 * np.quantile(values, q):.0f}" for q in (0.5, 0.99, 1.0)))
    return table


def main() -> None:
    """Print both tables."""
    console = Console(highlight=False, width=110)
    with tempfile.TemporaryDirectory() as folder:
        elf = build_uno(Path(folder))
        console.print(switching(elf))
        console.print(lateness(int(os.environ.get("SERIAL_CYCLES", "3000"))))
