"""Are printed figures kept on the true plant? Random plants of sixteen classes; PI, PID and RST, on models and points.

``python -m tests.benchmarks.guarantees [COUNT [SOURCE ...]]``: COUNT plants of each class (60 by default), all sources
or some; with ``IN_TURN=1`` each plant is designed on one of them, the next plant of its class on the next one. A result
fails where a figure that it prints (modulus, phase, delay, gain margin), or one that was asked for, is above that of
the true plant by more than 1 %, the true one being the least of what the project's own margins and a loop of other code
say; a refusal is no result. An RST takes a plant, nothing else, and is asked for nothing. ``BRUTE=1`` looks
for a better controller for every known plant by a search of other code, contradicts refusals and tells missed optima.
``SEED`` draws other plants and other noise (0 by default); ``WORKERS`` says how many processes work, 2 by default; with
``ROWS`` the outcomes are kept in that file as they come, and what is in it is not done again, so that a campaign can be
run in parts: ``SECONDS`` says after how many nothing further is begun.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import autotune as at
from autotune.controller import PIDController
from autotune.design.margins import Margins, margins
from autotune.design.on_reduced import design_on_reduced
from autotune.design.specification import Design, Kind, Specification
from autotune.design.synthesis import design
from autotune.errors import AutotuneError
from autotune.identification.parametric import PlantFit, fit_plant
from autotune.models import TransferFunction
from autotune.pipeline.analysis import of_use, on_measured
from autotune.points import FrequencyPoint
from tests.benchmarks._brute_force import Found, figures, search
from tests.benchmarks.random_plants import CLASSES, SEED, plants, relay_points, slow_points

Job: TypeAlias = tuple[str, int, TransferFunction, tuple[str, ...]]
STRUCTURES = ("pi", "pid", "rst")
SOURCES = ("model", "reduced from the model", "points", "exact points", "points of a slow plant")
ASKED = Specification(modulus_margin=0.5, phase_margin_rad=math.radians(45.0), noise_gain=1e3)
TOLERANCE = 0.01


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Of one design: ``kept``, ``refused`` or ``FAILED``, and how it stands beside what is true.

    ``shortfall`` is the least of the true figures over the printed and the asked ones, less 1; ``found`` the norm that
    brute force finds on a known plant over the design's, less 1 (NaN where it finds no controller, or was not asked);
    ``gap`` that of the certificate.
    """

    plant: str
    source: str
    kind: str
    number: int
    what: str
    reason: str
    shortfall: float
    found: float = math.nan
    gap: float = math.nan


@dataclass(frozen=True, kw_only=True)
class Placed:
    """An RST with the figures that are printed of it; nothing was asked for, and nothing is proven."""

    controller: TransferFunction
    margins: Margins
    specification: Specification | None = None
    gap: float | None = None


def true_margins(plant: TransferFunction, controller: PIDController | TransferFunction) -> Margins:
    """Return the least figures of two codes: the project's own, and those of a plain grid with Mikhailov's count."""
    own = margins(plant, controller)
    rational = controller if isinstance(controller, TransferFunction) else controller.transfer_function()
    stable, *others = figures(plant, rational)
    names = ("modulus", "phase_rad", "delay_s", "gain")
    least = {name: min(getattr(own, name), other) for name, other in zip(names, others, strict=True)}
    return replace(own, stable=own.stable and stable, **least)


def shortfall(true: Margins, printed: Margins, asked: Specification | None) -> float:
    """Return the least of the true modulus, phase, delay and gain margin over the printed and asked ones, less 1."""
    if not true.stable:
        return 0.0 if not printed.stable else -1.0
    shares = [true.modulus / asked.modulus_margin, true.phase_rad / asked.phase_margin_rad] if asked else []
    for name in ("modulus", "phase_rad", "delay_s", "gain"):
        said, is_so = getattr(printed, name), getattr(true, name)
        shares.append(is_so / said if math.isfinite(said) else 1.0 if math.isinf(is_so) else 0.0)
    return float(min(shares)) - 1.0


def outcome(
    plant: TransferFunction, make: Callable[[], Design | Placed], brute: Callable[[], Found | None]
) -> dict[str, Any]:
    """Return the fields of what became of one design."""
    try:
        made = make()
    except AutotuneError as error:
        better = brute()
        return {
            "what": "refused",
            "reason": str(error),
            "shortfall": 0.0,
            "found": math.nan if better is None else better.h2,
        }
    except Exception as error:  # a defect is a row of the table too
        return {"what": "FAILED", "reason": f"{type(error).__name__}: {error}", "shortfall": -1.0}
    true, better = true_margins(plant, made.controller), brute()
    share = shortfall(true, made.margins, made.specification)
    return {
        "what": "kept" if share >= -TOLERANCE else "FAILED",
        "reason": str(made.controller),
        "shortfall": share,
        "found": math.nan if better is None else better.h2 / true.h2 - 1.0,
        "gap": math.nan if made.gap is None else made.gap,
    }


def placed(plant: TransferFunction, seed: int) -> Placed:
    """Return an RST whose dominant pole lies about the plant's -135 degrees, the others up to ten times as far off."""
    rng = np.random.default_rng(seed + 1_000_000 * SEED)
    omega = relay_points(plant, np.random.default_rng(0), -135.0)[-1].omega_rad_s
    dominant = float(omega * 10.0 ** rng.uniform(-0.7, 0.3))
    found = at.rst(plant, dominant_rad_s=dominant, rest_rad_s=float(dominant * 10.0 ** rng.uniform(0.0, 1.0)))
    return Placed(controller=found.feedback(), margins=at.margins(plant, found))


def makers(plant: TransferFunction, seed: int, kind: str) -> dict[str, Callable[[], Design | Placed]]:
    """Return the ways to a controller."""
    if kind == "rst":
        return {"model": lambda: placed(plant, seed)}
    structure: Kind = "pi" if kind == "pi" else "pid"
    rng = np.random.default_rng(seed + 1_000_000 * SEED)

    def tuned(points: list[FrequencyPoint]) -> Design:
        return on_measured(of_use(points), _fit(tuple(points)), asked_of(plant), structure)[1]

    return {
        "model": lambda: design(plant, asked_of(plant), structure),
        "reduced from the model": lambda: design_on_reduced(plant, asked_of(plant), structure),
        "points": lambda: tuned(relay_points(plant, rng)),
        "exact points": lambda: tuned(relay_points(plant, None)),
        "points of a slow plant": lambda: tuned(slow_points(plant, rng)),
    }


@lru_cache(maxsize=4)  # of PI and PID the same
def _fit(points: tuple[FrequencyPoint, ...]) -> PlantFit:
    return fit_plant(of_use(points))


@lru_cache(maxsize=4)
def asked_of(plant: TransferFunction) -> Specification:
    """Return the specification with a noise gain that hardly binds: ten over the gain near -135 degrees."""
    omega = relay_points(plant, np.random.default_rng(0), -135.0)[-1].omega_rad_s
    gain = abs(plant.response(np.array([omega]))[0])
    return Specification(
        modulus_margin=ASKED.modulus_margin, phase_margin_rad=ASKED.phase_margin_rad, noise_gain=float(10.0 / gain)
    )


def judged(job: Job) -> list[Outcome]:
    """Return the outcomes of some sources and all kinds on one plant."""
    name, number, plant, sources = job
    rows = []
    for source in sources:
        for kind in STRUCTURES:
            ways = makers(plant, number, kind)
            if source not in ways:
                continue
            asked = asked_of(plant)

            def brute(source: str = source, kind: str = kind, asked: Specification = asked) -> Found | None:
                if source != "model" or kind == "rst" or "BRUTE" not in os.environ:
                    return None
                return search(plant, kind, asked.modulus_margin, asked.phase_margin_rad, asked.noise_gain)

            fields = outcome(plant, ways[source], brute)
            rows.append(Outcome(plant=name, source=source, kind=kind, number=number, **fields))
    return rows


def done(jobs: Sequence[Job], sources: tuple[str, ...]) -> list[Outcome]:
    """Return the outcomes of the jobs, from the file of rows where they are there, else worked out and kept there."""
    kept = Path(os.environ["ROWS"]) if "ROWS" in os.environ else None
    lines = kept.read_text().splitlines() if kept is not None and kept.exists() else []
    found = [Outcome(**json.loads(line)) for line in lines]
    there = {(row.plant, row.number, row.source) for row in found}
    wanted = [job for job in jobs if (job[0], job[1], job[3][0]) not in there]
    end = time.monotonic() + float(os.environ.get("SECONDS", "inf"))
    with ProcessPoolExecutor(int(os.environ.get("WORKERS", "2"))) as pool:
        for first in range(0, len(wanted), 4):
            if time.monotonic() > end:
                break
            for rows in pool.map(judged, wanted[first : first + 4]):
                found += rows
                if kept is not None:
                    with kept.open("a") as file:
                        file.writelines(json.dumps(asdict(row)) + "\n" for row in rows)
    return [row for row in found if row.source in sources]


def told(found: Sequence[Outcome]) -> None:
    """Print how designs on known plants stand beside brute force, and what the certificates leave open."""
    for kind in ("pi", "pid"):
        rows = [row for row in found if row.source == "model" and row.kind == kind]
        refused = [row for row in rows if row.what == "refused"]
        contradicted = [row for row in refused if math.isfinite(row.found)]
        costs = np.array([row.found for row in rows if row.what == "kept" and math.isfinite(row.found)])
        print(f"{kind} on models: {len(rows)} plants, {len(refused)} refused, {len(contradicted)} of them contradicted")
        for row in contradicted:
            print(f"   contradicted {row.plant} {row.number}: {row.reason[:90]}")
        if costs.size:
            near, most = 100.0 * np.mean(costs >= -0.01), 100.0 * -np.min(costs)
            print(
                f"   norm within 1 % of brute force in {near:.1f} % of {costs.size}; most that was missed {most:.2f} %"
            )
            for row in rows:
                if row.what == "kept" and row.found < -0.01:
                    print(f"   missed {row.plant} {row.number}: {100 * row.found:.1f} %, {row.reason}")
        gaps = np.array([row.gap for row in rows if math.isfinite(row.gap)])
        if gaps.size:
            print(
                f"   certificate for {gaps.size} of {len(rows) - len(refused)}: gap at most .5 % in "
                f"{100.0 * np.mean(gaps <= 0.005):.1f} %, largest {100.0 * np.max(gaps):.3g} %"
            )


def main() -> None:
    """Print the table, the worst case of each row, and what failed."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    sources = tuple(sys.argv[2:]) or SOURCES
    by_name = {name: list(plants(name, count)) for name in CLASSES}
    # plant by plant through all classes, so that a part is a sample of the whole
    turns = [(sources[i % len(sources)],) if "IN_TURN" in os.environ else sources for i in range(count)]
    jobs = [(name, i, by_name[name][i], (source,)) for i in range(count) for name in CLASSES for source in turns[i]]
    found = done(jobs, sources)
    print(f"{count} plants of each class; asked for M_m 0.5 and 45 deg")
    print(f"{'plants':28s} {'source':24s} {'kind':4s} {'kept':>5s} {'refused':>7s} {'FAILED':>6s}   worst")
    for name in CLASSES:
        for source in sources:
            for kind in STRUCTURES:
                rows = [row for row in found if (row.plant, row.source, row.kind) == (name, source, kind)]
                if not rows:
                    continue
                tally = Counter(row.what for row in rows)
                worst = min((row.shortfall for row in rows if row.what != "refused"), default=math.nan)
                counts = f"{tally['kept']:5d} {tally['refused']:7d} {tally['FAILED']:6d}"
                print(f"{name:28s} {source:24s} {kind:4s} {counts} {100.0 * worst:+7.2f} %")
    tally = Counter(row.what for row in found)
    plants_seen = len({(row.plant, row.number) for row in found})
    print(f"{plants_seen} plants, {len(found)} designs: " + ", ".join(f"{n} {what}" for what, n in tally.items()))
    for row in found:
        if row.what == "FAILED":
            print(f"FAILED {row.plant} {row.number} {row.source} {row.kind}: {100 * row.shortfall:.2f} %, {row.reason}")
    told(found)
    reasons = Counter((row.source, row.kind, row.reason[:70]) for row in found if row.what == "refused")
    for (source, kind, reason), times in reasons.most_common(12):
        print(f"refused {times} x {source}, {kind}: {reason}")


if __name__ == "__main__":
    main()
