"""Delay identification of random plants: do the 95 % intervals hold where plant, input and noise are drawn at random?

DELAY_RUNS sets the number of plants per order and input (default 20). Poles are drawn between 0.2 and 3 rad/s, real or
in pairs, the delay up to 2 s, the noise from 0.2 to 20 % of y's deviation: many of these records are poor on purpose.
A refusal is an answer; an interval that does not hold is not.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.signal import cont2discrete

from autotune.errors import IdentificationError
from autotune.identification.delay.identify import identify_delay
from autotune.recording import Recording

RUNS = int(os.environ.get("DELAY_RUNS", "20"))
DT = 0.05
ROWS = 2400
FINE = 20
INPUTS = ("prbs", "steps", "relay")


@dataclass(frozen=True, kw_only=True)
class Plant:
    """b exp(-s h) / prod(s - p), and whether it integrates."""

    poles: np.ndarray
    b: float
    delay_s: float
    integrator: bool

    @property
    def truth(self) -> np.ndarray:
        return np.array([*(-np.poly(self.poles).real[:0:-1]), self.b, self.delay_s])


def random_plant(order: int, rng: np.random.Generator) -> Plant:
    integrator = bool(rng.random() < 0.4)
    poles = [0.0] if integrator else []
    while len(poles) < order:
        size = np.exp(rng.uniform(np.log(0.2), np.log(3.0)))
        if order - len(poles) > 1 and rng.random() < 0.3:
            damping = rng.uniform(0.3, 0.95)
            pair = size * (-damping + 1j * np.sqrt(1 - damping**2))
            poles += [pair, np.conj(pair)]
        else:
            poles.append(-size)
    nonzero = [p for p in poles if p != 0.0]
    b = float(np.prod(np.abs(nonzero)) * rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0))
    return Plant(poles=np.array(poles), b=b, delay_s=DT / FINE * rng.integers(4, 800), integrator=integrator)


def recording_of(plant: Plant, kind: str, rng: np.random.Generator) -> Recording:
    """Twenty simulation steps per row; the relay has hysteresis and switches on the noisy output."""
    n = plant.poles.size
    companion = np.eye(n, k=1)
    companion[-1] = plant.truth[:n]
    F, G, *_ = cont2discrete((companion, plant.b * np.eye(n)[:, -1:], np.eye(n), np.zeros((n, 1))), DT / FINE)
    lag = round(plant.delay_s / (DT / FINE))
    noise = np.exp(rng.uniform(np.log(0.002), np.log(0.2))) * rng.standard_normal(ROWS)
    if kind == "relay":
        u, clean = _simulate(F, G.ravel(), lag, np.zeros(ROWS), np.zeros(ROWS), np.sign(plant.b), 1e-3)
        noise *= np.std(clean)
        u, clean = _simulate(F, G.ravel(), lag, u, noise, np.sign(plant.b), 1e-3 + 3.0 * np.std(noise))
    else:
        dwell = rng.integers(6, 120) if kind == "prbs" else ROWS // 4
        levels = rng.choice([-1.0, 1.0], ROWS // dwell + 1) if kind == "prbs" else np.array([0.0, 1.0, 1.0, -0.5, 0.0])
        u = np.repeat(levels, dwell)[:ROWS]
        _, clean = _simulate(F, G.ravel(), lag, u - u[0], noise, 0.0, 0.0)
        noise *= np.std(clean)
    return Recording(t=np.arange(ROWS) * DT, u=u + 3.0, y=clean + noise + 5.0, name=kind)


@njit(cache=True)
def _simulate(
    F: np.ndarray, G: np.ndarray, lag: int, u: np.ndarray, noise: np.ndarray, relay: float, hysteresis: float
) -> tuple[np.ndarray, np.ndarray]:
    """Input and noiseless output from rest; u as given, or of a relay in negative feedback where relay is +-1."""
    u, y = u.copy(), np.zeros(u.size)
    x, new = np.zeros(G.size), np.zeros(G.size)
    state = 1.0
    for k in range(u.size):
        y[k] = x[0]
        if relay != 0.0:
            if (y[k] + noise[k]) * relay * state > hysteresis:
                state = -state
            u[k] = state
        for i in range(FINE * k, FINE * k + FINE):
            w = u[(i - lag) // FINE] if i >= lag else 0.0
            for q in range(x.size):
                new[q] = G[q] * w
                for r in range(x.size):
                    new[q] += F[q, r] * x[r]
            x[:] = new
    return u, y


def errors_in_deviations(plant: Plant, recording: Recording) -> np.ndarray | None:
    """Errors of a_i, b and h in the standard deviations that are reported, or None where the record was refused."""
    order = plant.poles.size
    try:
        model = identify_delay(recording, order, integrator=plant.integrator)
    except IdentificationError:
        return None
    sd = model.standard_deviations[: order + 2]
    free = sd > 0.0
    return (model.values[: order + 2] - plant.truth)[free] / sd[free]


def main() -> None:
    print(f"{RUNS} random plants per order and input, told the order and whether the plant integrates")
    for order in (1, 2, 3, 4):
        for kind in INPUTS:
            rng = np.random.default_rng([order, INPUTS.index(kind)])
            kept, seconds = [], []
            for _ in range(RUNS):
                plant = random_plant(order, rng)
                recording = recording_of(plant, kind, rng)
                begun = time.process_time()
                errors = errors_in_deviations(plant, recording)
                seconds.append(time.process_time() - begun)
                if errors is not None:
                    kept.append(errors)
            label = (
                f"  order {order}, {kind:5}: refused {RUNS - len(kept)}/{RUNS}, {1e3 * np.median(seconds):.0f} ms CPU"
            )
            if not kept:
                print(label)
                continue
            shares = np.array([np.mean(np.abs(errors) < 1.96) for errors in kept])
            print(
                f"{label}; 95 % intervals hold {100 * shares.mean():.1f} +-"
                f" {196 * max(shares.std(), 1 / len(shares)) / np.sqrt(len(shares)):.1f} %,"
                f" worst error {np.abs(np.concatenate(kept)).max():.1f} sd"
            )
