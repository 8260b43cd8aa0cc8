"""Time of a diagnosis, in units of simulating its own recordings, and its memory.

``python -m tests.benchmarks diagnosis_speed``: a servo with dry friction (two recordings of 7,500 rows), tanks behind
a limited command (two of 3,000), and these with DIAGNOSIS_ROWS rows in two recordings (100,000). *simulations* is the
processor's time over that of one free run of the nominal chain through the rows, which hardly depends on the machine.

With DIAGNOSIS_BESIDE=DIR, another checkout with an environment ``.venv`` of its own, the short pairs are diagnosed
by both in turn, DIAGNOSIS_PAIRS times (5), and *beside* is the median of this one's time over the other's.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.table import Table

from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.simulation.assembly import assemble
from autotune.model_tables import write_model
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording
from tests.autotune.diagnosis.servo_rigs import servo_model, servo_recording

ROWS = int(os.environ.get("DIAGNOSIS_ROWS", "100000"))
PAIRS = int(os.environ.get("DIAGNOSIS_PAIRS", "5"))
BESIDE = os.environ.get("DIAGNOSIS_BESIDE", "")
#: What the other checkout runs, in its own folder: the time of one diagnosis after one that loads what is compiled.
ONCE = """
import sys, time
from autotune.diagnosis.diagnose import diagnose
from autotune.model_tables import read_model
from autotune.recording import read_recording
model, *paths = sys.argv[1:]
recordings = [read_recording(path) for path in paths]
for _ in range(2):
    begin = time.process_time()
    diagnose(read_model(model), recordings)
print(time.process_time() - begin)
"""

Case = tuple[Model, list[Recording]]


def servo(rows: int) -> Case:
    def friction(x: float, v: float) -> float:
        return -0.12 * float(np.tanh(50.0 * v))

    return servo_model(), [servo_recording(seed, friction, rows=rows) for seed in (1, 2)]


def tank(rows: int) -> Case:
    """Two lags behind a command that is held within 0.6."""
    blocks = tuple(
        Block(name=name, place="plant", dynamics=TransferFunction(num=(gain,), den=(lag_s, 1.0)))
        for name, gain, lag_s in (("upper", 1.8, 2.2), ("lower", 1.0, 0.5))
    )
    nominal = Model(name="tanks", input=Port(unit="V"), output=Port(unit="V"), blocks=blocks)
    sim, recordings = assemble(nominal), []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        t, u = 0.1 * np.arange(rows), np.repeat(rng.uniform(-1.0, 1.0, rows // 60 + 1), 60)[:rows]
        run = sim.run(Recording(t=t, u=np.clip(u, -0.6, 0.6), y=0.0 * t), np.zeros(2), signals=1)[0][:, 0]
        recordings.append(Recording(t=t, u=u, y=run + 0.01 * rng.standard_normal(rows)))
    return nominal, recordings


def _run_s(case: Case) -> float:
    """Return the processor's time of one free run through all recordings [s]."""
    model, recordings = case
    sim, rest, times = assemble(model), [], 20
    for r in recordings:
        rest.append(sim.rest_state(float(r.u[0]), float(r.y[0]), r.sample_time_s))
        sim.run(r, rest[-1], signals=1)
    begin = time.process_time()
    for _ in range(times):
        for r, x in zip(recordings, rest, strict=True):
            sim.run(r, x, signals=1)
    return (time.process_time() - begin) / times


def _beside(case: Case) -> str:
    """Return the median of this checkout's time over the other's, each run in an interpreter of its own."""
    model, recordings = case
    ratios = []
    with TemporaryDirectory() as folder:
        paths = [Path(folder) / "model.toml"]
        write_model(model, paths[0])
        for i, r in enumerate(recordings):
            paths.append(Path(folder) / f"recording_{i}.csv")
            table = np.column_stack([r.t, r.u, r.y])
            np.savetxt(paths[-1], table, delimiter=",", header="t,u,y", comments="")
        here = (sys.executable, Path(__file__).parents[2])
        there = (str(Path(BESIDE).absolute() / ".venv" / "bin" / "python"), Path(BESIDE))
        for number in range(PAIRS):
            took = {}
            for python, where in (here, there) if number % 2 else (there, here):
                command = [python, "-c", ONCE, *map(str, paths)]
                took[python] = float(
                    subprocess.run(command, cwd=where, capture_output=True, check=True, text=True).stdout
                )
            ratios.append(took[here[0]] / took[there[0]])
    return f"{np.median(ratios):.2f}"


def main() -> None:
    cases: list[tuple[str, Callable[[int], Case], int, bool]] = [
        ("servo with dry friction", servo, 7500, True), ("tank, limited command", tank, 3000, True),
        ("tank, limited command", tank, ROWS // 2, False),
    ]  # fmt: skip
    view = Table(title="Time of a diagnosis")
    for column in ("case", "rows", "named", "wall s", "processor s", "simulations", "MB at most", "beside"):
        view.add_column(column, justify="left" if column in ("case", "named") else "right")
    diagnose(*tank(600))
    for name, made, rows, is_short in cases:
        case = made(rows)
        wall, spent = time.perf_counter(), time.process_time()
        found = diagnose(*case)
        wall, spent = time.perf_counter() - wall, time.process_time() - spent
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        view.add_row(
            name, f"2 x {rows}", ", ".join(e.name for e in found.effects), f"{wall:.1f}", f"{spent:.1f}",
            f"{spent / _run_s(case):.0f}", f"{peak:.0f}", _beside(case) if BESIDE and is_short else "",
        )  # fmt: skip
    Console().print(view)
