"""Lateness of the control loop with the live page and without, in one run: the conditions take turns of a few seconds.

A relay runs on a ball that lives in real time in this process, and every row goes to disk; the page reads the folder
in its own process, and ten pages are open in a Chromium on the same machine. Stopping the processes (SIGSTOP) is
"without"; stopping the browser alone is a browser too slow to take anything; reloading loads all ten pages anew.
The browser takes only the time that others leave (nice 19), as if it ran on another machine; LIVE_BROWSER_NICE=0 lets
it compete with the loop for the cores.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import psutil
from playwright.sync_api import Error, sync_playwright
from rich.console import Console
from rich.table import Table

from autotune.errors import AutotuneError
from autotune.experiment.loop import ControlLoop
from autotune.experiment.relay import RelaySettings, RelayState, relay_step
from autotune.experiment.result import State, Status
from autotune.experiment.rig import Reading
from autotune.experiment.run import envelope_of
from autotune.live.session import LivePage
from autotune.recording import RecordingWriter
from autotune.run_log import RunLog
from drivers.clock import MonotonicClock
from drivers.simulated import SimulatedRig
from sim.ball import make_ball
from tests.autotune.experiment.rigs import ball_config

PAGES = 10
PERIOD_S = float(os.environ.get("LIVE_PERIOD_S", "0.01"))
TURN_S = 5.0
#: the first part of a turn is not counted: what was stopped catches up
CATCH_UP_S = 1.0
CONDITIONS = ("without", "ten pages", "slow browser", "reloading")
RELAY = RelaySettings(y_centre=5.0, midpoint=5.0, amplitude=0.3, hysteresis=0.2, delay_samples=10, plant_sign=-1)


class RealTimeRig(SimulatedRig):
    """The simulated ball on the monotonic clock."""

    def __init__(self) -> None:
        super().__init__(make_ball(seed=1, noise=0.35, start="afloat"), u_safe=0.0)
        self.live(PERIOD_S)  # compiles it
        self._real = MonotonicClock()
        self._lived_s = 0.0

    @property
    def clock(self) -> MonotonicClock:  # type: ignore[override]
        """The monotonic clock."""
        return self._real

    def _catch_up(self) -> float:
        now_s = self._real.now()
        self.live(now_s - self._lived_s)
        self._lived_s = now_s
        return now_s

    def read(self) -> Reading:
        """Take one sample."""
        return Reading(t_s=self._catch_up(), y=self.plant.measure())

    def write(self, u: float) -> None:
        """Hold ``u`` [u unit] from now on."""
        self._catch_up()
        super().write(u)


def pages(url: str, count: int) -> None:
    """Open pages and reload them all whenever a line comes in; runs as a process of its own."""
    os.nice(int(os.environ.get("LIVE_BROWSER_NICE", "19")))
    with sync_playwright() as driver:
        options = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=options)
        opened = [browser.new_page() for _ in range(count)]
        for page in opened:
            page.goto(url)
        sys.stdout.write("open\n")
        sys.stdout.flush()
        for _ in sys.stdin:
            for page in opened:
                with contextlib.suppress(Error):  # the server was stopped in the middle of the one before
                    page.reload(wait_until="commit")


class Onlookers:
    """The page's process and the browser's processes, stopped and let go on."""

    def __init__(self, page: LivePage) -> None:
        self._server = page.process.pid
        script = f"from tests.benchmarks.live_lateness import pages; pages({page.url!r}, {PAGES})"
        self.browser = subprocess.Popen(
            [sys.executable, "-c", script],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        assert self.browser.stdout is not None
        self.browser.stdout.readline()
        family = (self.browser.pid, *(one.pid for one in psutil.Process(self.browser.pid).children(recursive=True)))
        self._groups = {os.getpgid(pid) for pid in family}

    def become(self, condition: str) -> None:
        """Bring about a condition."""
        for group in self._groups:
            os.killpg(group, signal.SIGSTOP if condition in ("without", "slow browser") else signal.SIGCONT)
        os.kill(self._server, signal.SIGSTOP if condition == "without" else signal.SIGCONT)
        if condition == "reloading":
            assert self.browser.stdin is not None
            self.browser.stdin.write("\n")
            self.browser.stdin.flush()

    @property
    def cpu_s(self) -> float:
        """Processor time that the page's process has taken [s]."""
        times = psutil.Process(self._server).cpu_times()
        return float(times.user + times.system)

    def leave(self) -> None:
        """End all of them."""
        self.become("ten pages")
        for group in self._groups:
            os.killpg(group, signal.SIGKILL)
        self.browser.wait()
        os.kill(self._server, signal.SIGTERM)


def measure(folder: Path, rounds: int) -> tuple[dict[str, list[np.ndarray]], dict[str, float]]:
    """Return the lateness of every sample [s], turns by condition, and the processor time of the page [s]."""
    wide = {"time_s": 1e6, "swing": 100.0, "y_min": -100.0, "y_max": 100.0}
    config = ball_config(limits=wide, signals={"sample_time_s": PERIOD_S})
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    taken: dict[str, float] = defaultdict(float)
    with RunLog(folder / "progress.jsonl") as log, LivePage(folder, "127.0.0.1", 0, None) as page:
        log.begin(config)
        writer = RecordingWriter(log.recording(folder / "recording.csv"), ("t", "u", "y"))
        onlookers, tell, rng = Onlookers(page), log.also(None), np.random.default_rng(0)
        try:
            with ControlLoop(rig=RealTimeRig(), envelope=envelope_of(config), writer=writer) as loop:
                for turn in range(rounds):
                    for condition in map(str, rng.permutation(CONDITIONS)):
                        onlookers.become(condition)
                        tell(progress(loop.tick.t_s, f"{condition}, turn {turn}"))
                        before_s = onlookers.cpu_s
                        found[condition].append(lateness(loop))
                        taken[condition] += onlookers.cpu_s - before_s
        finally:
            onlookers.leave()
    return found, taken


def lateness(loop: ControlLoop) -> np.ndarray:
    """Run the relay for a turn and return how late its samples were, (N,) [s]."""
    start_s, state, times = loop.tick.t_s, RelayState(), [loop.tick.t_s]
    while times[-1] < start_s + TURN_S:
        state, u = relay_step(state, RELAY, loop.tick.y)
        times.append(loop.step(loop.nearest(u)).t_s)
    t = np.array(times)
    return np.asarray((t % PERIOD_S)[t > start_s + CATCH_UP_S])


def progress(elapsed_s: float, message: str) -> Status:
    """Return what a run tells at a change."""
    return Status(state=State.SWEEP, elapsed_s=elapsed_s, remaining_s=math.nan, message=message, relay=RELAY)


def ratio_interval(with_: Sequence[float], without: Sequence[float]) -> tuple[float, float]:
    """Return a 95 % interval of the ratio of mean lateness, by resampling rounds."""
    rng = np.random.default_rng(0)
    pairs = np.array([with_, without])
    draws = [pairs[:, rng.integers(0, pairs.shape[1], pairs.shape[1])].mean(axis=1) for _ in range(2000)]
    ratios = [draw[0] / draw[1] for draw in draws]
    return float(np.quantile(ratios, 0.025)), float(np.quantile(ratios, 0.975))


def main() -> None:
    """Print the table of lateness."""
    console = Console(highlight=False, width=120)
    if shutil.which("chromium") is None:
        console.print("live_lateness needs chromium: apt-get install chromium")
        return
    rounds = int(os.environ.get("LIVE_ROUNDS", "8"))
    start_s = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        try:
            found, taken = measure(Path(folder), rounds)
        except AutotuneError as error:
            console.print(f"stopped: {error}")
            return
    table = Table(
        "onlookers", "samples", "median [us]", "mean [us]", "p99 [us]", "worst [us]",
        "mean / without", "95 %", "page's CPU",
        title=f"Lateness of a {1e3 * PERIOD_S:g} ms loop, {rounds} turns of {TURN_S - CATCH_UP_S:g} s",
    )  # fmt: skip
    base = [float(turn.mean()) for turn in found["without"]]
    for name, turns in found.items():
        late = 1e6 * np.concatenate(turns)
        means = [float(turn.mean()) for turn in turns]
        low, high = ratio_interval(means, base)
        spread = (np.median(late), late.mean(), np.quantile(late, 0.99), late.max())
        cells = [f"{value:.0f}" for value in spread]
        table.add_row(
            name,
            str(late.size),
            *cells,
            f"{np.mean(means) / np.mean(base):.2f}",
            f"{low:.2f} to {high:.2f}",
            f"{100 * taken[name] / (TURN_S * rounds):.0f} %",
        )
    console.print(table)
    medians = {name: float(np.median(np.concatenate(turns))) for name, turns in found.items()}
    worst = max(value / medians["without"] for value in medians.values())
    console.print(
        f"largest ratio of medians {worst:.3f} (wanted: at most 1.10), {time.process_time() - start_s:.0f} s of CPU"
    )
    console.print(f"{os.cpu_count()} cores, load over the last minute {os.getloadavg()[0]:.1f}")
