"""The relay experiment on the simulated ball, many seeds: errors, coverage, efficiency, rig time, where the ball went.

``SEEDS=200 python -m tests.benchmarks relay_points`` runs the full count; 50 seeds by default. ``TOGETHER=0`` runs a
limit cycle for each point, and compares its error with the Cramer-Rao bound of the rows that were used.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.batch.engine import cluster, run_all
from autotune.config import Config, load_config
from autotune.errors import AutotuneError
from autotune.experiment.plan import phase_targets
from autotune.experiment.result import ExperimentResult, Segment
from autotune.experiment.run import run_experiment
from autotune.identification.frequency.harmonics import held_coefficients
from autotune.points import FrequencyPoint
from autotune.recording import read_recording
from drivers.simulated import SimulatedRig
from sim.ball import FLOOR, Ball, make_ball

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "ball_sim.toml"
NOISE_HALF = 0.35
NOISE_SD = NOISE_HALF / math.sqrt(3.0)
CHI2_95 = -2.0 * math.log(0.05)
TOGETHER = os.environ.get("TOGETHER", "1") != "0"


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
    """One seed: relative errors, phases and chi-square of its points, their bounds, times, excursions."""

    errors: FloatArray
    phases_deg: FloatArray
    chi2: FloatArray
    over_bound: FloatArray
    why: str
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


def config() -> Config:
    """Return the ball's configuration, with a limit cycle for each point where that is asked for."""
    given = load_config(CONFIG)
    return given.model_copy(
        update={"experiment": given.experiment.model_copy(update={"together": TOGETHER and given.experiment.together})}
    )


def outcome(seed: int, folder: Path) -> Outcome:
    rig = WatchedRig(make_ball(seed=seed, noise=NOISE_HALF))
    recording = folder / f"{seed}.csv"
    start = time.process_time()
    result = run_experiment(rig, config(), recording)
    cpu_s = time.process_time() - start
    return scored(result, rig, recording, cpu_s)


def load_kernels() -> None:
    """Compile, or load from the disk, before processor time is taken."""
    with tempfile.TemporaryDirectory() as folder:
        outcome(0, Path(folder))


def chi_square(points: Sequence[FrequencyPoint], truth: ComplexArray) -> FloatArray:
    """Return how far each point is from the truth, by its covariance."""
    found = []
    for point, miss in zip(points, np.array([point.response for point in points]) - truth, strict=True):
        vector = np.array([miss.real, miss.imag])
        found.append(float(vector @ np.linalg.solve(np.array(point.covariance), vector)))
    return np.array(found)


def scored(result: ExperimentResult, rig: WatchedRig, recording: Path, cpu_s: float) -> Outcome:
    points = result.points
    truth = rig.ball.response(np.array([point.omega_rad_s for point in points]))
    misses = np.array([point.response for point in points]) - truth
    heights = np.array(rig.heights)
    step_s = config().signals.sample_time_s
    floats = int(np.argmax(heights < FLOOR))
    inside = int(np.argmax(heights < 9.0))
    sweep = int(result.segments[0].start_s / step_s)
    end = int((result.first_move_s + result.sweep_time_s) / step_s)
    return Outcome(
        errors=misses / truth,
        phases_deg=np.degrees(np.angle(-truth)),
        chi2=chi_square(points, truth),
        over_bound=_over_bounds(result, rig, recording),
        why=result.by_itself,
        afloat_s=end * step_s - floats * step_s,
        cpu_s=cpu_s,
        swing=float(np.max(np.abs(heights[sweep:end] - 5.0))),
        low=float(heights[inside:end].min()),
        high=float(heights[inside:end].max()),
    )


def _over_bounds(result: ExperimentResult, rig: WatchedRig, recording: Path) -> FloatArray:
    """Return each limit cycle's square error over its bound."""
    truth = rig.ball.response(np.array([one.point.omega_rad_s for one in result.segments]))
    misses = np.array([one.point.response for one in result.segments]) - truth
    return np.abs(misses) ** 2 / np.array([bound(segment, recording) for segment in result.segments])


def main() -> None:
    seeds = int(os.environ.get("SEEDS", "50"))
    first = int(os.environ.get("FIRST_SEED", "1"))
    tasks = {f"seed {seed}": seed for seed in range(first, first + seeds)}
    with tempfile.TemporaryDirectory() as folder, cluster() as client:
        client.run(load_kernels)
        found = dict(run_all(client, partial(outcome, folder=Path(folder)), tasks, retries=0))
    failures = [f"{name}: {found.pop(name)}" for name in tasks if isinstance(found[name], AutotuneError)]
    outcomes = [found[name] for name in tasks if name in found]
    errors = np.concatenate([one.errors for one in outcomes])
    gain = np.abs(np.abs(1.0 + errors) - 1.0)
    phase = np.abs(np.degrees(np.angle(1.0 + errors)))
    good = (gain <= 0.01) & (phase <= 1.0)
    chi2 = np.concatenate([one.chi2 for one in outcomes])
    phases = np.concatenate([one.phases_deg for one in outcomes])
    ends = np.cumsum([one.errors.size for one in outcomes])[:-1]
    print(f"relay points on the ball, noise uniform +-{NOISE_HALF} V, 10 ms, hover voltage unknown: {seeds} seeds")
    columns = (
        ("phase [deg]", 22),
        ("gain rms [%]", 13),
        ("phase rms [deg]", 16),
        ("within 1 %, 1 deg", 18),
        ("cover", 7),
    )
    print(*(f"{name:>{width}}" for name, width in columns))
    targets = np.degrees(phase_targets(*config().experiment.phases_deg, config().experiment.points))
    nearest = np.argmin(np.abs(phases[:, None] - targets[None, :]), axis=1)
    for i in range(targets.size):
        here = nearest == i
        rms = 100 * float(np.sqrt(np.mean(gain[here] ** 2)))
        turn = float(np.sqrt(np.mean(phase[here] ** 2)))
        print(
            f"{phases[here].min():9.1f} .. {phases[here].max():8.1f} {rms:13.3f} {turn:16.3f}"
            f" {good[here].mean():18.3f} {(chi2[here] < CHI2_95).mean():7.3f}"
        )
    whole = np.array([one.all() for one in np.split(good, ends)])
    print(f"points within 1 % and 1 deg: {good.mean():.3f}; all of a seed: {whole.mean():.3f}")
    print(f"95 % regions cover: {(chi2 < CHI2_95).mean():.3f} of {chi2.size} points (0.93 to 0.97 wanted)")
    if TOGETHER:
        used = np.mean([not one.why for one in outcomes])
        sent = sorted({one.why for one in outcomes if one.why})
        print(f"estimated together: {used:.3f} of the seeds; else: {'; '.join(sent)}")
    else:
        over = float(np.mean(np.concatenate([one.over_bound for one in outcomes])))
        print(f"mean square error over the Cramer-Rao bound: {over:.3f} (at most 1.5 wanted)")
    longest = max(one.afloat_s for one in outcomes)
    typical = float(np.median([one.afloat_s for one in outcomes]))
    print(f"rig time from first float to last point: median {typical:.2f} s, at most {longest:.2f} s (30 s wanted)")
    print(f"largest departure in the sweep: {max(one.swing for one in outcomes):.2f} V (3 V allowed)")
    print(
        f"afloat the ball stayed within {min(one.low for one in outcomes):.2f} .."
        f" {max(one.high for one in outcomes):.2f} V (1 .. 9 V allowed)"
    )
    cpu = [one.cpu_s for one in outcomes]
    print(f"processor time per experiment: median {np.median(cpu):.2f} s, worst {max(cpu):.2f} s")
    print(f"failed seeds: {len(failures)}", *failures, sep="\n  ")
