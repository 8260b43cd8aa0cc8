"""Are margins kept that a result claims? Random plants of five classes, PI and PID, on models and on points.

``python -m tests.benchmarks.guarantees [COUNT [SOURCE ...]]``: COUNT plants of each class (300 by default), all
sources or some. A result fails where the true margin is below the asked one by more than 1 % and the result does not
say so; a refusal is no result. A design on points holds with the probability that it names, 95 %: 5.1 % of 3,000 sets
of points had the plant outside their joint region; no result on those failed, and one on 300 further sets did, by 2.7
% of its phase margin. ``WORKERS`` in the environment says how many processes work, 2 by default; with ``ROWS`` the
outcomes are kept in that file as they come, and what is in it is not done again, so that a campaign can be run in
parts: ``SECONDS`` says after how many nothing further is begun. 300 plants of each class take about 50 minutes of one
core.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import numpy as np

from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.design.on_reduced import design_on_reduced
from autotune.design.specification import UNCERTAIN, Kind, Specification
from autotune.design.synthesis import design
from autotune.errors import AutotuneError
from autotune.identification.parametric import PlantFit, fit_plant
from autotune.models import TransferFunction
from autotune.pipeline.analysis import of_use, on_measured
from autotune.points import FrequencyPoint

Job: TypeAlias = tuple[str, int, TransferFunction, tuple[str, ...]]
CLASSES = ("lag", "delay", "integrating", "high order", "non-minimum phase")
SOURCES = ("model", "reduced from the model", "points", "points of a slow plant")
ASKED = Specification(modulus_margin=0.5, phase_margin_rad=math.radians(45.0), noise_gain=1e3)
TOLERANCE = 0.01


def plants(kind: str, count: int) -> Iterator[TransferFunction]:
    """Yield random plants of a class, time in units of their slowest lag but for the scale of some of them."""
    rng = np.random.default_rng(CLASSES.index(kind))
    for _ in range(count):
        scale, gain = 10.0 ** rng.uniform(-2.0, 3.0), 10.0 ** rng.uniform(-2.0, 2.0) * rng.choice([-1.0, 1.0])
        lags, delay, zero = [1.0], 0.0, 0.0
        match kind:
            case "lag":
                lags += list(10.0 ** rng.uniform(-2.0, 0.0, rng.integers(1, 4)))
            case "delay":
                lags += list(10.0 ** rng.uniform(-2.0, 0.0, rng.integers(0, 2)))
                delay = 10.0 ** rng.uniform(-1.3, 1.7)
            case "integrating":
                lags += list(10.0 ** rng.uniform(-2.0, 0.0, rng.integers(0, 3)))
                delay = float(rng.choice([0.0, 10.0 ** rng.uniform(-1.3, 0.5)]))
            case "high order":
                lags += list(10.0 ** rng.uniform(-1.0, 0.0, rng.integers(4, 9)))
            case "non-minimum phase":
                lags += list(10.0 ** rng.uniform(-2.0, 0.0, rng.integers(1, 4)))
                zero = 10.0 ** rng.uniform(-1.3, 0.3)
        den = np.array([1.0, 0.0]) if kind == "integrating" else np.array([1.0])
        for lag in lags:
            den = np.polymul(den, [lag * scale, 1.0])
        num = (-zero * scale * gain, gain) if zero else (gain,)
        yield TransferFunction(num=num, den=tuple(den), delay_s=delay * scale)


def relay_points(
    plant: TransferFunction, rng: np.random.Generator, highest_deg: float = -160.0
) -> list[FrequencyPoint]:
    """Five points as a relay sweep gives them: phases -105 to -160 degrees, 0.4 % and 0.25 degrees."""
    corners = np.abs(np.concatenate((plant.poles, plant.zeros)))
    corners = np.append(corners[corners > 0.0], 1.0 / plant.delay_s if plant.delay_s > 0.0 else corners.max())
    grid = np.geomspace(1e-3 * corners.min(), 1e3 * corners.max(), 60_001)
    sign = math.copysign(1.0, plant.num[-1])
    phase = np.degrees(np.unwrap(np.angle(sign * plant.response(grid))))
    first = -105.0 if phase[0] > -100.0 else min(phase[0] - 5.0, -105.0)
    reached = np.minimum.accumulate(phase)
    omega = np.interp(-np.linspace(first, highest_deg, 5), -reached, grid)
    sd = np.array([0.004, math.radians(0.25)])
    points = []
    for w, true in zip(omega, plant.response(omega), strict=True):
        value = complex(true * np.exp(complex(*(rng.normal(size=2) * sd))))
        turn = np.array([[value.real, -value.imag], [value.imag, value.real]])
        c = turn @ np.diag(sd**2) @ turn.T
        covariance = ((float(c[0, 0]), float(c[0, 1])), (float(c[1, 0]), float(c[1, 1])))
        points.append(FrequencyPoint(omega_rad_s=float(w), response=value, covariance=covariance))
    return points


def slow_points(plant: TransferFunction, rng: np.random.Generator) -> list[FrequencyPoint]:
    """Eight points from far below the corners to -135 degrees, as bump tests of a slow plant give them."""
    high = relay_points(plant, np.random.default_rng(0), -135.0)[-1].omega_rad_s
    points = []
    for k, w in enumerate(np.geomspace(0.01, 1.0, 8) * high):
        true = complex(plant.response(np.array([w]))[0])
        sd = 0.005 * 1.5**k * abs(true)
        points.append(
            FrequencyPoint(
                omega_rad_s=float(w),
                response=true + sd * complex(*rng.normal(size=2)),
                covariance=((sd**2, 0.0), (0.0, sd**2)),
            )
        )
    return points


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Of one design: ``kept``, ``said``, ``refused`` or ``FAILED``, and the true margins over the asked ones less 1."""

    plant: str
    source: str
    kind: str
    number: int
    what: str
    reason: str
    shortfall: float


def outcome(plant: TransferFunction, make: Callable[[], tuple[PIDController, bool]]) -> tuple[str, str, float]:
    """Return what became of one design, why, and the smaller of the true margins over what was asked, less 1."""
    try:
        controller, claimed = make()
    except AutotuneError as error:
        return "refused", str(error), 0.0
    except Exception as error:  # a defect is a row of the table too
        return "FAILED", f"{type(error).__name__}: {error}", -1.0
    m = margins(plant, controller)
    share = min(m.modulus / ASKED.modulus_margin, m.phase_rad / ASKED.phase_margin_rad) - 1.0 if m.stable else -1.0
    if share >= -TOLERANCE:
        return "kept", "" if claimed else "not certain", share
    return ("FAILED" if claimed else "said"), f"K {controller.K:.4g} Ti {controller.Ti_s:.4g}", share


def makers(plant: TransferFunction, seed: int, kind: Kind) -> dict[str, Callable[[], tuple[PIDController, bool]]]:
    """Return the ways to a controller, each giving it with whether its margins are claimed."""
    rng = np.random.default_rng(seed)

    def reduced() -> tuple[PIDController, bool]:
        return design_on_reduced(plant, asked_of(plant), kind).controller, True

    def tuned(points: list[FrequencyPoint]) -> tuple[PIDController, bool]:
        found = on_measured(of_use(points), _fit(tuple(points)), asked_of(plant), kind)[1]
        return found.controller, UNCERTAIN not in found.certificate

    return {
        "model": lambda: (design(plant, asked_of(plant), kind, certificate=False).controller, True),
        "reduced from the model": reduced,
        "points": lambda: tuned(relay_points(plant, rng)),
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
    kinds: tuple[Kind, ...] = ("pi", "pid")
    for source in sources:
        for kind in kinds:
            make = makers(plant, number, kind)[source]
            what, reason, share = outcome(plant, make)
            rows.append(
                Outcome(plant=name, source=source, kind=kind, number=number, what=what, reason=reason, shortfall=share)
            )
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
        for first in range(0, len(wanted), 24):
            if time.monotonic() > end:
                break
            for rows in pool.map(judged, wanted[first : first + 24]):
                found += rows
                if kept is not None:
                    with kept.open("a") as file:
                        file.writelines(json.dumps(asdict(row)) + "\n" for row in rows)
    return [row for row in found if row.source in sources]


def main() -> None:
    """Print the table, the worst case of each row, and what failed."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    sources = tuple(sys.argv[2:]) or SOURCES
    by_name = {name: list(plants(name, count)) for name in CLASSES}
    # plant by plant through all classes, so that a part is a sample of the whole
    jobs = [(name, i, by_name[name][i], (source,)) for i in range(count) for name in CLASSES for source in sources]
    found = done(jobs, sources)
    print(f"{count} plants of each class; asked for M_m 0.5 and 45 deg")
    print(f"{'plants':18s} {'source':24s} {'kind':4s} {'kept':>5s} {'said':>5s} {'refused':>7s} {'FAILED':>6s}   worst")
    for name in CLASSES:
        for source in sources:
            for kind in ("pi", "pid"):
                rows = [row for row in found if (row.plant, row.source, row.kind) == (name, source, kind)]
                tally = Counter(row.what for row in rows)
                worst = min((row.shortfall for row in rows if row.what != "refused"), default=math.nan)
                counts = f"{tally['kept']:5d} {tally['said']:5d} {tally['refused']:7d} {tally['FAILED']:6d}"
                print(f"{name:18s} {source:24s} {kind:4s} {counts} {100.0 * worst:+7.2f} %")
    for row in found:
        if row.what == "FAILED":
            print(f"FAILED {row.plant} {row.number} {row.source} {row.kind}: {100 * row.shortfall:.2f} %, {row.reason}")
    reasons = Counter((row.source, row.kind, row.reason[:70]) for row in found if row.what == "refused")
    for (source, kind, reason), times in reasons.most_common(12):
        print(f"refused {times} x {source}, {kind}: {reason}")


if __name__ == "__main__":
    main()
