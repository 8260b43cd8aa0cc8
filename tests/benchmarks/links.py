"""One experiment over every link: do the ball's Bode points agree?

The configurations of ``configs/ball_*.toml``, which differ in their table ``[rig]`` only, are run in process, replayed
from the recording of that run, through the Modbus register map without a socket, and against the firmware in simavr
with the host in the loop and with the relay on the device, all in virtual time; then in real time, 65 s each, over the
lines that ``LINKS="tcp rtu tls serial"`` names (TCP by default; none where it is empty), each served by
``autotune rig`` in a process of its own.

A point is divided by the ball's own response at its frequency, so that points of different frequencies can be compared.
*truth* and *in process* are the points in whose 95 % regions these lie; points of all rows of a sweep share their
errors, so that a run has mostly all of them or few. *delay* is the dead time that the phases have too much.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from autotune.arrays import FloatArray
from autotune.config import Config, load_config
from autotune.config.rig import ReplaySettings, RigSettings
from autotune.errors import AutotuneError, InputError
from autotune.experiment.rig import Rig
from autotune.experiment.run import run_experiment
from autotune.points import FrequencyPoint
from drivers import open_rig, twin_of
from sim.plant import make_plant
from tests.benchmarks.memory import on_registers
from tests.benchmarks.relay_points import CHI2_95
from tests.drivers.bench import certificates_by_the_book
from tests.drivers.firmware_build import build_uno
from tests.drivers.simavr_bench import Uno, twin_ball, virtual_rig

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


def opened(config: Config, rig: RigSettings) -> Rig:
    """Return the rig of a table ``[rig]`` with the configuration's limits."""
    limits = config.limits
    return open_rig(rig, u_range=(limits.u_min, limits.u_max), u_safe=limits.u_safe)


def relative(point: FrequencyPoint) -> tuple[FloatArray, FloatArray]:
    """Return ln(G/H) as (gain, phase), H the ball's own response, and its covariance."""
    exact = complex(make_plant("ball").response(np.array([point.omega_rad_s]))[0])
    inverse = 1.0 / point.response
    turn = np.array([[inverse.real, -inverse.imag], [inverse.imag, inverse.real]])
    error = np.log(point.response / exact)
    return np.array([error.real, error.imag]), turn @ np.array(point.covariance) @ turn.T


def distance(error: FloatArray, covariance: FloatArray) -> float:
    """Return the squared distance in standard deviations."""
    return float(error @ np.linalg.solve(covariance, error))


def row(name: str, points: Sequence[FrequencyPoint], reference: Sequence[FrequencyPoint]) -> tuple[str, ...]:
    """Return the table's row of one link."""
    own, other = [relative(point) for point in points], [relative(point) for point in reference]
    truth = sum(distance(error, covariance) < CHI2_95 for error, covariance in own)
    pairs = zip(own, other, strict=True)
    alike = sum(distance(e1 - e2, c1 + c2) < CHI2_95 for (e1, c1), (e2, c2) in pairs)
    omega = np.array([point.omega_rad_s for point in points])
    weight = np.array([1.0 / covariance[1, 1] for _, covariance in own])
    phase = np.array([error[1] for error, _ in own])
    delay_ms = -1e3 * float(np.sum(weight * omega * phase) / np.sum(weight * omega**2))
    delay_sd_ms = 1e3 / float(np.sqrt(np.sum(weight * omega**2)))
    worst = max(float(np.hypot(*error)) for error, _ in own)
    return (
        name,
        f"{100 * worst:.2f}",
        f"{delay_ms:+.2f} +- {delay_sd_ms:.2f}",
        f"{truth} of {len(own)}",
        f"{alike} of {len(own)}",
    )


def virtual_runs(folder: Path) -> Iterator[tuple[str, tuple[FrequencyPoint, ...]]]:
    """Yield the links that run in virtual time, the run in process first."""
    config = load_config(CONFIGS / "ball_sim.toml")
    recording = folder / "in process.csv"
    yield "in process", run_experiment(opened(config, config.rig), config, recording).points
    replay = ReplaySettings(kind="replay", recording=str(recording))
    yield "replay", run_experiment(opened(config, replay), config, folder / "replay.csv").points
    config = load_config(CONFIGS / "ball_modbus_tcp.toml")
    twin = twin_of(config.rig)
    rig = on_registers(config, make_plant("ball", seed=twin.seed, noise=twin.noise))
    yield "Modbus registers", run_experiment(rig, config, folder / "registers.csv").points
    try:
        elf = build_uno(folder)
    except subprocess.CalledProcessError as error:
        said = error.stderr.decode(errors="replace").strip().splitlines() or ["make failed"]
        raise InputError(said[-1], where="firmware", remedy="apt install what .ci/packages lists") from None
    config = load_config(CONFIGS / "ball_serial.toml")
    for relay in ("host", "device"):
        rig = virtual_rig(Uno(elf, folder, twin_ball(config)), config, relay=relay)
        yield f"firmware, relay on the {relay}", run_experiment(rig, config, folder / f"{relay}.csv").points


def real_run(kind: str, folder: Path) -> tuple[FrequencyPoint, ...]:
    """Return the points over a line in real time."""
    name = "ball_serial.toml" if kind == "serial" else f"ball_modbus_{kind}.toml"
    text = (CONFIGS / name).read_text()
    if kind == "tls":
        text = text.replace('"certificates/', f'"{certificates_by_the_book(folder)}/')
    path = folder / name
    path.write_text(text)
    config = load_config(path)
    with served(path):
        return run_experiment(opened(config, config.rig), config, folder / f"{kind}.csv").points


def main() -> None:
    """Print the table."""
    console = Console(highlight=False, width=110)
    headers: tuple[Any, ...] = ("link", "worst error [%]", "delay [ms]", "truth", "in process")
    table = Table(*headers, title="Points over every link")
    reference: tuple[FrequencyPoint, ...] = ()
    missing: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        try:
            for name, points in virtual_runs(Path(folder)):
                reference = reference or points
                table.add_row(*row(name, points, reference))
        except InputError as error:
            missing.append(str(error))
        for kind in os.environ.get("LINKS", "tcp").split():
            try:
                table.add_row(*row(kind, real_run(kind, Path(folder)), reference))
            except AutotuneError as error:
                missing.append(f"{kind}: {error}")
    console.print(table)
    for line in missing:
        console.print(line, markup=False)
