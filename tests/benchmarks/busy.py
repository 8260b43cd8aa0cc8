"""Runs on the ball behind Modbus TCP, with and without four busy processes beside them: how many are accepted.

The served rig stands for a device with a processor of its own: it has real-time priority where the system grants that.
A line says how late it was nevertheless, beside how late the host was at most to a sample, to a command after it, and
with a reading on the link; a run that ended is counted as such, whoever was late.

``RUNS=3 python -m tests.benchmarks busy``: so many of each; ten where nothing is said. ``BUSY=4``: with four busy
processes only. What else the computer does is told by its load beside each run.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from contextlib import ExitStack
from pathlib import Path

from autotune.experiment.timing import Timing
from tests.drivers.tcp_relay import run_before_others
from tests.drivers.test_rig_commands import free_port

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "ball_modbus_tcp.toml"
BUSY = 4


def main() -> None:
    """Print a line for each run, and how many were accepted."""
    runs = int(os.environ.get("RUNS", "10"))
    for busy in map(int, os.environ["BUSY"].split(",")) if "BUSY" in os.environ else (0, BUSY):
        accepted = sum(_run(busy) for _ in range(runs))
        print(f"{busy} busy processes: {accepted} of {runs} accepted", flush=True)


def _run(busy: int) -> bool:
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / "rig.toml"
        text = re.sub(r"port = \d+", f"port = {free_port()}", CONFIG.read_text())
        path.write_text(text.replace("points = 5", "points = 3").replace("budget_s = 58.0", "budget_s = 36.0"))
        for _ in range(busy):
            stack.callback(subprocess.Popen([sys.executable, "-c", "while True: pass"]).kill)
        command = [sys.executable, "-m", "autotune.cli"]
        served = subprocess.Popen(
            [*command, "rig", str(path)], stdout=subprocess.PIPE, text=True, preexec_fn=run_before_others
        )
        stack.callback(served.kill)
        assert served.stdout is not None
        while not served.stdout.readline().startswith("serving"):
            assert served.poll() is None
        began_s = time.monotonic()
        out = Path(folder) / "out"
        done = subprocess.run([*command, "run", str(path), "--out", str(out)], capture_output=True, text=True)
        took = f"{time.monotonic() - began_s:.0f} s, load {os.getloadavg()[0]:.0f}"
        served.terminate()
        device_late = served.communicate()[0].strip().splitlines()[-1]
        said = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
        line = next((text for text in said if text.startswith("Accepted")), said[-1] if said else "")
        print(f"  {busy} busy, {took}, {_lateness(out)}; device {device_late}: {line[:160]}", flush=True)
        return done.returncode == 0


def _lateness(out: Path) -> str:
    """Say how late the host was at most in any of the run's recordings."""
    timings = [Timing.from_table(tomllib.loads(file.read_text()).get("timing", {})) for file in out.rglob("*.toml")]
    timings = [one for one in timings if one.rows]
    late, decision, reading = (
        f"{1e3 * max((getattr(one, name)[2] for one in timings), default=math.nan):.0f} ms"
        for name in ("lateness_s", "decision_s", "latency_s")
    )
    missed = sum(one.missed for one in timings)
    return f"missed {missed}, woken {late} late, decision {decision}, reading {reading}"


if __name__ == "__main__":
    main()
