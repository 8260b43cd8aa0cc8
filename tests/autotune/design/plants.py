"""Plants that several tests of this room use."""

from __future__ import annotations

import math

import numpy as np

from autotune.models import TransferFunction
from autotune.points import FrequencyPoint

#: (23) of Le & Mendes: the ball in its tube.
BALL = TransferFunction(num=(-65.5,), den=(2.02e-5, 0.007328, 0.3836, 1.0, 0.0))
#: (24) with Table I: G_r = -65, omega_d = 5.17.
REDUCED = TransferFunction(num=(65.0, -65.0 * 5.17), den=(1.0, 5.17, 0.0))

FOPDT = TransferFunction(num=(1.0,), den=(1.0, 1.0), delay_s=1.0)
LAG_DOMINATED = TransferFunction(num=(2.0,), den=(20.0, 1.0), delay_s=0.5)
DELAY_DOMINATED = TransferFunction(num=(1.0,), den=(0.3, 1.0), delay_s=1.0)
EIGHT_LAGS = TransferFunction(num=(1.0,), den=tuple(float(math.comb(8, k)) for k in range(9)))
UNSTABLE = TransferFunction(num=(1.0,), den=(1.0, -1.0), delay_s=0.05)


def measured(
    plant: TransferFunction,
    seed: int | None,
    *,
    phases_deg: tuple[float, ...] = (-105.0, -118.75, -132.5, -146.25, -160.0),
    gain_sd: float = 0.004,
    phase_sd_deg: float = 0.25,
) -> tuple[FrequencyPoint, ...]:
    """Points of the plant at phases of its positive-gain form, with noise where a seed is given."""
    rng = np.random.default_rng(seed)
    grid = np.geomspace(1e-3, 1e3, 40001)
    response = plant.response(grid)
    phase = np.degrees(np.unwrap(np.angle(response)))
    phase -= 360.0 * round(phase[0] / 360.0) if abs(phase[0]) > 180.0 else 0.0
    phase -= 180.0 if phase[0] > 1.0 else 0.0
    omega = np.interp(-np.array(phases_deg), -phase, grid)
    sd = np.array([gain_sd, math.radians(phase_sd_deg)])
    points = []
    for w in omega:
        true = complex(plant.response(np.array([w]))[0])
        error = rng.normal(size=2) * sd if seed is not None else np.zeros(2)
        estimate = true * np.exp(error[0] + 1j * error[1])
        turn = np.array([[estimate.real, -estimate.imag], [estimate.imag, estimate.real]])
        c = turn @ np.diag(sd**2) @ turn.T
        points.append(
            FrequencyPoint(
                omega_rad_s=float(w),
                response=complex(estimate),
                covariance=((float(c[0, 0]), float(c[0, 1])), (float(c[1, 0]), float(c[1, 1]))),
            )
        )
    return tuple(points)
