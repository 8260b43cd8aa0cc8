"""The relay experiment on the simulated ball, many seeds: errors, coverage, efficiency, rig time, where the ball went.

``SEEDS=200 python -m tests.benchmarks relay_points`` runs the full count; 50 seeds by default.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from autotune.arrays import FloatArray
from autotune.batch.engine import cluster, run_all
from autotune.config import load_config
from autotune.errors import AutotuneError
from autotune.experiment.result import ExperimentResult, Segment
from autotune.experiment.run import run_experiment
from autotune.identification.frequency.harmonics import held_coefficients
from autotune.recording import read_recording
from drivers.simulated import SimulatedRig
from sim.ball import FLOOR, Ball, make_ball

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "ball_sim.toml"
NOISE_HALF = 0.35
NOISE_SD = NOISE_HALF / math.sqrt(3.0)
CHI2_95 = -2.0 * math.log(0.05)


class WatchedRig(SimulatedRig):
    """A simulated rig that notes where the ball really is."""

    def __init__(self, ball: Ball) -> None:
        super().__init__(ball, u_safe=0.0)
        self.ball = ball
        self.heights: list[float] = []

    def live(self, dt_s: float) -> None:
        super().live(dt_s)
        self.heights.append(self.ball.height)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One seed: relative errors, chi-square of each point, mean square error over the bound, times, excursions."""

    errors: FloatArray
    phases_deg: FloatArray
    chi2: FloatArray
    square_error: FloatArray
    bound: FloatArray
    afloat_s: float
    cpu_s: float
    swing: float
    low: float
    high: float


def bound(segment: Segment, recording: Path) -> float:
    """Cramer-Rao bound of the complex gain, trace: white noise of the true variance, the rows that were used.

    Unknown besides the gain at the fundamental: offset and slope of y. The command counts as known.
    """
    rows = read_recording(recording).between(segment.start_s, segment.end_s)
    omega = segment.point.omega_rad_s
    x = rows.t - rows.t.mean()
    basis = np.column_stack([2 * np.cos(omega * x), -2 * np.sin(omega * x), np.ones_like(x), x])
    covariance = NOISE_SD**2 * np.linalg.inv(basis.T @ basis)[:2, :2]
    level = held_coefficients(rows.t, rows.u, np.array([omega]), segment.start_s, segment.end_s)[0]
    return float(np.trace(covariance)) / abs(level) ** 2


def outcome(seed: int, folder: Path) -> Outcome:
    rig = WatchedRig(make_ball(seed=seed, noise=NOISE_HALF))
    recording = folder / f"{seed}.csv"
    start = time.process_time()
    result = run_experiment(rig, load_config(CONFIG), recording)
    cpu_s = time.process_time() - start
    return scored(result, rig, recording, cpu_s)


def load_kernels() -> None:
    """Compile, or load from the disk, before processor time is taken."""
    with tempfile.TemporaryDirectory() as folder:
        outcome(0, Path(folder))


def scored(result: ExperimentResult, rig: WatchedRig, recording: Path, cpu_s: float) -> Outcome:
    points = [segment.point for segment in result.segments]
    truth = rig.ball.response(np.array([point.omega_rad_s for point in points]))
    misses = np.array([point.response for point in points]) - truth
    chi2 = []
    for point, miss in zip(points, misses, strict=True):
        vector = np.array([miss.real, miss.imag])
        chi2.append(vector @ np.linalg.solve(np.array(point.covariance), vector))
    heights = np.array(rig.heights)
    step_s = load_config(CONFIG).signals.sample_time_s
    floats = int(np.argmax(heights < FLOOR))
    inside = int(np.argmax(heights < 9.0))
    sweep = int(result.segments[0].start_s / step_s)
    end = int((result.first_move_s + result.sweep_time_s) / step_s)
    return Outcome(
        errors=misses / truth,
        phases_deg=np.degrees(np.angle(-truth)),
        chi2=np.array(chi2),
        square_error=np.abs(misses) ** 2,
        bound=np.array([bound(segment, recording) for segment in result.segments]),
        afloat_s=end * step_s - floats * step_s,
        cpu_s=cpu_s,
        swing=float(np.max(np.abs(heights[sweep:end] - 5.0))),
        low=float(heights[inside:end].min()),
        high=float(heights[inside:end].max()),
    )


def main() -> None:
    seeds = int(os.environ.get("SEEDS", "50"))
    first = int(os.environ.get("FIRST_SEED", "1"))
    tasks = {f"seed {seed}": seed for seed in range(first, first + seeds)}
    with tempfile.TemporaryDirectory() as folder, cluster() as client:
        client.run(load_kernels)
        found = dict(run_all(client, partial(outcome, folder=Path(folder)), tasks, retries=0))
    failures = [f"{name}: {found.pop(name)}" for name in tasks if isinstance(found[name], AutotuneError)]
    outcomes = [found[name] for name in tasks if name in found]
    errors = np.array([one.errors for one in outcomes])
    gain = np.abs(np.abs(1.0 + errors) - 1.0)
    phase = np.abs(np.degrees(np.angle(1.0 + errors)))
    good = (gain <= 0.01) & (phase <= 1.0)
    chi2 = np.array([one.chi2 for one in outcomes])
    square, bounds = np.array([one.square_error for one in outcomes]), np.array([one.bound for one in outcomes])
    phases = np.array([one.phases_deg for one in outcomes])
    print(f"relay points on the ball, noise uniform +-{NOISE_HALF} V, 10 ms, hover voltage unknown: {seeds} seeds")
    columns = (
        ("phase [deg]", 22),
        ("gain rms [%]", 13),
        ("phase rms [deg]", 16),
        ("within 1 %, 1 deg", 18),
        ("cover", 7),
    )
    print(*(f"{name:>{width}}" for name, width in columns), f"{'mse/CRB':>8}")
    for i in range(errors.shape[1]):
        rms = 100 * float(np.sqrt(np.mean(gain[:, i] ** 2)))
        turn = float(np.sqrt(np.mean(phase[:, i] ** 2)))
        print(
            f"{phases[:, i].min():9.1f} .. {phases[:, i].max():8.1f} {rms:13.3f} {turn:16.3f}"
            f" {good[:, i].mean():18.3f} {(chi2[:, i] < CHI2_95).mean():7.3f}"
            f" {(square[:, i] / bounds[:, i]).mean():8.3f}"
        )
    print(f"points within 1 % and 1 deg: {good.mean():.3f}; all five of a seed: {good.all(axis=1).mean():.3f}")
    print(f"95 % regions cover: {(chi2 < CHI2_95).mean():.3f} of {chi2.size} points (0.93 to 0.97 wanted)")
    print(f"mean square error over the Cramer-Rao bound: {(square / bounds).mean():.3f} (at most 1.5 wanted)")
    longest = max(one.afloat_s for one in outcomes)
    typical = float(np.median([one.afloat_s for one in outcomes]))
    print(f"rig time from first float to last point: median {typical:.2f} s, at most {longest:.2f} s (60 s allowed)")
    print(f"largest departure in the sweep: {max(one.swing for one in outcomes):.2f} V (3 V allowed)")
    print(
        f"afloat the ball stayed within {min(one.low for one in outcomes):.2f} .."
        f" {max(one.high for one in outcomes):.2f} V (1 .. 9 V allowed)"
    )
    cpu = [one.cpu_s for one in outcomes]
    print(f"processor time per experiment: median {np.median(cpu):.2f} s, worst {max(cpu):.2f} s")
    print(f"failed seeds: {len(failures)}", *failures, sep="\n  ")
