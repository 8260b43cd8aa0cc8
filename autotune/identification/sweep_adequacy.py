"""Whether the rows of a sweep show what a fitted equation has not: a Lagrange multiplier test on its limit cycles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import fdtrc

from autotune.arrays import FloatArray
from autotune.identification.delay.data import DelayData
from autotune.identification.delay.output_error import residuals
from autotune.identification.delay.response import sensitivities
from autotune.identification.frequency.limit_cycle import WholePeriods
from autotune.identification.noise_colour import whitening_filter
from autotune.identification.sweep_equations import Fitted

#: what the three groups of columns show
TESTS = ("other dynamics", "a nonlinearity", "a drift or a load")
#: harmonics of a limit cycle that are tested
HARMONICS = 5
#: columns less independent of those before repeat them
_INDEPENDENT = 1e-11


def own_columns(t: FloatArray, windows: Sequence[WholePeriods]) -> tuple[FloatArray, FloatArray]:
    """Return columns of each cycle's own, and of the rows before the first, and which test each column is of.

    Parameters
    ----------
    t : (N,) array
        Time stamps [s].
    windows : sequence of WholePeriods
        The sweep's limit cycles.

    Returns
    -------
    tuple of array
        The (N, K) columns, and (K,) places in :data:`TESTS`.
    """
    columns, kinds = [], []
    for window in windows:
        inside = (t >= window.start_s - 1e-9) & (t < window.end_s - 1e-9)
        for order in range(1, HARMONICS + 1):
            turned = np.where(inside, np.exp(1j * order * window.omega_rad_s * t), 0.0)
            columns += [turned.real, turned.imag]
            kinds += [0 if order == 1 else 1] * 2
        columns += _offset_and_drift(t, inside)
        kinds += [2, 2]
    before = t < min(window.start_s for window in windows)
    if before.sum() > 2:
        columns += _offset_and_drift(t, before)
        kinds += [2, 2]
    return np.column_stack(columns), np.array(kinds)


def _offset_and_drift(t: FloatArray, inside: Any) -> list[FloatArray]:
    x = (t - t[inside].mean()) / max(float(np.ptp(t[inside])), 1e-300)
    return [np.where(inside, 1.0, 0.0), np.where(inside, x, 0.0)]


def _sensitivities(data: DelayData, found: Fitted) -> FloatArray:
    at = found.point
    return np.asarray(sensitivities(data, at.a, at.h, at.theta)[:, found.structure.free])


def colour_beside(data: DelayData, found: Fitted, columns: FloatArray) -> FloatArray:
    """Return the filter that whitens what is left beside the cycles' own columns: a wrong model is no noise.

    Parameters
    ----------
    data : DelayData
        N rows.
    found : Fitted
        The model.
    columns : (N, K) array
        As of :func:`own_columns`.

    Returns
    -------
    (p,) array
        Coefficients of the filter.
    """
    every, residual = np.column_stack([_sensitivities(data, found), columns]), residuals(data, found.point)
    solution, _, _ = _least_squares(every.T @ every, every.T @ residual)
    return whitening_filter(residual - every @ solution)


def judge_equation(
    data: DelayData, found: Fitted, columns: FloatArray, kinds: FloatArray, whitening: FloatArray
) -> tuple[tuple[float, float, float], float]:
    """Return the probabilities of the three tests, and the variance ratio of the fundamentals, 1 at least.

    Parameters
    ----------
    data : DelayData
        N rows.
    found : Fitted
        The model.
    columns, kinds : (N, K), (K,) arrays
        As of :func:`own_columns`.
    whitening : (p,) array
        Coefficients of the filter that makes the noise white.
    """
    from scipy.signal import lfilter  # here: it takes long to import, and few recordings come this way

    residual = residuals(data, found.point)
    rows = np.column_stack([_sensitivities(data, found), columns, residual])
    white = lfilter([1.0, *whitening], [1.0], rows, axis=0)[whitening.size :]
    gram = white.T @ white
    of = np.concatenate([np.full(len(gram) - 1 - kinds.size, -1), kinds])

    def explain(*which: int) -> tuple[float, int]:
        kept = np.flatnonzero(np.isin(of, (-1, *which)))
        _, squares, rank = _least_squares(gram[np.ix_(kept, kept)], gram[kept, -1])
        return squares, rank

    (by_model, rank), (by_all, full) = explain(), explain(*range(len(TESTS)))
    freedom = len(white) - full
    variance = (float(gram[-1, -1]) - by_all) / freedom
    each = [explain(kind) for kind in range(len(TESTS))]
    ratios = [(squares - by_model) / max(more - rank, 1) / variance for squares, more in each]
    p = [float(fdtrc(max(more - rank, 1), freedom, ratio)) for ratio, (_, more) in zip(ratios, each, strict=True)]
    return (p[0], p[1], p[2]), max(1.0, ratios[0])


def _least_squares(gram: FloatArray, products: FloatArray) -> tuple[FloatArray, float, int]:
    """Return the solution, the sum of squares that it explains, and the rank, of columns' products among themselves."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = values > _INDEPENDENT * values[-1]
    along = vectors[:, kept].T @ (scale * products)
    solution = scale * (vectors[:, kept] @ (along / values[kept]))
    return solution, float(along @ (along / values[kept])), int(kept.sum())
