"""Coverage, bias and efficiency of the frequency points on simulated plants; ``FREQUENCY_RUNS`` sets the count."""

from __future__ import annotations

import math
import os
import time
from contextlib import redirect_stdout
from functools import partial
from typing import Literal

import numpy as np

from autotune.identification.frequency.limit_cycle_points import limit_cycle_points
from autotune.identification.frequency.recorded import frequency_points
from autotune.identification.reduction import reduce_points
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint
from autotune.recording import Recording
from tests.autotune.identification.relay_loop import BALL, drive, held, last_periods, relay_loop
from tests.benchmarks._side_by_side import print_all

RUNS = int(os.environ.get("FREQUENCY_RUNS", "40"))
RUNS_OF_RECORDINGS, RUNS_OF_REDUCTIONS = max(RUNS // 3, 10), max(RUNS // 2, 10)
LAGS = TransferFunction(num=(2.0,), den=(1.0, 3.0, 1.0))
FIRST = TransferFunction(num=(2.0,), den=(2.0, 1.0))


def deviation(point: FrequencyPoint, plant: TransferFunction) -> tuple[complex, bool]:
    """Return the relative error and whether the 95 % region holds the truth."""
    truth = complex(plant.response(np.array([point.omega_rad_s]))[0])
    error = point.response - truth
    parts = np.array([error.real, error.imag])
    return error / truth, bool(parts @ np.linalg.solve(np.array(point.covariance), parts) < 5.991)


def relay_head() -> None:
    print(f"relay on plant (23), 10 ms, noise uniform +-0.35 V, {RUNS} runs each")
    print("delay  d     periods  phase   amplitude  bias gain  phase     sd gain  phase     var/CRB  in 95 %  CPU")


def relay_row(delay: int, d: float, periods: int, runs: int) -> None:
    errors, inside, bound, cpu = [], [], [], 0.0
    for seed in range(runs):
        n = int(100 * (20 + periods * (1.0 + 0.05 * delay)))
        noise = np.random.default_rng(seed).uniform(-0.35, 0.35, n)
        error = 0.1 * d * (seed % 3)
        t, u, y = relay_loop(BALL, d=d, hysteresis=0.4, delay=delay, noise=noise, midpoint_error=error)
        use = last_periods(t, u, periods, d)
        start = time.process_time()
        cycle = limit_cycle_points(t[use], u[use], y[use])
        cpu += time.process_time() - start
        relative, held_in = deviation(cycle.points[0], BALL)
        errors.append(relative)
        inside.append(held_in)
        rows = (cycle.end_s - cycle.start_s) / 0.01
        bound.append(0.35**2 / 3 / (2 * rows * (2 * d / math.pi) ** 2) / cycle.points[0].gain ** 2)
    e = np.array(errors)
    efficiency = np.mean(np.abs(e) ** 2) / (2 * np.mean(bound))
    phase = np.degrees(np.angle(-BALL.response(np.array([cycle.points[0].omega_rad_s]))))[0]
    print(
        f"{delay / 100:4.1f} s {d:.2f} {periods:6d} {phase:10.1f} {cycle.y_amplitude:8.2f} V"
        f" {100 * e.real.mean():9.3f} % {np.degrees(e.imag.mean()):7.3f}° {100 * e.real.std():7.3f} %"
        f" {np.degrees(e.imag.std()):7.3f}° {efficiency:7.2f} {100 * np.mean(inside):8.1f}"
        f" {1e3 * cpu / runs:6.1f} ms"
    )


def _closed_loop(plant: TransferFunction, r: np.ndarray, noise: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = held(plant, dt)
    x, integral = np.zeros(b.size), 0.0
    u, y = np.empty(r.size), np.empty(r.size)
    for k in range(r.size):
        y[k] = c @ x + noise[k]
        integral += 0.4 * (r[k] - y[k]) * dt
        u[k] = 0.8 * (r[k] - y[k]) + integral
        x = a @ x + b * u[k]
    return u, y


def _recording(kind: str, plant: TransferFunction, rng: np.random.Generator) -> Recording:
    n, dt = 4000, 0.05
    noise = rng.normal(0.0, 0.1, n)
    binary = np.repeat(rng.choice([-1.0, 1.0], n // 10), 10)
    t = dt * np.arange(n)
    if kind == "closed loop":
        r = np.repeat(rng.choice([-1.0, 1.0], n // 40), 40)
        u, y = _closed_loop(plant, r, noise, dt)
        return Recording(t=t, u=u, y=y, extra={"r": r})
    if kind == "multisine":
        grid, phases = np.arange(500), rng.uniform(0, 2 * np.pi, 30)
        u = np.tile(sum(np.cos(2 * np.pi * (2 * k + 1) * grid / 500 + phases[k]) for k in range(30)), 8)
    else:
        u = binary if kind == "random binary" else np.repeat(rng.uniform(-1, 1, 20), n // 20)
    return Recording(t=t, u=u, y=drive(plant, u, dt) + noise)


def recording_head() -> None:
    print(f"\nother excitations, 4000 rows at 50 ms, white noise sd 0.1, {RUNS_OF_RECORDINGS} runs each")
    print("plant        excitation      points/run  in 95 %  median sd")


def recording_row(name: str, plant: TransferFunction, kind: str, runs: int) -> None:
    inside, sd = [], []
    for seed in range(runs):
        recording = _recording(kind, plant, np.random.default_rng(seed))
        for point in frequency_points(recording, largest_relative_sd=0.3).points:
            inside.append(deviation(point, plant)[1])
            sd.append(math.sqrt(point.covariance[0][0]) / point.gain)
    print(f"{name:12} {kind:15} {len(inside) / runs:8.1f} {100 * np.mean(inside):9.1f} {100 * np.median(sd):8.1f} %")


def reduction_head() -> None:
    print(
        f"\nreduced model of (23) from five points, sd 0.4 % and 0.25 deg, {RUNS_OF_REDUCTIONS} runs;"
        " exact: -65.5 and 5.2138"
    )


def reduction_row(conditions: Literal["regions", "estimates"]) -> None:
    omega = np.array([0.72, 1.2, 2.2, 3.6, 5.6])
    truth = BALL.response(omega)
    grid = np.geomspace(1e-3, 500.0, 4000)
    H = -BALL.response(grid)
    phase = np.unwrap(np.angle(H))
    before = phase >= -0.75 * np.pi
    rows, c1, c2 = [], [], []
    for seed in range(RUNS_OF_REDUCTIONS):
        e = np.random.default_rng(seed).standard_normal((5, 2)) * [0.004, 0.0044]
        points = [
            FrequencyPoint(
                omega_rad_s=float(w),
                response=complex(g * (1 + a + 1j * b)),
                covariance=((float(0.0042 * abs(g)) ** 2, 0.0), (0.0, float(0.0042 * abs(g)) ** 2)),
            )
            for w, g, (a, b) in zip(omega, truth, e, strict=True)
        ]
        reduced = reduce_points(points, conditions=conditions)
        H_r = -reduced.response(grid)
        rows.append((reduced.G_r, reduced.omega_d_rad_s))
        c1.append(np.all(np.abs(H_r) >= np.abs(H)))
        c2.append(np.all(np.unwrap(np.angle(H_r))[before] <= phase[before]))
    mean = np.mean(rows, axis=0)
    print(
        f"{conditions:10} G_r {mean[0]:.2f}, omega_d {mean[1]:.3f};"
        f" C1 holds {100 * np.mean(c1):.0f} %, C2 {100 * np.mean(c2):.0f} %,"
        f" both {100 * np.mean(np.logical_and(c1, c2)):.0f} %"
    )


def warm_up() -> None:
    with redirect_stdout(None):
        relay_row(10, 0.1, 8, runs=1)
        recording_row("one lag", FIRST, "closed loop", runs=1)


def main() -> None:
    relays = ((10, 0.1, 8), (30, 0.08, 3), (30, 0.08, 12), (60, 0.05, 4), (120, 0.03, 3), (200, 0.02, 3))
    excitations = ("random binary", "multisine", "steps", "closed loop")
    plants = (("two lags", LAGS), ("one lag", FIRST))
    print_all(
        [
            relay_head,
            *(partial(relay_row, *relay, RUNS) for relay in relays),
            recording_head,
            *(partial(recording_row, *plant, kind, RUNS_OF_RECORDINGS) for plant in plants for kind in excitations),
            reduction_head,
            *(partial(reduction_row, conditions) for conditions in ("regions", "estimates")),
        ],
        warm_up,
    )
