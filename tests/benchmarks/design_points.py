"""Design straight on measured points of the ball against the reduced model and the known plant.

``EXPERIMENTS=200 python -m tests.benchmarks design_points`` runs the full count; 40 by default. The points are those of
the relay experiment on the simulated ball at +-0.35 V of noise and unknown hover voltage; ``POINTS=drawn`` draws them
instead, five between -105 and -160 degrees with gain sd 0.4 % and phase sd 0.25 degrees.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from pathlib import Path
from typing import TypeAlias

import numpy as np

from autotune.batch.engine import cluster, run_all
from autotune.config import load_config
from autotune.design.margins import Margins, margins
from autotune.design.robust import design_on_points
from autotune.design.specification import Design, spec1
from autotune.design.synthesis import design
from autotune.experiment.run import run_experiment
from autotune.identification.reduction import reduce_points
from autotune.points import FrequencyPoint
from drivers.simulated import SimulatedRig
from sim.ball import make_ball
from tests.autotune.design.plants import BALL, REDUCED, measured

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "ball_sim.toml"


Row: TypeAlias = tuple[Margins, Design, float, float]


def points_of(seed: int) -> tuple[FrequencyPoint, ...]:
    """Return the points of one experiment; one that ends early is not forgiven."""
    if os.environ.get("POINTS") == "drawn":
        return measured(BALL, seed)
    with tempfile.TemporaryDirectory() as folder:
        rig = SimulatedRig(make_ball(seed=seed, noise=0.35), u_safe=0.0)
        return run_experiment(rig, load_config(CONFIG), Path(folder) / "recording.csv").points


def row_of(seed: int) -> Row:
    """Return margins and design of one experiment, processor time of the design [s], norm with the reduced model."""
    points = points_of(seed)
    start = time.process_time()
    found = design_on_points(points, spec1(0.1))
    spent = time.process_time() - start
    reduced = design(reduce_points(points).transfer_function(), spec1(0.1), certificate=False).controller
    return margins(BALL, found.controller), found, spent, margins(BALL, reduced).h2


def main() -> None:
    count = int(os.environ.get("EXPERIMENTS", "40"))
    rows: list[Row] = []
    with cluster() as client:
        client.run(design_on_points, measured(BALL, None), spec1(0.1))  # compile, or load from the disk
        for _, row in run_all(client, row_of, {str(seed): seed for seed in range(1, count + 1)}, retries=0):
            if isinstance(row, Exception):
                raise row
            rows.append(row)
    known = design(BALL, spec1(0.1))
    papers = margins(BALL, design(REDUCED, spec1(0.1), certificate=False).controller)
    norms = np.array([m.h2 for m, *_ in rows])
    modulus = np.array([m.modulus for m, *_ in rows])
    phase = np.degrees([m.phase_rad for m, *_ in rows])
    kept = np.mean((modulus >= 0.5) & (phase >= 45.0))
    print(f"Ball, Spec1, N_max 0.1, {count} simulated experiments; H2 (11) on the true plant (23)")
    print(f"  known plant (23)               {known.h2:8.2f}   lower bound {known.h2_lower_bound:.2f}")
    print(f"  paper's reduced model          {papers.h2:8.2f}")
    print(f"  reduced models of the points   {np.median([row[3] for row in rows]):8.2f}   median")
    low, high = np.percentile(norms, [5, 95])
    print(
        f"  straight on the points         {np.median(norms):8.2f}   median, 5-95 % {low:.2f} to {high:.2f} (aim < 45)"
    )
    print(f"  true plant keeps M_m 0.5 and 45 deg in {100 * kept:.1f} % (aim 99 %); worst", end=" ")
    print(f"{modulus.min():.3f}, {phase.min():.2f} deg; CPU per design {1e3 * np.median([r[2] for r in rows]):.0f} ms")
    guaranteed = np.array([math.degrees(d.margins.phase_rad) for _, d, *_ in rows])
    print(f"  price of the regions: phase margin {np.median(phase - guaranteed):.2f} deg more than guaranteed, median")


if __name__ == "__main__":
    main()
