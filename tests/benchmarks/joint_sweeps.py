"""Sweeps whose points are estimated together, beside a limit cycle for each: other plants, and classes violated.

Every plant is swept both ways on the same noise. *error* is the largest of a sweep's relative errors over the standard
deviation that is wanted, the median of its seeds; *covered* is the share of points within their 95 % regions, of all
sweeps, whichever way their points were made; *time* is the median of the sweeps' times, from the plant's first
answer on, over that of one by one, a limit cycle for each point; *to equal errors* it is multiplied by the square of
the ratio of the errors, since errors of noise fall with the root of the time.

``SEEDS=5`` runs each so often, 3 where nothing is said, from ``FIRST_SEED=1`` on; ``CASE=tanks`` those whose
name has the pattern in it; ``VIOLATED=1`` runs the ball's linear twin with play, a curve, a drift and a load instead.
"""

from __future__ import annotations

import os
import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import AutotuneError
from autotune.experiment.result import ExperimentResult
from autotune.experiment.run import run_experiment
from drivers.simulated import SimulatedRig
from tests.benchmarks._joint_plants import CASES, Case, LinearPlant
from tests.benchmarks.relay_points import CHI2_95, chi_square

VIOLATIONS: dict[str, dict[str, float]] = {
    "nothing": {},
    "play of 1 % of the range": {"play": 0.01},
    "play of 0.3 % of the range": {"play": 0.003},
    "curve of 5 %": {"curve": 0.05},
    "curve of 15 %": {"curve": 0.15},
    "drift of 0.5 % in ten periods": {"drift": 0.005},
    "drift of 2 % in ten periods": {"drift": 0.02},
    "load step of 0.5 %": {"load": 0.005},
    "load step of 2 %": {"load": 0.02},
}
#: plants whose class is violated: an integrator with a lag like the ball's, and two lags with dead time
VIOLATED = ("integrator, lag 1, dead time 0.05", "lags 1 and 0.3, dead time 0.2", "tanks (1.0, 0.5, 0.2), dead time")


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """One sweep: errors, regions, and time.

    Attributes
    ----------
    errors, chi2 : (P,) array
        Relative error of each point, and its chi-square by the point's covariance.
    jointly : bool
        Whether the 95 % region of all points together, in which a design keeps its margins, holds the truth.
    time_s : float
        From the plant's first answer to the last point, what was refused included [s].
    why : str
        Why the points are not of all rows together.
    """

    errors: FloatArray
    chi2: FloatArray
    jointly: bool
    time_s: float
    why: str


def outcome(case: Case, seed: int, *, together: bool) -> Outcome:
    """Sweep a plant."""
    plant = LinearPlant(case, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        rig = SimulatedRig(plant, u_safe=5.0)
        result = run_experiment(rig, case.config(together=together), Path(folder) / "sweep.csv")
    truth = _truth(result, plant)
    misses = np.array([point.response for point in result.points]) - truth
    apart = chi_square(result.points, truth)
    shared = 1.0 if result.together is None else result.together.fit.shared_errors
    return Outcome(
        errors=np.abs(misses / truth),
        chi2=apart,
        jointly=float(apart.sum()) <= shared * chi2.ppf(0.95, 2 * apart.size),
        time_s=result.sweep_time_s,
        why=result.by_itself,
    )


def _truth(result: ExperimentResult, plant: LinearPlant) -> ComplexArray:
    """Return the response under the relay: that of the amplitude, of those which gave a point, that suits it best.

    Rows of several amplitudes stand for a plant somewhere between those that they saw.
    """
    found = []
    for point in result.points:
        linear = complex(plant.response(np.array([point.omega_rad_s]))[0])
        own = [one.settings for one in result.segments if one.point == point] or [
            one.settings for one in result.segments
        ]
        seen = [plant.gain(one.amplitude, one.midpoint) for one in own]
        truths = linear * np.linspace(min(seen), max(seen), 9)
        found.append(min(truths, key=lambda truth, point=point: chi_square([point], np.array([truth]))[0]))
    return np.array(found)


def covered(outcomes: list[Outcome]) -> float:
    """Return the share of the points that lie within their regions."""
    return float(np.mean(np.concatenate([one.chi2 for one in outcomes]) < CHI2_95)) if outcomes else float("nan")


def main() -> None:
    """Print a line for each plant, and the sums."""
    seeds, first = int(os.environ.get("SEEDS", "3")), int(os.environ.get("FIRST_SEED", "1"))
    wanted = os.environ.get("CASE", "")
    cases = [case for case in CASES if re.search(wanted, case.name)]
    if os.environ.get("VIOLATED"):
        chosen = [case for case in CASES if case.name in VIOLATED]
        cases = [
            replace(case, name=f"{said}: {case.name}", load_s=10.0 * case.time_s, **what)
            for said, what in VIOLATIONS.items()
            for case in chosen
        ]
    if not cases:
        raise SystemExit(f"no plant is called {wanted!r}")
    every: dict[bool, list[Outcome]] = {True: [], False: []}
    ratios, equal, failed = [], [], 0
    print(f"{'plant':>60}: together; error, covered both ways; time over that of one by one")
    for case in cases:
        own: dict[bool, list[Outcome]] = {True: [], False: []}
        for seed in range(first, first + seeds):
            try:
                pair = {together: outcome(case, seed, together=together) for together in (True, False)}
            except AutotuneError as error:
                failed += 1
                print(f"{case.name} {seed}: {error}", flush=True)
                continue
            for together, found in pair.items():
                own[together].append(found)
        if not own[True]:
            continue
        for together, outcomes in own.items():
            every[together] += outcomes
        times = {way: float(np.median([one.time_s for one in outcomes])) for way, outcomes in own.items()}
        ratios.append(times[True] / times[False])
        sd = case.config(together=True).experiment.gain_sd
        worst = {way: float(np.median([one.errors.max() for one in outcomes])) / sd for way, outcomes in own.items()}
        equal.append(ratios[-1] * (worst[True] / worst[False]) ** 2)
        used = sum(not one.why for one in own[True])
        print(
            f"{case.name:>60}: {used} of {len(own[True])}; {worst[True]:5.2f} {worst[False]:5.2f};"
            f" {covered(own[True]):.3f} {covered(own[False]):.3f}; {ratios[-1]:.2f}"
            f" {'; '.join(sorted({one.why for one in own[True] if one.why}))}",
            flush=True,
        )
    jointly = [one for one in every[True] if not one.why]
    print(f"{len(every[True])} sweeps, {failed} stopped; points of all rows together in {len(jointly)}")
    print(
        f"covered: {covered(every[True]):.3f}, one by one {covered(every[False]):.3f}; together: {covered(jointly):.3f}"
    )
    for said, outcomes in (("both ways", every[True]), ("together", jointly), ("one by one", every[False])):
        print(f"joint region of all points holds the truth, {said}: {np.mean([one.jointly for one in outcomes]):.3f}")
    inside = np.mean([one.jointly or bool(one.why) for one in every[True]])
    print(f"sent to cycles of their own, or the joint region holds the truth: {inside:.3f}")
    for said, shares in (("", ratios), (", to equal errors", equal)):
        quarters = np.quantile(shares, [0.25, 0.5, 0.75]).round(2)
        print(f"time over that of one by one{said}, quartiles of the plants: {quarters}")
