"""Random plants of sixteen classes, and points of them as a relay sweep or bump tests of a slow plant give them.

``SEED`` of the environment draws other plants (0 by default).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator

import numpy as np

from autotune.arrays import FloatArray
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint

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
