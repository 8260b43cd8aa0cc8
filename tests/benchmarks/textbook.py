"""Ten textbook plants as equations, each concealing ten effects in turn, one outside the catalogue, and none.

``python -m tests.benchmarks textbook`` makes the recordings by ``tests.sim.textbook`` (integrators of its own) and
gives them with the nominal equations to ``diagnose``. TEXTBOOK_PLANTS names some (separated by commas), TEXTBOOK_SEED
is the first seed (61), TEXTBOOK_OUT the folder that holds one JSON file a case: what is there is not run again,
TEXTBOOK_ROWS the length of each recording where it is not the plant's own. WORKERS processes at once (1).
"""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from sim.score import wilson
from tests.sim.textbook import PLANTS
from tests.sim.textbook.plant import Plant
from tests.sim.textbook.record import pair

#: Laws that are the same curve over what a plant moves through: a T^4 and a T |T| about room temperature.
SAME = ({"plant.radiation_loss", "plant.nonlinear_loss"}, {"plant.quadratic_drag", "plant.nonlinear_loss"})

#: Rows of each recording; 0 for as many as the plant's own.
ROWS = int(os.environ.get("TEXTBOOK_ROWS", "0"))

Case = tuple[str, str, str, float, int]


def cases(plants: list[str], seed: int) -> list[Case]:
    """Return (plant, effect or clean or outside, place, size, seed) of every case."""
    found: list[Case] = []
    for number, name in enumerate(PLANTS):
        if name not in plants:
            continue
        first = seed + 100 * number
        found.append((name, "clean", "", 0.0, first))
        found.append((name, "outside", "", 0.0, first + 1))
        found += [(name, *effect, first + 2 + k) for k, effect in enumerate(PLANTS[name].effects)]
    return found


def diagnosed(plant: Plant, case: Case, folder: Path) -> dict[str, Any]:
    """Return what the diagnosis of a case said, and how long it took."""
    from threadpoolctl import threadpool_limits

    from autotune.diagnosis import diagnose
    from autotune.equations.read import read_equations
    from autotune.recording import read_recording

    _, name, place, size, seed = case
    concealed = None if name in ("clean", "outside") else (name, place, size)
    (folder / "model.toml").write_text(plant.model, encoding="utf-8")
    for k, made in enumerate(pair(plant, seed, concealed, is_outside=name == "outside")):
        (folder / f"rec{k}.csv").write_text(made.csv(), encoding="utf-8")
    recordings = [read_recording(folder / f"rec{k}.csv") for k in range(2)]
    begin, cpu = time.perf_counter(), time.process_time()
    with threadpool_limits(1):
        found = diagnose(read_equations(folder / "model.toml"), recordings)
    said = found.as_json()
    return {
        "verdict": said["verdict"],
        "effects": [[e["name"], where_of(e), e["probability"]] for e in said["effects"]],
        "candidates": said["candidates"][:4],
        "fit": said["fit"],
        "cpu_s": time.process_time() - cpu,
        "wall_s": time.perf_counter() - begin,
    }


def where_of(effect: dict[str, Any]) -> str:
    """Return the state, port or input that a named effect acts on."""
    return effect["state"] or effect["port"] or effect["input"] or ""


def is_right(case: Case, said: dict[str, Any]) -> bool:
    """Whether the first effect has the right name and place; whether nothing is named where nothing is."""
    _, name, place, _, _ = case
    if name in ("clean", "outside"):
        return not said["effects"]
    if said["verdict"] != "effect" or not said["effects"]:
        return False
    first, where, _ = said["effects"][0]
    same = {name}.union(*(group for group in SAME if name in group))
    return first in same and (where == place or name.startswith("sensor."))


def run(job: tuple[Case, str]) -> tuple[Case, dict[str, Any]]:
    """Run a case, or read what an earlier run found."""
    case, out = job
    name, effect, place, _, seed = case
    file = Path(out) / f"{name}--{effect}--{place or 'y'}--{seed}.json".replace(" ", "_")
    if file.exists():
        return case, json.loads(file.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        try:
            said = diagnosed(replace(PLANTS[name], rows=ROWS or PLANTS[name].rows), case, Path(folder))
        except Exception as error:  # a campaign goes on, and the table says what broke
            said = {"verdict": f"{type(error).__name__}: {error}", "effects": [], "fit": {}, "cpu_s": 0.0}
    file.write_text(json.dumps(said), encoding="utf-8")
    return case, said


def main() -> None:
    """Run the campaign and print the misses and the table."""
    plants = os.environ.get("TEXTBOOK_PLANTS", ",".join(PLANTS)).split(",")
    wanted = cases(plants, int(os.environ.get("TEXTBOOK_SEED", "61")))
    out = os.environ.get("TEXTBOOK_OUT") or tempfile.mkdtemp(prefix="textbook-")
    Path(out).mkdir(parents=True, exist_ok=True)
    found = []
    with multiprocessing.get_context("spawn").Pool(int(os.environ.get("WORKERS", "1"))) as pool:
        for case, said in pool.imap_unordered(run, [(case, out) for case in wanted]):
            found.append((case, said))
            print("right " if is_right(case, said) else "WRONG ", line(case, said), flush=True)
    report(found, out)


def line(case: Case, said: dict[str, Any]) -> str:
    """Return a case and what was said of it."""
    names = " + ".join(f"{n}@{w or 'y'} {p:.2f}" for n, w, p in said["effects"])
    fit = " ".join(f"{key} {value:.3g}" for key, value in said["fit"].items() if isinstance(value, float))
    concealed = f"{case[0]:18s} {case[1]:26s} {case[2]:6s}"
    return f"{concealed} -> {said['verdict'][:60]:12s} {names:40s} {fit} {said['cpu_s']:.1f} s"


def report(found: list[tuple[Case, dict[str, Any]]], out: str) -> None:
    """Print shares with their 95 % intervals, by plant and altogether."""
    total, right = Counter[str](), Counter[str]()
    for case, said in found:
        group = case[1] if case[1] in ("clean", "outside") else "concealed"
        held = {f"{group}, {case[0]}": is_right(case, said), group: is_right(case, said)}
        if group == "concealed":
            held["concealed, nothing false beside"] = is_right(case, said) and len(said["effects"]) == 1
        for key, value in held.items():
            total[key] += 1
            right[key] += value
    for key in sorted(total):
        low, high = (100.0 * share for share in wilson(right[key], total[key]))
        share = 100.0 * right[key] / total[key]
        print(f"{key:34s} {right[key]:4d} of {total[key]:4d}  {share:5.1f} % ({low:.0f}-{high:.0f})")
    cpu = sum(said["cpu_s"] for _, said in found)
    slowest, case = max((said.get("wall_s", 0.0), case) for case, said in found)
    print(f"right: name and place first; clean, outside: nothing named. {cpu:.0f} s of processor; files in {out}")
    print(f"the longest took {slowest:.1f} s: {case[0]}, {case[1]}")


if __name__ == "__main__":
    sys.exit(main())
