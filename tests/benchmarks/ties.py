"""Ties: how often one experiment of the tool's choosing decides what a first, gentle recording leaves open.

The stage of ``autotune prove`` by itself, with what was probable before and after each experiment; the rigs are those
of :mod:`sim.ties`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from autotune.cli.prove import tie_resolved

CASES, SEED = 18, 4000


def main() -> None:
    """Print every tie with what was probable before and after its experiment, and how many were decided rightly."""
    print("| left out | most probable first | experiment | most probable after it |\n|---|---|---|---|")
    ties = []
    with tempfile.TemporaryDirectory(prefix="autotune-ties-") as folder:
        for seed in range(SEED, SEED + CASES):
            one = tie_resolved(Path(folder), seed)
            if one["experiment"]:
                ties.append(one)
                print(f"| {one['left_out']} | {one['before']} | {one['experiment']} | {one['after']} |")
    right, before = sum(one["resolved"] for one in ties), sum(one["right_before"] for one in ties)
    print(f"\n{CASES} recordings, {len(ties)} ties; first name right before the experiment {before}, after it {right}.")
