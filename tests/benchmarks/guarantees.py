"""Are printed figures kept on the true plant? Random plants of sixteen classes, PI and PID, on models and on points.

``python -m tests.benchmarks.guarantees [COUNT [SOURCE ...]]``: COUNT plants of each class (60 by default), all sources
or some. A result fails where a figure that it prints (modulus, phase, delay, gain margin), or one that was asked for,
is above that of the true plant by more than 1 %; a refusal is no result. ``BRUTE=1`` looks for a better controller for
every known plant by a search of other code, contradicts refusals and tells missed optima. ``SEED`` draws other plants
and other noise (0 by default); ``WORKERS`` says how many processes work, 2 by default; with ``ROWS`` the outcomes are
kept in that file as they come, and what is in it is not done again, so that a campaign can be run in parts:
``SECONDS`` says after how many nothing further is begun.
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
from typing import Any, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.design.margins import Margins, margins
from autotune.design.on_reduced import design_on_reduced
from autotune.design.specification import Design, Kind, Specification
from autotune.design.synthesis import design
from autotune.errors import AutotuneError
from autotune.identification.parametric import PlantFit, fit_plant
from autotune.models import TransferFunction
from autotune.pipeline.analysis import of_use, on_measured
from autotune.points import FrequencyPoint
from tests.benchmarks._brute_force import Found, search

Job: TypeAlias = tuple[str, int, TransferFunction, tuple[str, ...]]
CLASSES = (
    "lag",
    "delay",
    "integrating",
    "high order",
    "non-minimum phase",
    "resonant",
    "lightly resonant",
    "resonance behind a lag",
    "integrating resonance",
    "two resonances",
    "lead",
    "lead and delay",
    "inverse response and delay",
    "unstable",
    "unstable with lag and delay",
    "ten lags and delay",
)
SOURCES = ("model", "reduced from the model", "points", "exact points", "points of a slow plant")
ASKED = Specification(modulus_margin=0.5, phase_margin_rad=math.radians(45.0), noise_gain=1e3)
TOLERANCE = 0.01
SEED = int(os.environ.get("SEED", "0"))


def plants(kind: str, count: int) -> Iterator[TransferFunction]:
    """Yield random plants of a class, time in units of their slowest lag but for the scale of some of them."""
    rng = np.random.default_rng(CLASSES.index(kind) + 1000 * SEED)
    for _ in range(count):
        scale, gain = 10.0 ** rng.uniform(-2.0, 3.0), 10.0 ** rng.uniform(-2.0, 2.0) * rng.choice([-1.0, 1.0])
        lags, delay, zero, extra = [1.0], 0.0, 0.0, [np.array([1.0])]
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
            case _:
                lags, delay, zero, extra = _further(kind, rng)
        den = np.array([1.0, 0.0]) if kind.startswith("integrating") else np.array([1.0])
        for lag in lags:
            den = np.polymul(den, [lag * scale, 1.0])
        for factor in extra:
            den = np.polymul(den, factor * scale ** np.arange(len(factor) - 1, -1, -1))
        num = (-zero * scale * gain, gain) if zero else (gain,)
        yield TransferFunction(num=num, den=tuple(den), delay_s=delay * scale)


def _further(kind: str, rng: np.random.Generator) -> tuple[list[float], float, float, list[FloatArray]]:
    """Return lags, dead time, the zero's time constant (below 0 in the left half plane) and further factors."""
    lags: list[float] = []
    delay, zero = 0.0, 0.0
    extra: list[FloatArray] = []

    def resonance(low: float, high: float, frequency: float = 1.0) -> FloatArray:
        return np.array([1.0 / frequency**2, 2.0 * 10.0 ** rng.uniform(low, high) / frequency, 1.0])

    match kind:
        case "resonant":
            extra, delay = [resonance(-0.7, -0.1)], float(rng.choice([0.0, 10.0 ** rng.uniform(-1.5, 0.0)]))
        case "lightly resonant":
            extra, delay = [resonance(-1.7, -0.7)], float(rng.choice([0.0, 10.0 ** rng.uniform(-1.5, -0.5)]))
        case "resonance behind a lag":
            lags, extra = [float(10.0 ** rng.uniform(-0.7, 1.0))], [resonance(-1.5, -0.3)]
        case "integrating resonance":
            extra = [resonance(-1.5, -0.2)]
        case "two resonances":
            extra = [resonance(-1.0, -0.2), resonance(-1.0, -0.2, float(10.0 ** rng.uniform(0.2, 0.6)))]
        case "lead" | "lead and delay":
            lags = [1.0, *(10.0 ** rng.uniform(-1.0, 0.0, rng.integers(2, 4)))]
            zero = -(10.0 ** rng.uniform(-0.7, 0.7))
            delay = float(10.0 ** rng.uniform(-1.0, 0.0)) if kind == "lead and delay" else 0.0
        case "inverse response and delay":
            lags = [1.0, *(10.0 ** rng.uniform(-1.0, 0.0, rng.integers(1, 3)))]
            zero, delay = float(10.0 ** rng.uniform(-1.0, 0.2)), float(10.0 ** rng.uniform(-1.0, 0.3))
        case "unstable":
            extra, delay = [np.array([1.0, -1.0])], float(10.0 ** rng.uniform(-2.0, -0.8))
        case "unstable with lag and delay":
            extra, lags = [np.array([1.0, -1.0])], [float(10.0 ** rng.uniform(-2.0, -1.0))]
            delay = float(10.0 ** rng.uniform(-2.0, -1.0))
        case "ten lags and delay":
            lags = [1.0, *(10.0 ** rng.uniform(-0.7, 0.0, 9))]
            delay = float(10.0 ** rng.uniform(-1.0, 0.7))
    return lags, delay, zero, extra


def falling(plant: TransferFunction, highest_deg: float) -> FloatArray:
    """Return five frequencies at which the phase of the plant with positive gain falls from -105 to a lower angle."""
    corners = np.abs(np.concatenate((plant.poles, plant.zeros)))
    corners = np.append(corners[corners > 0.0], 1.0 / plant.delay_s if plant.delay_s > 0.0 else corners.max())
    grid = np.geomspace(1e-3 * corners.min(), 1e3 * corners.max(), 60_001)
    unstable = np.any(plant.poles.real > 0.0)
    sign = math.copysign(1.0, plant.num[-1] * (plant.den[0] if unstable else 1.0))
    phase = np.degrees(np.unwrap(np.angle(sign * plant.response(grid))))
    if unstable:  # its phase begins at -180 deg, rises, and is looked at from where it falls
        phase -= 360.0 if phase[0] > 0.0 else 0.0
        top = int(np.argmax(phase))
        grid, phase = grid[top:], phase[top:]
        highest_deg = min(highest_deg, phase[0] - 10.0)
    first = -105.0 if phase[0] > -100.0 else min(phase[0] - 5.0, -105.0)
    reached = np.minimum.accumulate(phase)
    return np.asarray(np.interp(-np.linspace(first, highest_deg, 5), -reached, grid))


def relay_points(
    plant: TransferFunction, rng: np.random.Generator | None, highest_deg: float = -160.0
) -> list[FrequencyPoint]:
    """Five points as a relay sweep gives them: phases -105 to -160 degrees, 0.4 % and 0.25 degrees, or exact."""
    omega = falling(plant, highest_deg)
    sd = np.array([0.004, math.radians(0.25)])
    points = []
    for w, true in zip(omega, plant.response(omega), strict=True):
        value = complex(true * np.exp(complex(*(rng.normal(size=2) * sd)))) if rng is not None else complex(true)
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


def shortfall(true: Margins, printed: Margins) -> float:
    """Return the least of the true modulus, phase, delay and gain margin over the printed and asked ones, less 1."""
    if not true.stable:
        return -1.0
    shares = [true.modulus / ASKED.modulus_margin, true.phase_rad / ASKED.phase_margin_rad]
    for name in ("modulus", "phase_rad", "delay_s", "gain"):
        said, is_so = getattr(printed, name), getattr(true, name)
        shares.append(is_so / said if math.isfinite(said) else 1.0 if math.isinf(is_so) else 0.0)
    return float(min(shares)) - 1.0


def outcome(plant: TransferFunction, make: Callable[[], Design], brute: Callable[[], Found | None]) -> dict[str, Any]:
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
    true, c, better = margins(plant, made.controller), made.controller, brute()
    share = shortfall(true, made.margins)
    return {
        "what": "kept" if share >= -TOLERANCE else "FAILED",
        "reason": f"K {c.K:.4g} Ti {c.Ti_s:.4g} Td {c.Td_s:.3g} Tf {c.Tf_s:.3g}",
        "shortfall": share,
        "found": math.nan if better is None else better.h2 / true.h2 - 1.0,
        "gap": math.nan if made.gap is None else made.gap,
    }


def makers(plant: TransferFunction, seed: int, kind: Kind) -> dict[str, Callable[[], Design]]:
    """Return the ways to a controller."""
    rng = np.random.default_rng(seed + 1_000_000 * SEED)

    def tuned(points: list[FrequencyPoint]) -> Design:
        return on_measured(of_use(points), _fit(tuple(points)), asked_of(plant), kind)[1]

    return {
        "model": lambda: design(plant, asked_of(plant), kind),
        "reduced from the model": lambda: design_on_reduced(plant, asked_of(plant), kind),
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
    kinds: tuple[Kind, ...] = ("pi", "pid")
    for source in sources:
        for kind in kinds:
            asked = asked_of(plant)

            def brute(source: str = source, kind: Kind = kind, asked: Specification = asked) -> Found | None:
                if source != "model" or "BRUTE" not in os.environ:
                    return None
                return search(plant, kind, asked.modulus_margin, asked.phase_margin_rad, asked.noise_gain)

            fields = outcome(plant, makers(plant, number, kind)[source], brute)
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
    jobs = [(name, i, by_name[name][i], (source,)) for i in range(count) for name in CLASSES for source in sources]
    found = done(jobs, sources)
    print(f"{count} plants of each class; asked for M_m 0.5 and 45 deg")
    print(f"{'plants':28s} {'source':24s} {'kind':4s} {'kept':>5s} {'refused':>7s} {'FAILED':>6s}   worst")
    for name in CLASSES:
        for source in sources:
            for kind in ("pi", "pid"):
                rows = [row for row in found if (row.plant, row.source, row.kind) == (name, source, kind)]
                tally = Counter(row.what for row in rows)
                worst = min((row.shortfall for row in rows if row.what != "refused"), default=math.nan)
                counts = f"{tally['kept']:5d} {tally['refused']:7d} {tally['FAILED']:6d}"
                print(f"{name:28s} {source:24s} {kind:4s} {counts} {100.0 * worst:+7.2f} %")
    for row in found:
        if row.what == "FAILED":
            print(f"FAILED {row.plant} {row.number} {row.source} {row.kind}: {100 * row.shortfall:.2f} %, {row.reason}")
    told(found)
    reasons = Counter((row.source, row.kind, row.reason[:70]) for row in found if row.what == "refused")
    for (source, kind, reason), times in reasons.most_common(12):
        print(f"refused {times} x {source}, {kind}: {reason}")


if __name__ == "__main__":
    main()
