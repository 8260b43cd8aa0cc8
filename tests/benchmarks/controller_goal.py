"""``goal = "controller"`` on the simulated ball beside a limit cycle for each point: rig time, and the controller.

The norm (11) on the true plant of the controller that each way ends with, and the rig time of its sweep. Margins are
those on the true plant. ``SEEDS=20 python -m tests.benchmarks controller_goal``.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autotune.config import load_config
from autotune.design.loop import open_loop
from autotune.design.margins import margins
from autotune.design.norms import disturbance_h2
from autotune.experiment.run import run_experiment
from autotune.models import TransferFunction
from autotune.pipeline.swept import analyse_sweep, facts_of, price_of
from drivers.simulated import SimulatedRig
from sim.ball import DENOMINATOR, GAIN, make_ball

CONFIG = load_config(Path(__file__).resolve().parents[2] / "configs" / "ball_sim.toml")
BALL = TransferFunction(num=(GAIN,), den=tuple(DENOMINATOR))
WAYS: dict[str, dict[str, Any]] = {
    "goal = controller": {"goal": "controller"},
    "goal = points": {},
    "each point by itself": {"together": False},
}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A sweep and its controller: rig time [s], and norm, modulus and phase margin [deg] on the true plant."""

    time_s: float
    norm: float
    modulus: float
    phase_deg: float


def outcome(seed: int, **settings: Any) -> Outcome:
    """Sweep and design one way."""
    config = CONFIG.model_copy(update={"experiment": CONFIG.experiment.model_copy(update=settings)})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig = SimulatedRig(make_ball(seed=seed, noise=0.35), u_safe=0.0)
        swept = run_experiment(rig, config, folder / "recording.csv", price=price_of(config))
        facts = facts_of(config, swept.noise_sd)
        controller = analyse_sweep(swept, config.design, facts, folder, lambda _: None).controller
    kept = margins(BALL, controller)
    return Outcome(
        time_s=swept.sweep_time_s,
        norm=disturbance_h2(open_loop(BALL, controller)),
        modulus=kept.modulus,
        phase_deg=float(np.degrees(kept.phase_rad)),
    )


def main() -> None:
    """Print one line for each way."""
    seeds = range(1, 1 + int(os.environ.get("SEEDS", "20")))
    found = {name: [outcome(seed, **settings) for seed in seeds] for name, settings in WAYS.items()}
    base = found["each point by itself"]
    print(f"{len(seeds)} seeds; rig time, and norm (11) on the true plant over that of each point by itself")
    for name, ours in found.items():
        times = np.array([a.time_s / b.time_s for a, b in zip(ours, base, strict=True)])
        norms = np.array([a.norm / b.norm for a, b in zip(ours, base, strict=True)])
        time_s, modulus, phase = (
            [one.time_s for one in ours],
            min(one.modulus for one in ours),
            min(one.phase_deg for one in ours),
        )
        print(
            f"{name:>22}: {np.median(time_s):5.1f} s, {np.median(times):.2f}, at most {times.max():.2f};"
            f" norm {np.median(norms):.3f}, {norms.min():.3f} to {norms.max():.3f}, within 2 % in"
            f" {np.mean(norms <= 1.02):.2f}; margins at least {modulus:.3f} and {phase:.1f} deg",
            flush=True,
        )
