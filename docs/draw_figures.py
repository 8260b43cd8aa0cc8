"""``make figures``: commission the simulated ball and draw the pictures of the pages from its files.

The curves are vector graphics; ``report.png`` and ``live.png`` are the run's own pages as Chromium shows them, where
there is one.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np

from autotune.cli.common import rig_of
from autotune.config import load_config
from autotune.experiment.judgement import Verification
from autotune.pipeline import tune
from autotune.recording import read_recording
from autotune.report.page import write_page
from autotune.report.run_page import run_page
from sim.ball import linear_ball

HERE = Path(__file__).resolve().parent
FIGURES = HERE / "figures"
CONFIG = HERE.parent / "configs" / "ball_sim.toml"
BLUE, ORANGE, GREEN, RED, GREY = "#3b82c4", "#d98200", "#0d9a72", "#d1495b", "#8a8a8a"


def main() -> None:
    """Run, then draw."""
    plt.rcParams |= {
        "svg.hashsalt": "relay-autotune", "font.size": 9.0, "axes.grid": True, "grid.alpha": 0.3,
        "axes.spines.top": False, "axes.spines.right": False, "figure.constrained_layout.use": True,
    }  # fmt: skip
    FIGURES.mkdir(exist_ok=True)
    config = load_config(CONFIG)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        out.mkdir()
        tuning = tune(rig_of(config), config, out)
        _limit_cycle(out)
        _bode(json.loads((out / "result.json").read_text(encoding="utf-8")))
        if tuning.verification is not None:
            _verification(tuning.verification)
        recordings = [read_recording(out / part.recording) for part in tuning.experiment.parts]
        write_page(run_page(config.name, config.signals, recordings, tuning, None), out / "report.html")
        _report(out / "report.html")
        _live(out, Path(folder) / "live")


def _save(figure: Any, name: str) -> None:
    figure.savefig(FIGURES / f"{name}.svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)


def _limit_cycle(out: Path) -> None:
    """Draw the last relay oscillation of the sweep, the slowest."""
    relay = tomllib.loads((out / "recording.toml").read_text(encoding="utf-8"))["relay"][-1]
    part = read_recording(out / "recording.csv").between(relay["start_s"], relay["end_s"])
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(7.0, 3.6), height_ratios=(2, 1))
    above.plot(part.t, part.y, color=BLUE, linewidth=0.8)
    above.axhline(relay["y_centre"], color=GREY, linestyle="--", linewidth=0.8)
    above.set_ylabel("y [V]")
    below.step(part.t, part.u, where="post", color=ORANGE, linewidth=1.0)
    below.set_ylabel("u [V]")
    below.set_xlabel("time [s]")
    _save(figure, "limit_cycle")


def _bode(result: dict[str, Any]) -> None:
    """Draw points with their 95 % intervals, the true plant, and the reduced model."""
    reduced, points = result["reduced_model"], result["points"]
    omega = np.geomspace(0.7, 8.0, 200)
    truth = linear_ball().response(omega)
    wd = reduced["omega_d_rad_s"]
    model = reduced["G_r"] / (1j * omega) * (wd - 1j * omega) / (wd + 1j * omega)
    at = np.array([point["omega_rad_s"] for point in points])
    gain = np.array([point["gain"] for point in points])
    sd = np.array([np.sqrt(0.5 * np.trace(point["cov"])) for point in points]) / gain
    phase = np.array([point["phase_deg"] for point in points])
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(7.0, 4.4))
    above.loglog(omega, np.abs(truth), color=GREY, label="true plant")
    above.loglog(omega, np.abs(model), color=ORANGE, linestyle="--", label="reduced model")
    above.errorbar(at, gain, 1.96 * sd * gain, fmt="o", color=BLUE, markersize=4, capsize=3, label="points, 95 %")
    above.set_ylabel("gain")
    above.legend()
    # the ball falls when the turbine pushes: the phase is that of the plant with positive gain
    below.semilogx(omega, np.degrees(np.unwrap(np.angle(-truth))), color=GREY)
    below.semilogx(omega, np.degrees(np.unwrap(np.angle(-model))), color=ORANGE, linestyle="--")
    below.errorbar(
        at, (phase + 180.0) % 360.0 - 360.0, np.degrees(1.96 * sd), fmt="o", color=BLUE, markersize=4, capsize=3
    )
    below.set_ylabel("phase of -P [deg]")
    below.set_xlabel("frequency [rad/s]")
    _save(figure, "bode")


def _verification(verification: Verification) -> None:
    """Draw the measured response to both steps in the band predicted beforehand."""
    test, prediction = verification.test, verification.prediction
    figure, axes = plt.subplots(figsize=(7.0, 3.0))
    label = "95 % band of the prediction"
    axes.fill_between(test.t, prediction.low, prediction.high, color=GREEN, alpha=0.2, linewidth=0, label=label)
    axes.plot(test.t[::4], verification.y[::4], color=BLUE, linewidth=0.5, alpha=0.7, label="measured")
    axes.plot(test.t, prediction.y, color=RED, linewidth=1.2, label="predicted")
    axes.step(test.t, test.setpoint, where="post", color=GREY, linestyle="--", label="set-point")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("y - operating point [V]")
    axes.legend(loc="upper right")
    _save(figure, "verification")


def _report(page: Path) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        print("report.png is left as it is: apt-get install chromium")
        return
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run(
            [
                chromium, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars",
                "--disable-background-networking", "--disable-component-update", "--disable-sync",
                f"--user-data-dir={profile}", "--virtual-time-budget=8000", "--window-size=1003,850",
                f"--screenshot={HERE / 'report.png'}", page.as_uri(),
            ],
            check=True, capture_output=True,
        )  # fmt: skip


def _live(out: Path, folder: Path) -> None:
    """Show the live page in the midst of the sweep."""
    chromium = shutil.which("chromium")
    if chromium is None or find_spec("playwright") is None or find_spec("nicegui") is None:
        print("live.png is left as it is: apt-get install chromium, pip install 'relay-autotune[live,test]'")
        return
    from playwright.sync_api import sync_playwright

    from autotune.live.session import LivePage

    folder.mkdir()
    events = (out / "progress.jsonl").read_text(encoding="utf-8").splitlines(keepends=True)
    until = next(i for i, event in enumerate(events) if "estimating all points together" in event)
    (folder / "progress.jsonl").write_text("".join(events[:until]), encoding="utf-8")
    now_s = json.loads(events[until])["elapsed_s"] - 1.0
    rows = (out / "recording.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    known = [row for row in rows if not row[0].isdigit() or float(row.split(",")[0]) < now_s]
    (folder / "recording.csv").write_text("".join(known), encoding="utf-8")
    with LivePage(folder, "127.0.0.1", 0, None) as live, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1500, "height": 900})
        page.goto(live.url)
        page.get_by_text("This page holds the controls").wait_for()
        page.wait_for_function("[...document.querySelectorAll('canvas')].every(c => c.toDataURL().length > 5000)")
        page.screenshot(path=HERE / "live.png")
        browser.close()


if __name__ == "__main__":
    main()
