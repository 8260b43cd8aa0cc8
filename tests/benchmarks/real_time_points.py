"""The ball's Bode points over a real line in real time, against the truth and against the run in process.

Serves ``configs/ball_modbus_KIND.toml`` with ``autotune rig`` in a process of its own and runs the same experiment on
it, about 65 s of real time for each kind. ``REAL_TIME_KINDS="tcp rtu"`` chooses the lines; TCP by default. *region* is
the squared distance in standard deviations, below 5.99 in 95 % of points.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from autotune.config import Config, load_config
from autotune.config.rig import RigSettings
from autotune.errors import AutotuneError
from autotune.experiment.run import run_experiment
from autotune.points import FrequencyPoint
from drivers import open_rig, twin_of
from sim.plant import make_plant

CONFIGS = Path(__file__).parents[2] / "configs"


@contextmanager
def served(config: Path) -> Iterator[None]:
    """Serve the configuration's twin until the context ends."""
    command = [sys.executable, "-m", "autotune.cli", "rig", str(config)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("serving"):
                break
        try:
            yield
        finally:
            process.terminate()


def measured(config: Config, rig: RigSettings, folder: Path) -> tuple[FrequencyPoint, ...]:
    """Return the points of one experiment."""
    limits = config.limits
    opened = open_rig(rig, u_range=(limits.u_min, limits.u_max), u_safe=limits.u_safe)
    return run_experiment(opened, config, folder / f"{rig.kind}.csv").points


def distance(difference: complex, covariance: np.ndarray) -> float:
    """Return the squared distance in standard deviations."""
    vector = np.array([difference.real, difference.imag])
    return float(vector @ np.linalg.solve(covariance, vector))


def main() -> None:
    """Print the points of each line and how far they are from the truth."""
    console = Console(highlight=False, width=110)
    truth = make_plant("ball")
    for kind in os.environ.get("REAL_TIME_KINDS", "tcp").split():
        path = CONFIGS / f"ball_modbus_{kind}.toml"
        config = load_config(path)
        with tempfile.TemporaryDirectory() as folder:
            runs = {"in process": measured(config, twin_of(config.rig), Path(folder))}
            try:
                with served(path):
                    runs[f"Modbus {kind.upper()}"] = measured(config, config.rig, Path(folder))
            except AutotuneError as error:
                console.print(f"Modbus {kind.upper()}: {error}", markup=False)
        table = Table("run", "omega [rad/s]", "gain error [%]", "phase error [deg]", "region", title=config.name)
        for name, points in runs.items():
            for point in points:
                exact = complex(truth.response(np.array([point.omega_rad_s]))[0])
                ratio = point.response / exact
                error = distance(point.response - exact, np.array(point.covariance))
                table.add_row(
                    name,
                    f"{point.omega_rad_s:.3f}",
                    f"{100.0 * (abs(ratio) - 1.0):+.2f}",
                    f"{math.degrees(np.angle(ratio)):+.2f}",
                    f"{error:.2f}",
                )
        console.print(table)
