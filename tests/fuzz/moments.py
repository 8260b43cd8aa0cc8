"""``python -m tests.fuzz.moments``: Ctrl-C, and a disk that fills, at random moments of commands that take their time.

After Ctrl-C: exit status 130, one line, and no half-written file. After a full disk: exit status 2 or 3, one line, no
half line, no result of 0 bytes, and once there is space again ``--resume`` comes to its end. Needs root for the disk.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from autotune.recording import read_recording
from tests.fuzz.sound import MODEL, POINTS

CONFIG = Path(__file__).parents[2] / "configs" / "ball_sim.toml"
COMMAND = (sys.executable, "-m", "autotune")
CAMPAIGN = 'name = "plant"\nfolder = "loops/*.csv"\n'


def inputs(folder: Path) -> None:
    """Write what the commands read: a model, points, and a recording of a lag under steps."""
    import tomli_w

    (folder / "model.toml").write_text(tomli_w.dumps(MODEL), encoding="utf-8")
    (folder / "points.json").write_text(json.dumps(POINTS), encoding="utf-8")
    rng = np.random.default_rng(1)
    t = 0.1 * np.arange(4000)
    u = np.repeat(rng.choice((-1.0, 1.0), 200), 20)
    y = np.zeros(t.size)
    for k in range(t.size - 1):
        y[k + 1] = y[k] + 0.1 * (2.0 * u[max(k - 3, 0)] - y[k])
    rows = np.column_stack([t, u, y + 0.01 * rng.standard_normal(t.size)])
    (folder / "loops").mkdir()
    for name in ("r.csv", "loops/a.csv", "loops/b.csv"):
        np.savetxt(folder / name, rows, fmt="%.8g", delimiter=",", header="t,u,y", comments="")
    (folder / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")


LONG: dict[str, tuple[str, ...]] = {
    "run": ("run", str(CONFIG), "--out", "out"),
    "tune": ("tune", "r.csv", "--out", "out"),
    "identify delay": ("identify", "delay", "r.csv", "--order", "1", "--out", "out/delay.json"),
    "identify closed-loop": ("identify", "closed-loop", "r.csv", "--out", "out/loop.json"),
    "watch": ("watch", "r.csv", "--out", "out/watch.csv"),
    "diagnose": ("diagnose", "--model", "model.toml", "r.csv", "--out", "out"),
    "batch": ("batch", "campaign.toml", "--out", "out", "--workers", "2"),
}


def interrupted(name: str, after_s: float) -> str:
    """Send Ctrl-C to a command and its children after a time, and return what was wrong with its end, or how it was."""
    with tempfile.TemporaryDirectory(prefix="autotune-moments-") as place:
        folder = Path(place)
        inputs(folder)
        process = subprocess.Popen(
            [*COMMAND, *LONG[name]], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True, env=os.environ | {"PYTHONFAULTHANDLER": "1"},
        )  # fmt: skip
        time.sleep(after_s)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGINT)
        try:
            _, said = process.communicate(timeout=120)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return "hang"
        if process.returncode == 0:
            return "over before"
        lines = [line for line in said.splitlines() if line.startswith("autotune: ")]
        noise = [line for line in said.splitlines() if "Traceback" in line or "Exception ignored" in line]
        unheard = process.returncode == -signal.SIGINT and not said.strip()  # no handler but the system's yet
        if unheard or ("KeyboardInterrupt" in said and "autotune" not in said):
            return "before its first line"  # the interpreter's own start, which is not the tool's to say anything of
        if process.returncode != 130:
            return f"exit {process.returncode} after {after_s:.2f} s: {said.strip()[:3000]}"
        if len(lines) != 1 or noise:
            return f"not one line after {after_s:.2f} s: {said.strip()[-300:]}"
        return half_written(folder / "out") or "one line"


def duration_s(name: str) -> float:
    """Return how long a command takes when nobody interrupts it, nor anything is compiled any more."""
    for _ in range(2):
        with tempfile.TemporaryDirectory(prefix="autotune-moments-") as place:
            inputs(Path(place))
            began_s = time.monotonic()
            subprocess.run([*COMMAND, *LONG[name]], cwd=place, capture_output=True, check=True)
            lasts_s = time.monotonic() - began_s
    return lasts_s


def half_written(out: Path) -> str:
    """Return what is only half there in a folder of results."""
    for file in out.rglob("*") if out.exists() else ():
        if ".part-" in file.name:
            return f"left {file.name}"
        if file.suffix == ".json":
            try:
                json.loads(file.read_text(encoding="utf-8"))
            except ValueError:
                return f"{file.name} is half written"
        if file.suffix == ".csv" and file.stat().st_size and not file.read_bytes().endswith(b"\n"):
            return f"{file.name} ends in half a line"
    return ""


@contextlib.contextmanager
def disk(size_kb: int) -> Iterator[Path]:
    """Yield a file system of this size."""
    with tempfile.TemporaryDirectory(prefix="autotune-disk-") as place:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "tmpfs", place], check=True)
        try:
            yield Path(place)
        finally:
            subprocess.run(["umount", "-l", place], check=True)


def filled(rng: random.Random) -> str:
    """Run on a disk that fills at a random moment, make room, resume; return what was wrong, or how it ended."""
    with disk(4000) as place:
        filler = place / "filler"
        filler.write_bytes(b"x" * (4000 - rng.randrange(1, 1600)) * 1024)
        return _run_and_resumed(place / "out", filler.unlink)


def small() -> str:
    """Run on a file system of 100 kB, enlarge it, resume; return what was wrong, or how it ended."""
    with disk(100) as place:
        enlarge = ["mount", "-o", "remount,size=8000k", str(place)]
        return _run_and_resumed(place / "out", lambda: subprocess.run(enlarge, check=True))


def _run_and_resumed(out: Path, make_room: Callable[[], object]) -> str:
    done = subprocess.run(
        [*COMMAND, "run", str(CONFIG), "--out", str(out)], capture_output=True, text=True, check=False
    )
    fault = _badly(done, (0, 2, 3))
    if fault or done.returncode == 0:
        return fault or "enough space"
    if (fault := half_written(out)) != "":
        return fault
    before = {file: file.read_bytes() for file in out.glob("recording*.csv")}
    for recording, rows in before.items():
        if rows.count(b"\n") > 2:
            read_recording(recording)
    make_room()
    if not (out / "config.toml").exists():
        shutil.rmtree(out, ignore_errors=True)
        again, before = ["run", str(CONFIG), "--out", str(out)], {}
    else:
        again = ["run", "--resume", str(out)]
    resumed = subprocess.run([*COMMAND, *again], capture_output=True, text=True, check=False)
    if resumed.returncode == 2 and "the run is complete" in resumed.stderr:
        return "complete, its page did not fit"
    if any(file.read_bytes() != rows for file, rows in before.items()):
        return "a recording was changed"
    return _badly(resumed, (0,)) or f"stopped with {done.returncode}, resumed"


def _badly(done: subprocess.CompletedProcess[str], well: tuple[int, ...]) -> str:
    lines = done.stderr.splitlines()
    if done.returncode not in well or "defect" in done.stderr or "Traceback" in done.stderr:
        return f"exit {done.returncode}: {done.stderr.strip()[-300:]}"
    return f"{len(lines)} lines: {done.stderr.strip()[-300:]}" if done.returncode and len(lines) != 1 else ""


def main() -> int:
    """Run the trials and print a table; the exit status says whether every one ended well."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=200, help="moments of Ctrl-C, and of the disk")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1e9, help="time after which no further trial begins")
    parser.add_argument("--without-disk", action="store_true")
    given = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell has its background jobs ignore it
    rng, ends = random.Random(given.seed), Counter[tuple[str, str]]()
    until_s = time.monotonic() + given.seconds
    names = [*LONG, *([] if given.without_disk else ["disk"] * 3)]
    latest_s = {name: duration_s(name) for name in LONG} | {"disk": 0.0}
    trials = [(name, rng.uniform(0.0, latest_s[name]), rng.random()) for name in islice(cycle(names), given.times)]
    trials += [] if given.without_disk else [("small disk", 0.0, 0.0)]

    def one(trial: tuple[str, float, float]) -> tuple[str, str]:
        name, after_s, seed = trial
        if time.monotonic() > until_s:
            return name, "not tried"
        if name == "small disk":
            return name, small()
        return name, filled(random.Random(seed)) if name == "disk" else interrupted(name, after_s)

    with ThreadPoolExecutor(given.workers) as pool:
        for name, end in pool.map(one, trials):
            ends[name, end] += 1
            print(f"{name}: {end}", flush=True)
    well = ("one line", "over before", "before its first line", "enough space", "resumed", "did not fit", "not tried")
    print("\n| command | end | times |\n|---|---|---|")
    for (name, end), times in sorted(ends.items()):
        print(f"| {name} | {end} | {times} |")
    return int(any(not end.endswith(well) for _, end in ends))


if __name__ == "__main__":
    sys.exit(main())
