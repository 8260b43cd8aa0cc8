"""Twins of ``init``: textbook plants from the answers of a person to "accepted", and a rehearsal of each kind of rig.

A rehearsal is ``autotune run --dry-run`` of a configuration that ``init`` wrote of a real rig with a twin.

Each plant is written as people write transfer functions, given to ``autotune init --kind simulated --model`` with the
answers that a person would give who knows what it is, and run by ``autotune run`` as ``init`` says. The answers follow
one rule, whatever the plant: the command goes from 0 to 10 V and holds the plant at 5 V; the measurement may go as far
as the plant answers to half of that, an integrator as far as it goes in four of its times under half of it; it is left
at the command that holds it; it is sampled forty times in its time, the sum of its lags and dead time.

``TWINS=3`` runs every third plant; ``TWIN=oscillating`` those whose name has the pattern in it; ``SEEDS=3`` each with
the noise of three seeds, ``FIRST_SEED`` and those after it.
"""

from __future__ import annotations

import os
import re
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from typer.testing import CliRunner

from autotune.cli import app

#: samples in a plant's time
SAMPLES = 40.0


@dataclass(frozen=True, kw_only=True)
class TextbookPlant:
    """A plant of the grid.

    Attributes
    ----------
    name : str
        What it is.
    written : str
        Its transfer function as people write it.
    gain : float
        What y goes by for a volt, at rest; of an integrator, per second [y unit, y unit/s].
    time_s : float
        Sum of its lags and dead time [s].
    is_integrating : bool
        Whether y runs on under a constant command.
    """

    name: str
    written: str
    gain: float
    time_s: float
    is_integrating: bool = False

    @property
    def answers(self) -> list[str]:
        """What a person answers to ``init``."""
        reach = 5.0 * abs(self.gain) * (4.0 * self.time_s if self.is_integrating else 1.0)
        return [
            *("--sample-time", f"{self.time_s / SAMPLES:.2g}", "--u-unit", "V", "--y-unit", "cm"),
            *("--u-range", "0", "10", "--u-safe", "5", "--u", "5"),
            *("--y-range", f"{-reach:g}", f"{reach:g}", "--y", "0"),
        ]


def _of(name: str, written: str, gain: float, time_s: float, is_integrating: bool = False) -> TextbookPlant:
    return TextbookPlant(name=name, written=written, gain=gain, time_s=time_s, is_integrating=is_integrating)


PLANTS = (
    _of("one lag", "2/(s+1)", 2.0, 1.0),
    _of("one slow lag, small gain", "0.001/(3600s+1)", 1e-3, 3600.0),
    _of("one lag, dead time a tenth", "5/(10s+1) e^-1s", 5.0, 11.0),
    _of("one fast lag, dead time of one lag", "1000/(0.05s+1) e^-0.05s", 1e3, 0.1),
    _of("one lag, dead time of three lags", "0.5/(2s+1) e^-6s", 0.5, 8.0),
    _of("falling with u", "-3/(20s+1) e^-4s", -3.0, 24.0),
    _of("two lags", "2/((s+1)(0.5s+1))", 2.0, 1.5),
    _of("two equal lags, fast", "10/((0.05s+1)^2)", 10.0, 0.1),
    _of("two lags, an hour and minutes", "0.05/((3600s+1)(300s+1))", 0.05, 3900.0),
    _of("two lags and dead time", "100/((30s+1)(10s+1)) e^-15s", 100.0, 55.0),
    _of("three equal lags", "1/(s+1)^3", 1.0, 3.0),
    _of("three lags", "0.01/((60s+1)(20s+1)(5s+1))", 0.01, 85.0),
    _of("three lags and dead time of three", "4/((5s+1)(3s+1)(s+1)) e^-15s", 4.0, 24.0),
    _of("integrator and lag", "2/(s(0.3s+1))", 2.0, 0.3, True),
    _of("integrator and dead time", "0.001/s e^-60s", 1e-3, 60.0, True),
    _of("integrator, lag and dead time", "-65.5/(s(0.36s+1)) e^-0.1s", -65.5, 0.46, True),
    _of("inverse response", "2(1-0.5s)/((2s+1)(s+1))", 2.0, 3.5),
    _of("inverse response and dead time", "1(1-20s)/((60s+1)(30s+1)) e^-10s", 1.0, 120.0),
    _of("oscillating", "3/(s^2+0.6s+1)", 3.0, 1.0),
    _of("oscillating, lag and dead time", "20/((4s^2+1.2s+1)(s+1)) e^-1s", 20.0, 4.0),
)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a plant: whether its loop was accepted, what was said, and how long that took [s]."""

    accepted: bool
    said: str
    seconds: float


#: how a rig of each kind is reached; what the twin does not need is made up
REACHED = {
    "modbus_tcp": ("--host", "10.0.0.2"),
    "modbus_tls": ("--host", "10.0.0.2"),
    "modbus_rtu": ("--device", "/dev/ttyUSB0"),
    "opcua": ("--endpoint", "opc.tcp://10.0.0.2:4840", "--y-node", "ns=2;s=y", "--u-node", "ns=2;s=u"),
    "s7": ("--host", "10.0.0.2", "--y-place", "DB10.DBD0", "--u-place", "DB10.DBD4"),
    "serial": ("--device", "/dev/ttyACM0", "--y-span", "-50", "50", "--u-span", "0", "10"),
}
REGISTERS = ("--y-register", "input:0:float32", "--u-register", "holding:0:float32")


def run_twin(plant: TextbookPlant, folder: Path, kind: str = "simulated", seed: int = 0) -> Outcome:
    """Write the plant's configuration with ``init``, run it or its twin, and return what was said.

    Parameters
    ----------
    plant : TextbookPlant
        With the answers to ``init``.
    folder : Path
        Holds the configuration and what the run writes.
    kind : str
        How the rig is reached; any but "simulated" is rehearsed on its twin.
    seed : int
        Draws the sensor's noise.
    """
    config, began_s = folder / "rig.toml", time.monotonic()
    reached = (*REACHED.get(kind, ()), *(REGISTERS if kind.startswith("modbus") else ()))
    written, said = _call("init", str(config), "--kind", kind, *reached, "--model", plant.written, *plant.answers)
    if written:
        config.write_text(re.sub(r"^#: seed = 0", f"seed = {seed}", config.read_text(), flags=re.MULTILINE))
        dry = () if kind == "simulated" else ("--dry-run",)
        _, said = _call("run", str(config), "--out", str(folder / "out"), *dry)
    lines = [line for line in said.splitlines() if line.strip()]
    verdict = next((line for line in lines if line.startswith("Accepted")), lines[-1] if lines else "")
    return Outcome(accepted=verdict.startswith("Accepted"), said=verdict, seconds=time.monotonic() - began_s)


def _call(*arguments: str) -> tuple[bool, str]:
    done = CliRunner().invoke(app, [*arguments], standalone_mode=False)
    said = done.output if done.exception is None else f"{done.output}\n{done.exception}"
    return done.exception is None, said


def main() -> None:
    """Print a line for each plant and each rehearsal as it is done, and how many were accepted."""
    wanted, every = os.environ.get("TWIN", ""), int(os.environ.get("TWINS", "1"))
    first = int(os.environ.get("FIRST_SEED", "0"))
    seeds = range(first, first + int(os.environ.get("SEEDS", "1")))
    runs = [(plant.name, plant, "simulated") for plant in PLANTS[::every]]
    runs += [(f"--dry-run of {kind}", PLANTS[2], kind) for kind in REACHED]
    runs = [run for run in runs if re.search(wanted, run[0])]
    accepted = 0
    for name, plant, kind in runs:
        for seed in seeds:
            with tempfile.TemporaryDirectory() as folder:
                outcome = run_twin(plant, Path(folder), kind, seed)
            accepted += outcome.accepted
            said = f"{name}: {plant.written}, seed {seed}, {outcome.seconds:.0f} s: {outcome.said}"
            print(said, flush=True)
    print(f"accepted: {accepted} of {len(runs) * len(seeds)}")
