"""Compile the kernels that most tests run, each of them once, before tests start on several processors.

``python -m tests.compile_kernels``, as ``make unit`` does. Workers that start together on a fresh clone would each
compile all of them, as none finds yet what another is about to store. Where all is compiled, it takes seconds.
"""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

BALL = Path(__file__).resolve().parents[1] / "configs" / "ball_sim.toml"
PROCESSORS = 2


def compile_equations() -> None:
    """Simulate a model of equations, and look at its derivatives."""
    import autotune as at
    from autotune.equations.linearise import linearise
    from tests.autotune.equations.models import model

    lag = at.Model.from_equations({
        "input": [{"column": "u"}], "output": {"value": "x"}, "parameters": {"K": 2.0, "T": 0.5},
        "state": [{"name": "x", "derivative": "(K*u - x)/T"}],
    })  # fmt: skip
    at.simulate(lag, _record())
    linearise(model(), np.array([0.5]))


def compile_chain() -> None:
    """Simulate a chain of blocks with the lines of all effects."""
    import autotune as at

    at.simulate(at.Model.from_text("2/(0.5s + 1)"), _record())


def compile_run() -> None:
    """Commission the simulated ball: the rig, its points, the delay, the reduced model and the design."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "autotune", "run", str(BALL), "--out", f"{folder}/run"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder)


def compile_identification() -> None:
    """Identify a loop, and a dead time row by row."""
    import autotune as at

    record = _record()
    r = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 20), 10)
    loop = at.example("loop")
    at.closed_loop(loop, 2)
    answer = np.concatenate([[0.0], np.convolve(r, np.exp(-0.1 * np.arange(200)))[:199]])
    at.delay({**record, "u": r, "y": answer}, 1, method="online")


def compile_diagnosis() -> None:
    """Diagnose a chain."""
    import autotune as at

    at.diagnose(at.Model.from_text("1.8/(0.6s + 1)"), _record())


def _record() -> dict[str, np.ndarray]:
    t = 0.05 * np.arange(200)
    return {"t": t, "u": np.ones(200), "y": 2.0 * (1.0 - np.exp(-t / 0.5))}


def main() -> None:
    """Do all of them, as many at a time as there are processors in the smallest machine; the longest first."""
    every = (compile_equations, compile_identification, compile_run, compile_diagnosis, compile_chain)
    with ProcessPoolExecutor(PROCESSORS, mp_context=multiprocessing.get_context("spawn")) as pool:
        for done in [pool.submit(kernels) for kernels in every]:
            done.result()


if __name__ == "__main__":
    main()
