"""From files as people have them to a controller by one command: load error beside the best PI on the true plant.

``FRONT_DOOR=oven_step,servo`` in the environment takes the files whose names begin so; all when absent.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from functools import cache
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from autotune.cli import app
from autotune.controller import PIDController
from autotune.design.load_error import load_step
from autotune.design.margins import margins
from autotune.design.specification import Specification
from autotune.design.synthesis import design
from autotune.models import TransferFunction
from tests.benchmarks._front_door_files import DOORS

#: so large that noise does not limit the best PI, which has the margins alone to keep
_NO_NOISE = 1e4


@cache
def best(plant: TransferFunction) -> PIDController:
    """Return the PI of least load error with the default margins on a plant that is known."""
    return design(plant, Specification(noise_gain=_NO_NOISE, criterion="iae"), "pi", certificate=False).controller


def load_error(plant: TransferFunction, controller: PIDController) -> float:
    """Return the integral of the absolute error after a unit step of load; infinite where the loop is not stable."""
    found = margins(plant, controller)
    if not found.stable:
        return math.inf
    gains = np.array([controller.K, controller.Ti_s, controller.Td_s, controller.Tf_s])
    return load_step(plant.response, gains, found.crossover_rad_s, plant.delay_s).error(gains)


def tuned(path: Path, out: Path) -> PIDController | str:
    """Return the controller that ``autotune tune FILE`` makes, or what it says instead."""
    answer = CliRunner().invoke(app, ["tune", str(path), "--out", str(out)])
    if answer.exit_code:
        return str(answer.exception)
    said = json.loads((out / "result.json").read_text(encoding="utf-8"))["controller"]
    return PIDController(**{name: said[name] or 0.0 for name in ("K", "Ti_s", "Td_s", "Tf_s")})


def main() -> None:
    """Print one row per file."""
    wanted = tuple(filter(None, os.environ.get("FRONT_DOOR", "").split(",")))
    print("| file | K | T_I [s] | best K | best T_I [s] | IAE over the best | M_m | phase [deg] | seconds |")
    print("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for door in DOORS:
            if wanted and not door.name.startswith(wanted):
                continue
            path = Path(folder) / door.name
            try:
                door.write(path)
            except ImportError as error:
                print(f"| {door.name} | not made: {error} |", flush=True)
                continue
            start = time.perf_counter()
            found, known = tuned(path, path.with_suffix(".out")), best(door.plant)
            seconds = time.perf_counter() - start
            if isinstance(found, str):
                print(f"| {door.name} | {found} |", flush=True)
                continue
            kept = margins(door.plant, found)
            ratio = load_error(door.plant, found) / load_error(door.plant, known)
            print(
                f"| {door.name} | {found.K:.4g} | {found.Ti_s:.4g} | {known.K:.4g} | {known.Ti_s:.4g} | {ratio:.3f} "
                f"| {kept.modulus:.3f} | {math.degrees(kept.phase_rad):.1f} | {seconds:.1f} |",
                flush=True,
            )
