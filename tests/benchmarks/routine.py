"""Loops in operation: what is said of simulated loops whose cause is known, and how often the band is right.

The loops are those of :mod:`tests.sim.valve_cases`: valves after Choudhury, He and Karnopp, play, tight tuning, outside
oscillations, healthy loops. A claim is false where it names another cause than the true one; to abstain or to find
nothing claims nothing.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from autotune.diagnosis.routine import diagnose_routine
from autotune.recording import Recording
from tests.sim.valve_cases import KINDS, ValveCase, valve_case

CASES, SEED = 13, 5000
#: What may be claimed of a kind: of a healthy loop nothing.
RIGHT = {
    "stiction": ("stiction", "backlash"), "play": ("stiction", "backlash"), "tight_noise": ("tight_tuning",),
    "tight_steps": ("tight_tuning",), "outside": ("outside_oscillation",), "wandering": ("outside_oscillation",),
    "quiet": (), "steps": (),
}  # fmt: skip
SILENT = ("none", "abstain")


def recorded(case: ValveCase) -> Recording:
    """Return the recording of a case."""
    t = case.dt_s * np.arange(case.u.size)
    return Recording(t=t, u=case.u, y=case.y, extra={"r": case.r}, name=case.kind)


def said_of(which: tuple[str, int]) -> dict[str, Any]:
    """Return what is said of a case, and what is true of it."""
    case = valve_case(which[0], which[1])  # type: ignore[arg-type]
    found = diagnose_routine([recorded(case)])
    band = found.band
    return {
        "kind": case.kind, "seed": which[1], "verdict": found.verdict, "clear": case.clear, "S": case.loop.S,
        "J": case.loop.J, "valve": case.loop.valve,
        "band": None if band is None else (band.value, band.low, band.high),
        "jump": None if found.jump is None else (found.jump.value, found.jump.low, found.jump.high),
    }  # fmt: skip


def print_table(rows: Iterable[dict[str, Any]]) -> None:
    """Print what was said of what, the false claims, and the bands."""
    rows = list(rows)
    verdicts = ("stiction", "backlash", "tight_tuning", "outside_oscillation", "abstain", "none")
    print(f"| true | {' | '.join(verdicts)} | of |\n|{'---|' * (len(verdicts) + 2)}")
    for kind in KINDS:
        count = Counter(row["verdict"] for row in rows if row["kind"] == kind)
        print(f"| {kind} | {' | '.join(str(count[v]) for v in verdicts)} | {sum(count.values())} |")
    false = [r for r in rows if r["verdict"] not in (*SILENT, *RIGHT[r["kind"]])]
    claims = sum(r["verdict"] not in SILENT for r in rows)
    print(f"\n{len(false)} false claims of {claims} in {len(rows)} loops: {[(r['kind'], r['seed']) for r in false]}")
    clear = [r for r in rows if r["kind"] in ("stiction", "play") and r["clear"]]
    named = [r for r in clear if r["band"]]
    print(f"faulty valves that turn ten times and move by their band: {len(named)} of {len(clear)} named")
    ratios = sorted(r["band"][0] / r["S"] for r in named)
    inside = sum(r["band"][1] <= r["S"] <= r["band"][2] for r in named)
    if ratios:
        print(f"band over true S: {ratios[0]:.2f} to {ratios[-1]:.2f}, median {ratios[len(ratios) // 2]:.2f};"
              f" inside its interval {inside} of {len(named)}")  # fmt: skip


def main() -> None:
    """Print the table; ``ROUTINE_CASES=N,SEED`` in the environment sets cases per kind and first seed."""
    cases, seed = (int(x) for x in os.environ.get("ROUTINE_CASES", f"{CASES},{SEED}").split(","))
    which = [(kind, s) for s in range(seed, seed + cases) for kind in KINDS]
    with ProcessPoolExecutor(int(os.environ.get("ROUTINE_WORKERS", "2"))) as pool:
        rows = []
        for row in pool.map(said_of, which):
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
    print_table(rows)
