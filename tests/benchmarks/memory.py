"""Memory over hours of operation in virtual time: a PI holds the ball at 100 Hz, every row on the disk.

In process, and through the Modbus driver's register map, codecs, heartbeat and dead-man to a simulated device (without
sockets, whose time cannot be virtual). ``MEMORY_HOURS=8`` runs so long; one hour by default, about a minute. MB are
what the operating system holds for the process after a tenth of an hour, an hour, and at the end; *slope* is from the
first hour on, or within it.
"""

from __future__ import annotations

import gc
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from autotune.cli.served import device_of
from autotune.config import Config, load_config
from autotune.controller import PIDController
from autotune.experiment.limits import Watch
from autotune.experiment.loop import ControlLoop
from autotune.experiment.rig import Rig
from autotune.experiment.run import envelope_of
from autotune.experiment.verify import law_for
from autotune.recording import RecordingWriter
from drivers.register_link import Answer
from drivers.register_rig import RegisterRig
from drivers.registers import Block
from drivers.simulated import SimulatedRig
from sim.plant import Plant, make_plant
from sim.register_device import RegisterDevice

CONFIG = Path(__file__).parents[2] / "configs" / "ball_modbus_tcp.toml"
GAINS = PIDController(K=-0.025, Ti_s=3.6)
HOUR_S = 3600.0
WARM_H = 0.1


class VirtualLink:
    """A device's registers in process, on a clock that moves when somebody waits."""

    where = "virtual device"

    def __init__(self, device: RegisterDevice) -> None:
        self._device = device
        self._now_s = 0.0

    def now(self) -> float:
        """Return the virtual time [s]."""
        return self._now_s

    def sleep_until(self, t_s: float) -> None:
        """Let the device live until then [s]."""
        self._now_s = max(self._now_s, t_s)
        self._device.live(self._now_s)

    def connect(self) -> None:
        """Nothing to connect."""

    def disconnect(self) -> None:
        """Nothing to disconnect."""

    def distrust(self) -> None:
        """No answer is ever late."""

    def read(self, block: Block) -> Answer:
        """Return the block's words."""
        return Answer(self._device.read(block.table, block.address, block.count, self._now_s), False, 0.0)

    def write(self, table: str, address: int, words: Sequence[int]) -> bool:
        """Write words."""
        self._device.write(table, address, words, self._now_s)  # type: ignore[arg-type]  # a table's name
        return False


def in_process(config: Config, plant: Plant) -> Rig:
    """Return the ball on a virtual clock."""
    return SimulatedRig(plant, u_safe=config.limits.u_safe)


def on_registers(config: Config, plant: Plant) -> Rig:
    """Return the ball behind a register map."""
    limits, link = config.limits, VirtualLink(device_of(config, plant))
    registers = config.rig.registers  # type: ignore[union-attr]  # a Modbus configuration
    rig = RegisterRig(link, registers, u_range=(limits.u_min, limits.u_max), u_safe=limits.u_safe)
    rig._clock = link  # type: ignore[assignment]  # a clock too
    return rig


def held_mb() -> float:
    """Return the resident memory of this process [MB]."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def memory_over(make: Callable[[Config, Plant], Rig], hours: Sequence[float], progress: Progress) -> list[float]:
    """Return the memory at each of the hours [MB]."""
    given = load_config(CONFIG)
    config = given.model_copy(update={"limits": given.limits.model_copy(update={"time_s": 1e9})})
    plant = make_plant("ball", seed=1, start="afloat")
    rig = make(config, plant)
    law = law_for(GAINS, config.limits, config.signals.sample_time_s)
    found: list[float] = []
    task = progress.add_task(make.__name__, total=hours[-1])
    with tempfile.TemporaryDirectory() as folder:
        writer = RecordingWriter(Path(folder) / "long.csv", ("t", "u", "y"))
        with ControlLoop(rig=rig, envelope=envelope_of(config), writer=writer) as loop:
            loop.watch = Watch(y_centre=5.0)
            state = law.initial(plant.u_rest, 5.0, 5.0)
            while len(found) < len(hours):
                u, state = law.step(state, 5.0, loop.tick.y)
                tick = loop.step(loop.nearest(u))
                if tick.t_s >= HOUR_S * hours[len(found)]:
                    found.append(held_mb())
                if tick.k % 1000 == 0:
                    progress.update(task, completed=tick.t_s / HOUR_S)
    return found


def main() -> None:
    """Print the table."""
    hours = (WARM_H, 1.0, max(1.0, float(os.environ.get("MEMORY_HOURS", "1"))))
    table = Table("rig", *(f"{h:g} h [MB]" for h in hours), "slope [MB/h]", title="Memory in operation at 100 Hz")
    with Progress() as progress:
        for make in (in_process, on_registers):
            held = memory_over(make, hours, progress)
            slope = (held[-1] - held[1]) / (hours[-1] - hours[1]) if hours[-1] > 1.0 else held[-1] - held[0]
            table.add_row(make.__name__.replace("_", " "), *(f"{mb:.1f}" for mb in held), f"{slope:.2f}")
    Console(width=110).print(table)
