"""Jitter of the time stamps: the residual's size over the slope of the reading."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.thresholds import Thresholds
from autotune.models import Parameter
from autotune.recording import Recording


def jitter_effect(
    result: Fit, recordings: Sequence[Recording], least_decrease: float = Thresholds.jitter_decrease
) -> SampleEffect | None:
    """Return timing jitter where the residual's variance grows with the output's squared slope.

    A stamp that is wrong by d adds d dy/dt to the reading: Var e = s^2 + d_sd^2 (dy/dt)^2.
    """
    slopes, squares = [], []
    for r, e, out in zip(recordings, result.residuals, result.signals, strict=True):
        slope = np.gradient(out[:, 0], r.t)
        use = (e != 0.0) & np.isfinite(slope)
        slopes.append(slope[use] ** 2)
        # the fast part alone: what is missing and slow grows with the slope
        fast = np.zeros_like(e)
        fast[1:-1] = (e[1:-1] - 0.5 * (e[:-2] + e[2:])) / np.sqrt(1.5)
        squares.append(fast[use] ** 2)
    x, z = np.concatenate(slopes), np.concatenate(squares)
    level = float(np.median(z)) / 0.455
    if level <= 0.0 or float(np.ptp(x)) == 0.0:
        return None
    z = np.minimum(z, 20.0 * float(np.mean(z)))
    X = np.column_stack([np.ones(x.size), x])
    weight = 1.0 / level
    for _ in range(3):
        coefficients = np.linalg.lstsq(X * np.sqrt(weight)[..., None] if np.ndim(weight) else X * weight**0.5,
                                       z * np.sqrt(weight), rcond=None)[0]  # fmt: skip
        weight = 1.0 / np.maximum(X @ np.maximum(coefficients, [1e-6 * level, 0.0]), 1e-3 * level) ** 2
    fitted = np.maximum(X @ np.maximum(coefficients, [1e-6 * level, 0.0]), 1e-9 * level)
    constant = float(np.mean(z))
    gain = float(np.sum(np.log(constant) + z / constant - np.log(fitted) - z / fitted))
    if coefficients[1] <= 0.0 or gain < least_decrease:
        return None
    sd = float(np.sqrt(coefficients[1]))
    return SampleEffect(
        name="timing.jitter",
        equation="y is taken at t + d, d random from row to row",
        parameters={"sd": Parameter(value=sd, unit="s")},
        evidence=gain,
    )
