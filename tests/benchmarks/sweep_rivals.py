"""The relay sweep beside superposed sines and a chirp on the linear ball: rig time to equal errors.

All keep y within the same distance of the operating point, without its noise, and are asked for the response at the
frequencies of the relay's points. *Superposed sines*: one at each of them, added to the command of a slow PI, as
closed-loop autotuners do that inject them (200 over the crossover's frequency is what one of them runs); sines of the
same size in y, of the phases with the lowest peak among some hundred, which need the plant: the operator of a rig does
not have them. Responses are ratios of the sines that fit y and u best, beside offset and drift. *Chirp*: from one end
of the band to the other in logarithmic time, as large in y throughout, which needs the plant too. *One equation*: an
equation with dead time fitted to all rows, the relay's way of estimating, for the rivals' records.

An error is the root of the mean square, relative, over points and seeds; its square falls with the time, from which
follows the time to the relay's error. ``SEEDS=20 python -m tests.benchmarks sweep_rivals``.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.config import load_config
from autotune.experiment.run import run_experiment
from autotune.identification.recorded_plant import fit_recordings
from autotune.recording import Recording
from drivers.simulated import SimulatedRig
from sim.ball import linear_ball

CONFIG = load_config(Path(__file__).resolve().parents[2] / "configs" / "ball_sim.toml")
STEP_S, Y, U, NOISE = 0.01, 5.0, 5.0, 0.35
#: largest departure of y: what the relay's limit cycles are planned for
PEAK = 0.87 * 3.0
#: the PI that runs under the rivals, slow and stable, and how long a rival is recorded beside its settling [s]
K, TI_S = -0.01, 6.0
RECORDED_S = 133.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """Relative errors of the points of one seed, and the rig time that they took [s]."""

    errors: ComplexArray
    time_s: float


def swept(seed: int, *, together: bool) -> tuple[Found, FloatArray]:
    """Run the relay's sweep; return what it found, and at which frequencies [rad/s]."""
    experiment = CONFIG.experiment.model_copy(update={"together": together, "budget_s": 120.0})
    config = CONFIG.model_copy(
        update={
            "experiment": experiment,
            "limits": CONFIG.limits.model_copy(update={"u_safe": U}),
            "operating_point": CONFIG.operating_point.model_copy(update={"approach": "hold"}),
        }
    )
    ball = linear_ball(noise=NOISE, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        result = run_experiment(SimulatedRig(ball, u_safe=U), config, Path(folder) / "sweep.csv")
    omega = np.array([point.omega_rad_s for point in result.points])
    response = np.array([point.response for point in result.points])
    taken_s = max(one.end_s for one in result.segments) - result.segments[0].start_s
    return Found(errors=response / ball.response(omega) - 1.0, time_s=taken_s), omega


def recorded(seed: int, injected: Callable[[float], float], duration_s: float, noise: float) -> Recording:
    """Record the ball under the slow PI with something added to its command."""
    ball, integral = linear_ball(noise=noise, seed=seed), 0.0
    rows = np.empty((round(duration_s / STEP_S), 3))
    for k in range(len(rows)):
        y = ball.measure()
        integral += K / TI_S * (Y - y) * STEP_S
        u = U + K * (Y - y) + integral + injected(k * STEP_S)
        rows[k] = k * STEP_S, u, y
        ball.advance(u, STEP_S)
    return Recording(t=rows[:, 0], u=rows[:, 1], y=rows[:, 2], name="rival")


def scaled(injected: Callable[[float], float], duration_s: float) -> Callable[[float], float]:
    """Return the injection as large as keeps y, without its noise, within the peak."""
    away = float(np.max(np.abs(recorded(0, injected, duration_s, 0.0).y - Y)))
    return lambda t: PEAK / away * injected(t)


def answer(omega: FloatArray) -> ComplexArray:
    """Return the response of y to what is injected."""
    H, s = linear_ball().response(omega), 1j * omega
    return np.asarray(H / (1.0 + H * K * (1.0 + 1.0 / (s * TI_S))))


def sines(omega: FloatArray, duration_s: float) -> Callable[[float], float]:
    """Return sines of one size in y, of the phases whose sum in y is smallest at its largest."""
    random, t = np.random.default_rng(0), np.arange(0.0, duration_s, 5.0 * STEP_S)
    tried = random.uniform(0.0, 2.0 * math.pi, (300, omega.size))
    peaks = [np.max(np.abs(np.cos(t[:, None] * omega + phases).sum(axis=1))) for phases in tried]
    size = 1.0 / np.abs(answer(omega))
    phases = tried[int(np.argmin(peaks))] - np.angle(answer(omega))
    return scaled(lambda t: float(np.sum(size * np.cos(omega * t + phases))), duration_s)


def chirp(omega: FloatArray, duration_s: float) -> Callable[[float], float]:
    """Return a chirp over the band, downwards, as large in y throughout."""
    high, low = float(omega.max()), float(omega.min())
    rate = math.log(low / high) / duration_s

    def injected(t: float) -> float:
        now = high * math.exp(rate * t)
        return float(math.sin((now - high) / rate) / np.abs(answer(np.array([now])))[0])

    return scaled(injected, duration_s)


def by_sines(record: Recording, omega: FloatArray) -> ComplexArray:
    """Return the ratio of the sines that fit y and u best; u is held over a sample."""
    turned = np.exp(1j * record.t[:, None] * omega)
    basis = np.column_stack([turned.real, turned.imag, np.ones(len(record)), record.t - record.t.mean()])
    fitted, *_ = np.linalg.lstsq(basis, np.column_stack([record.y, record.u]), rcond=None)
    y, u = (fitted[: omega.size, i] - 1j * fitted[omega.size : 2 * omega.size, i] for i in (0, 1))
    x = 0.5 * omega * STEP_S
    return np.asarray(y / (u * np.exp(-1j * x) * np.sinc(x / math.pi)))


def by_equation(record: Recording, omega: FloatArray) -> ComplexArray:
    """Return the response of the equation with dead time that all rows give."""
    return fit_recordings([record]).plant.response(omega)


def main() -> None:
    """Print one line for each method."""
    seeds = range(1, 1 + int(os.environ.get("SEEDS", "20")))
    relay: dict[bool, list[Found]] = {True: [], False: []}
    bands = []
    for seed in seeds:
        for together in (True, False):
            found, omega = swept(seed, together=together)
            relay[together].append(found)
            if together:
                bands.append(omega)
    omega = np.median([band for band in bands if band.size == bands[0].size], axis=0)
    settling_s = 2.0 * math.pi / float(omega.min())
    duration_s = settling_s + RECORDED_S
    several, one = sines(omega, duration_s), chirp(omega, duration_s)
    rows = {"relay, all points together": relay[True], "relay, each point by itself": relay[False]}
    truth = linear_ball().response(omega)
    ways = (
        ("superposed sines, each by itself", several, by_sines),
        ("superposed sines, one equation", several, by_equation),
        ("chirp, one equation", one, by_equation),
    )
    for name, injected, estimate in ways:
        rows[name] = []
        for seed in seeds:
            record = recorded(seed, injected, duration_s, NOISE)
            kept = record.only(np.flatnonzero(record.t >= settling_s)) if estimate is by_sines else record
            rows[name].append(Found(errors=estimate(kept, omega) / truth - 1.0, time_s=duration_s))
    wanted, least_s = _rms(rows["relay, all points together"]), _median_s(rows["relay, all points together"])
    print(f"linear ball, {len(seeds)} seeds, y within {PEAK:.2f} V, noise of sd {NOISE / math.sqrt(3):.2f} V")
    print(f"band {omega.min():.2f} to {omega.max():.2f} rad/s")
    print(f"{'':>34} {'run [s]':>8} {'error':>7} {'time to equal error':>20}")
    for name, found in rows.items():
        error, time_s = _rms(found), _median_s(found)
        begun_s = 0.0 if name.startswith("relay") else settling_s
        equal_s = begun_s + (time_s - begun_s) * (error / wanted) ** 2
        print(f"{name:>34} {time_s:8.1f} {100 * error:6.2f}% {equal_s:12.1f} s = {equal_s / least_s:4.2f}", flush=True)


def _rms(found: list[Found]) -> float:
    return float(np.sqrt(np.mean(np.abs(np.concatenate([one.errors for one in found])) ** 2)))


def _median_s(found: list[Found]) -> float:
    return float(np.median([one.time_s for one in found]))
