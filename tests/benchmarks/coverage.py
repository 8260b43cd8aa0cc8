"""How often 95 % intervals and regions hold the truth: every identifier, white noise and autoregressive noise.

``RECORDS=400 python -m tests.benchmarks coverage``: so many records for each row (400 by default);
``ROWS=algebraic,loop`` takes the rows whose names begin so. The share is printed with Wilson's 95 % interval, and what
was refused beside it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import numpy as np
from scipy.signal import cont2discrete, lfilter

import autotune as at
from autotune.arrays import BoolArray, FloatArray
from autotune.errors import AutotuneError
from autotune.identification.closed_loop.identify import identify_closed_loop
from autotune.identification.closed_loop.loop_plant import loop_region
from autotune.identification.frequency.limit_cycle_points import limit_cycle_points
from autotune.points import FrequencyPoint
from tests.autotune.identification.relay_loop import BALL, last_periods, relay_loop
from tests.autotune.identification.test_structures import loop
from tests.benchmarks.delay import wilson
from tests.loop_example import PLANT, inside_region

RECORDS = int(os.environ.get("RECORDS", "400"))
#: 2 exp(-0.5 s)/((2 s + 1)(3 s + 1)): a_0, a_1, b, h
LAGS = at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0), delay_s=0.5)
OF_LAGS = np.array([-1.0 / 6.0, -5.0 / 6.0, 1.0 / 3.0, 0.5])
OF_TWO = np.array([2.7, 1.5, 2.0, 4.0])
TS = 0.1
#: Poles of the noise; that of short loops has one of its own, from 0 to .98, in each record.
COLOURS = {"white": 0.0, "AR(.9)": 0.9, "of any colour": float("nan")}
CHI_SQUARE_2 = 5.991


def noise(rows: int, sd: float, pole: float, rng: np.random.Generator) -> FloatArray:
    """Autoregressive noise of a standard deviation; white where the pole is 0."""
    white = rng.standard_normal(rows + 200)
    return np.asarray(sd * lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], white)[200:])


def lags_record(seed: int, pole: float, sd: float, rows: int = 1200) -> at.Recording:
    """Rows of .1 s of the lags under a random binary command held for 1 to 5 s; y reaches about 1.5."""
    rng = np.random.default_rng(seed)
    u = np.concatenate([np.full(int(rng.integers(10, 51)), rng.choice([-1.0, 1.0])) for _ in range(130)])[:rows]
    num, den, _ = cont2discrete((LAGS.num, LAGS.den), TS)
    late = np.concatenate([np.zeros(round(LAGS.delay_s / TS)), u])[: u.size]
    y = lfilter(np.ravel(num), den, late) + noise(u.size, sd, pole, rng)
    return at.Recording(t=TS * np.arange(u.size), u=u, y=y, name=f"record {seed}")


def within(values: FloatArray, sd: FloatArray, truth: FloatArray) -> BoolArray:
    """Whether each 95 % interval holds its truth."""
    return np.asarray(np.abs(values - truth) < 1.96 * sd)


def by_delay(method: str) -> Callable[[int, float], BoolArray]:
    """Intervals of a_0, a_1, b, h at 2 % of noise."""

    def once(seed: int, pole: float) -> BoolArray:
        model = at.delay(lags_record(seed, pole, 0.03), method=method)
        return within(model.values[:4], model.standard_deviations[:4], OF_LAGS)

    return once


def by_two_delays(seed: int, pole: float) -> BoolArray:
    """Intervals of a, b, h_1, h_2 of Example 3 at noise 0.1."""
    clean = at.example("two delays", noise=0.0)
    added = noise(len(clean), 0.1, pole, np.random.default_rng(seed))
    record = at.Recording(t=clean.t, u=clean.u, y=clean.y + added, metadata=clean.metadata)
    model = at.delay(record, delays=2)
    return within(model.values, model.standard_deviations, OF_TWO)


def inside(point: FrequencyPoint, plant: at.TransferFunction) -> bool:
    """Whether a point's 95 % region holds the plant."""
    error = point.response - complex(plant.response(np.array([point.omega_rad_s]))[0])
    parts = np.array([error.real, error.imag])
    return bool(parts @ np.linalg.solve(np.array(point.covariance), parts) < CHI_SQUARE_2)


def by_points(rows: int) -> Callable[[int, float], BoolArray]:
    """Regions of the points of a recording, all together; up to eight."""

    def once(seed: int, pole: float) -> BoolArray:
        points = at.frequency_points(lags_record(seed, pole, 0.03, rows))
        return np.array([np.mean([inside(point, LAGS) for point in points])])

    return once


def by_relay(seed: int, pole: float) -> BoolArray:
    """Regions of the fundamental of a relay on plant (23) at 10 ms: ten periods near -180 degrees, four with delay."""
    found = []
    for delay, step, periods in ((0, 0.5, 10), (50, 0.3, 4)):
        rows = int(100 * (20 + periods * (1.0 + 0.05 * delay)))
        added, hysteresis = noise(rows, 0.2, pole, np.random.default_rng(seed)), 1.0 if pole else 0.4
        t, u, y = relay_loop(BALL, d=step, hysteresis=hysteresis, delay=delay, noise=added)
        use = last_periods(t, u, periods, step)
        found.append(inside(limit_cycle_points(t[use], u[use], y[use]).points[0], BALL))
    return np.array(found)


def by_short_loop(seed: int, pole: float) -> BoolArray:
    """Regions of points of 300 to 2000 rows of a loop with 1 to 7 rows of dead time, and of those that designs take."""
    recording, plant = loop(60_000 + seed)
    found = identify_closed_loop(recording)
    shares = [np.mean([inside(p, plant) for p in points]) for points in (found.points, found.design_points) if points]
    if len(shares) < 2:
        raise AutotuneError("no point", where="coverage")
    return np.array(shares)


def by_loop(seed: int, pole: float) -> BoolArray:
    """Regions of the poles and of the response at eight frequencies, and the joint one of the coefficients."""
    from scipy.stats import chi2

    found = at.closed_loop(at.example("loop", seed=seed), order=5)
    truth = PLANT.poles[np.argsort(np.abs(PLANT.poles - 1.0))]
    at_truth = [int(np.argmin(np.abs(found.poles - p))) for p in truth]
    poles = inside_region(found.poles[at_truth] - truth, found.pole_covariance[at_truth])
    responses = []
    for point in found.response[:: max(1, len(found.response) // 8)]:
        error = point.response - complex(PLANT.response(np.array([point.omega_rad_s]))[0, 0, 0])
        parts = np.array([error.real, error.imag])
        responses.append(parts @ np.linalg.solve(np.array(point.covariance), parts) < CHI_SQUARE_2)
    region = loop_region(found.structures)
    assert region is not None
    num, den = PLANT.polynomials()
    off = (np.concatenate([region.num, region.den[1:]]) - np.concatenate([num, den[1:]]))[list(region.free)]
    joint = off @ np.linalg.solve(region.covariance, off) < chi2.ppf(0.95, off.size)
    return np.array([np.mean(poles), np.mean(responses), joint])


ROWS: dict[str, tuple[Callable[[int, float], BoolArray], tuple[str, ...], tuple[str, ...]]] = {
    "output error": (by_delay("output-error"), ("a0", "a1", "b", "h"), ("white", "AR(.9)")),
    "algebraic": (by_delay("algebraic"), ("a0", "a1", "b", "h"), ("white", "AR(.9)")),
    "two delays": (by_two_delays, ("a", "b", "h1", "h2"), ("white", "AR(.9)")),
    "points": (by_points(1200), ("regions",), ("white", "AR(.9)")),
    "points of 600 rows": (by_points(600), ("regions",), ("white", "AR(.9)")),
    "relay": (by_relay, ("at -180 deg", "with delay"), ("white", "AR(.9)")),
    "short loop": (by_short_loop, ("points", "design points"), ("of any colour",)),
    "loop": (by_loop, ("poles", "response", "joint region"), ("white",)),
    "online": (by_delay("online"), ("a0", "a1", "b", "h"), ("white", "AR(.9)")),
}


def row(name: str, colour: str) -> None:
    """Print the shares of one identifier under one noise."""
    once, quantities, _ = ROWS[name]
    inside, refused, begun = [], 0, time.process_time()
    for seed in range(RECORDS):
        try:
            inside.append(once(seed, COLOURS[colour]))
        except AutotuneError:
            refused += 1
    shares = np.mean(inside, axis=0)
    low, high = wilson(shares * len(inside), len(inside))
    columns = zip(quantities, shares, low, high, strict=True)
    said = ", ".join(f"{what} {share:.3f} ({a:.3f} to {b:.3f})" for what, share, a, b in columns)
    spent = (time.process_time() - begun) / RECORDS
    print(f"{name}, {colour}: {said}; {len(inside)} records, {refused} refused, {spent:.2f} s each", flush=True)


def main() -> None:
    """Print the table."""
    wanted = tuple(filter(None, os.environ.get("ROWS", "").split(",")))
    print(f"shares of 95 % intervals and regions that hold the truth, {RECORDS} records each, Wilson's interval beside")
    for name, (_, _, colours) in ROWS.items():
        if not wanted or name.startswith(wanted):
            for colour in colours:
                row(name, colour)


if __name__ == "__main__":
    main()
