"""Runs on the ball behind Modbus TCP, with and without four busy processes beside them: how many are accepted.

The served rig stands for a device with a processor of its own: it has real-time priority where the system grants that.

``RUNS=3 python -m tests.benchmarks busy``: so many of each; ten where nothing is said. ``BUSY=4``: with four busy
processes only. What else the computer does is told by its load beside each run.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path

from tests.drivers.test_rig_commands import free_port

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "ball_modbus_tcp.toml"
BUSY = 4


def main() -> None:
    """Print a line for each run, and how many were accepted."""
    runs = int(os.environ.get("RUNS", "10"))
    for busy in map(int, os.environ["BUSY"].split(",")) if "BUSY" in os.environ else (0, BUSY):
        accepted = sum(_run(busy) for _ in range(runs))
        print(f"{busy} busy processes: {accepted} of {runs} accepted", flush=True)


def _first() -> None:
    """Let this process run before all others."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))


def _run(busy: int) -> bool:
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / "rig.toml"
        text = re.sub(r"port = \d+", f"port = {free_port()}", CONFIG.read_text())
        path.write_text(text.replace("points = 5", "points = 3").replace("budget_s = 58.0", "budget_s = 36.0"))
        for _ in range(busy):
            stack.callback(subprocess.Popen([sys.executable, "-c", "while True: pass"]).kill)
        command = [sys.executable, "-m", "autotune.cli"]
        served = subprocess.Popen([*command, "rig", str(path)], stdout=subprocess.PIPE, text=True, preexec_fn=_first)
        stack.callback(served.kill)
        assert served.stdout is not None
        served.stdout.readline()  # it serves
        began_s = time.monotonic()
        out = Path(folder) / "out"
        done = subprocess.run([*command, "run", str(path), "--out", str(out)], capture_output=True, text=True)
        timing = {}
        if (out / "result.json").exists():
            timing = json.loads((out / "result.json").read_text())["experiment"].get("timing", {})
        said = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
        line = next((text for text in said if text.startswith("Accepted")), said[-1] if said else "")
        took = f"{time.monotonic() - began_s:.0f} s, load {os.getloadavg()[0]:.0f}"
        print(f"  {busy} busy, {took}, missed {timing.get('missed')}: {line[:160]}", flush=True)
        return done.returncode == 0


if __name__ == "__main__":
    main()
