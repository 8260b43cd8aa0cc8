"""Jitter of the time stamps: the residual's size over the slope of the reading."""

from __future__ import annotations

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.adequacy import is_noise
from autotune.diagnosis.evidence.constancy import largest_variation
from autotune.diagnosis.evidence.samples import JITTER, SampleEffect
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.models import Parameter

#: Times that slope and weights are estimated in turn, and means of the squares at which single ones are cut.
TURNS, LARGEST = 3, 20.0


def jitter_effect(result: Fit, data: Data) -> SampleEffect | None:
    """Return timing jitter where the residual's variance grows with the output's squared slope.

    Parameters
    ----------
    result : Fit
        A fit at its minimum.
    data : Data
        What it was fitted to.

    Notes
    -----
    A stamp that is wrong by d adds d dy/dt to the reading: Var e = s^2 + d_sd^2 (dy/dt)^2. It disturbs single rows;
    what goes with a signal grows with the slope as well, so that nothing else may explain more of the residual.
    """
    x, z = _squares(result, data)
    level = float(np.median(z)) / 0.455
    if level <= 0.0 or float(np.ptp(x)) == 0.0:
        return None
    z = np.minimum(z, LARGEST * float(np.mean(z)))
    X, weight = np.column_stack([np.ones(x.size), x]), np.full(x.size, 1.0 / level)
    for _ in range(TURNS):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(X * root[:, None], z * root, rcond=None)[0]
        varies = X @ np.maximum(coefficients, [1e-6 * level, 0.0])
        weight = 1.0 / np.maximum(varies, 1e-3 * level) ** 2
    fitted, constant = np.maximum(varies, 1e-9 * level), float(np.mean(z))
    gain = float(np.sum(np.log(constant) + z / constant - np.log(fitted) - z / fitted))
    if coefficients[1] <= 0.0 or gain < data.thresholds.beyond_chance:
        return None
    if not (is_noise(result, data) and largest_variation(result, data).gain < gain):
        return None
    return SampleEffect(
        name=JITTER,
        equation="y is taken at t + d, d random from row to row",
        parameters={"sd": Parameter(value=float(np.sqrt(coefficients[1])), unit="s")},
        evidence=gain,
    )


def _squares(result: Fit, data: Data) -> tuple[FloatArray, FloatArray]:
    """Return the reading's squared slope and the residual's square, of its fast part, at all rows that count.

    What is missing and slow grows with the slope. A row's neighbours count as well: of a long recording windows are
    left out, and no difference reaches across them.
    """
    slopes, squares = [], []
    for r, e, out in zip(data.recordings, result.residuals, result.signals, strict=True):
        slope = np.gradient(out[:, 0], r.t)
        use = (e != 0.0) & np.isfinite(slope)
        use[1:-1] &= (e[2:] != 0.0) & (e[:-2] != 0.0)
        slopes.append(slope[use] ** 2)
        fast = np.zeros_like(e)
        fast[1:-1] = (e[1:-1] - 0.5 * (e[:-2] + e[2:])) / np.sqrt(1.5)
        squares.append(fast[use] ** 2)
    return np.concatenate(slopes), np.concatenate(squares)
