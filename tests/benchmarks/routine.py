"""Loops in operation: what is said of simulated loops whose cause is known, and how often the band is right.

The loops are those of :mod:`tests.sim.valve_cases`: valves after Choudhury, He and Karnopp, play, tight tuning, outside
oscillations, healthy loops. A claim is false where it names another cause than the true one; to abstain or to find
nothing claims nothing. Beside them are sound loops: a hundred linear ones of :mod:`tests.sim.linear_loops`, and loops
that another one swings, not by a sine.
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
from autotune.errors import AutotuneError
from autotune.recording import Recording
from tests.sim.linear_loops import linear_loop
from tests.sim.valve_cases import KINDS, SHAPES, ValveCase, swung_from_outside, valve_case

CASES, SEED = 13, 5000
#: Linear loops, and loops that are swung by each shape.
LINEAR, SWUNG = 100, 24
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


def said_of_linear(seed: int) -> tuple[str, str]:
    """Return what drives a linear loop, and what is said of it."""
    loop = linear_loop(seed)
    try:
        found = diagnose_routine([Recording(t=loop.dt_s * np.arange(loop.u.size), u=loop.u, y=loop.y)])
    except AutotuneError as error:
        print(f"linear loop {seed}: {error}", file=sys.stderr, flush=True)
        return loop.disturbance, "refused"
    return loop.disturbance, found.verdict


def said_of_swung(which: tuple[str, bool, int]) -> tuple[str, str]:
    """Return by what a sound loop is swung, and what is said of it."""
    shape, wanders, seed = which
    case = swung_from_outside(shape, seed, wanders=wanders)  # type: ignore[arg-type]
    return f"{shape}, {'wandering' if wanders else 'steady'}", diagnose_routine([recorded(case)]).verdict


def print_sound(title: str, said: Iterable[tuple[str, str]]) -> None:
    """Print how often a valve was blamed where every valve follows, by what drives the loop.

    Parameters
    ----------
    title : str
        Of the first column.
    said : iterable of (str, str)
        What drives a loop, and the verdict.
    """
    count: dict[str, Counter[str]] = {}
    for drives, verdict in said:
        count.setdefault(drives, Counter())[verdict] += 1
    print(f"\n| {title} | a valve blamed | refused | of |\n|---|---|---|---|")
    for drives, told in count.items():
        print(f"| {drives} | {told['stiction'] + told['backlash']} | {told['refused']} | {told.total()} |")


def main() -> None:
    """Print the tables; ``ROUTINE_CASES=N,SEED`` in the environment sets cases per kind and first seed."""
    cases, seed = (int(x) for x in os.environ.get("ROUTINE_CASES", f"{CASES},{SEED}").split(","))
    which = [(kind, s) for s in range(seed, seed + cases) for kind in KINDS]
    with ProcessPoolExecutor(int(os.environ.get("ROUTINE_WORKERS", "2"))) as pool:
        rows = []
        for row in pool.map(said_of, which):
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
        print_table(rows)
        print_sound("linear loop", pool.map(said_of_linear, range(LINEAR)))
        swung = [(shape, wanders, s) for shape in SHAPES for wanders in (False, True) for s in range(SWUNG)]
        print_sound("swung from outside by", pool.map(said_of_swung, swung))
