"""The serial line and the firmware: switching error of the on-device relay, lateness of a 1 kHz host loop, Bode points.

The first and the last run in simavr in virtual time; the middle one on a pseudo-terminal, whose bytes take no time of
their own, for ``SERIAL_CYCLES`` cycles (3000).
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from autotune.config import load_config
from autotune.experiment.relay import RelaySettings
from autotune.experiment.rig import Reading, Rig
from autotune.experiment.run import run_experiment
from autotune.points import FrequencyPoint
from drivers import open_rig, twin_of
from drivers.line_protocol import Kind
from drivers.serial_rig import SerialLineRig
from sim.ball import Ball
from sim.plant import make_plant
from tests.drivers.bench import serial_bench
from tests.drivers.firmware_build import build_uno
from tests.drivers.laws import relay_outputs
from tests.drivers.simavr_bench import U_FULL, Uno

CONFIG = Path(__file__).parents[2] / "configs" / "ball_serial.toml"


@dataclass(kw_only=True)
class BallBehind:
    """The ball behind the converters, and what went through them."""

    ball: Ball
    counts: list[int]
    u: list[int]

    def __call__(self, count: int) -> int:
        """Live for a millisecond."""
        self.ball.advance(10.0 * count / U_FULL, 1e-3)
        millivolts = round(min(max(self.ball.measure(), 0.0), 10.0) * 500)
        self.u.append(count)
        self.counts.append(millivolts * 1023 // 5000)
        return millivolts


def ball(start: str | None = None) -> BallBehind:
    """Return the configuration's ball; its noise is that of the twin."""
    twin = twin_of(load_config(CONFIG).rig)
    made = make_plant("ball", seed=twin.seed, noise=twin.noise, start=start)
    assert isinstance(made, Ball)
    return BallBehind(ball=made, counts=[], u=[])


class VirtualRig:
    """The executed firmware as a rig in virtual time, host in the loop; one request at a time, 115200 bit/s."""

    def __init__(self, uno: Uno) -> None:
        self._uno = uno
        self.round_trips: list[float] = []

    @property
    def clock(self) -> VirtualRig:
        """The virtual clock."""
        return self

    def now(self) -> float:
        """Return the virtual time [s]."""
        return self._uno.time_s

    def sleep_until(self, t_s: float) -> None:
        """Let the firmware live until then."""
        if t_s > self.now():
            self._uno.advance(t_s - self.now())

    def open(self) -> None:
        """Take command."""
        self._uno.ask(Kind.TAKE, 0, 0, U_FULL, 500)

    def read(self) -> Reading:
        """Take one sample."""
        start_s = self.now()
        stamp, y, u, *_ = self._uno.ask(Kind.READ).values
        return Reading(
            t_s=start_s,
            y=10.0 * y / 1023,
            u_applied=10.0 * u / U_FULL,
            device_time_s=1e-6 * stamp,
            latency_s=self.now() - start_s,
        )

    def write(self, u: float) -> None:
        """Command the output."""
        self._uno.ask(Kind.EXCHANGE, round(u / 10.0 * U_FULL))

    def make_safe(self) -> None:
        """Command the safe output."""
        self._uno.ask(Kind.SAFE)

    def close(self) -> None:
        """Nothing to close."""


def switching(elf: Path) -> Table:
    """Return the errors of the on-device relay's switching instants."""
    table = Table("smoothing", "delay [ticks]", "switches", "largest error [ticks]", title="relay on the device, 60 s")
    for smoothing, delay in ((1, 0.0), (4, 25.0), (16, 60.5)):
        plant = ball("afloat")
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
        ideal = np.flatnonzero(np.diff(np.round(relay_outputs(settings, np.array(plant.counts[first:-1], float)))))
        real = np.flatnonzero(np.diff(plant.u[first + 1 :]))
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


def bode(elf: Path) -> Table:
    """Return the points of the executed firmware and of the run in process, against the ball's own response."""
    config = load_config(CONFIG)
    uno = Uno(elf, elf.parent, ball())
    rigs: dict[str, Callable[[], Rig]] = {
        "in process": lambda: open_rig(twin_of(config.rig), u_range=(0.0, 10.0), u_safe=0.0),
        "firmware": lambda: VirtualRig(uno),
    }
    title = "Bode points of the ball, against its own response"
    table = Table("run", "omega [rad/s]", "gain error [%]", "phase error [deg]", "as dead time [ms]", title=title)
    truth = make_plant("ball")
    with tempfile.TemporaryDirectory() as folder:
        for name, make in rigs.items():
            points: tuple[FrequencyPoint, ...] = run_experiment(make(), config, Path(folder) / f"{name}.csv").points
            for point in points:
                omega = point.omega_rad_s
                ratio = point.response / complex(truth.response(np.array([omega]))[0])
                phase = float(np.angle(ratio))
                row = (f"{omega:.3f}", f"{100 * (abs(ratio) - 1):+.2f}", f"{math.degrees(phase):+.2f}")
                table.add_row(name, *row, f"{-1e3 * phase / omega:+.1f}")
    return table


def main() -> None:
    """Print the three tables."""
    console = Console(highlight=False, width=110)
    with tempfile.TemporaryDirectory() as folder:
        elf = build_uno(Path(folder))
        console.print(switching(elf))
        console.print(lateness(int(os.environ.get("SERIAL_CYCLES", "3000"))))
        console.print(bode(elf))
