"""Small compiled pieces of the delay identification: matrix exponential, normal equations, autocovariances."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from autotune.arrays import FloatArray

_TERMS = 10  # of the exponential series: with a norm up to 1/4 the remainder is below 1e-13


@njit(cache=True)
def transition(a: FloatArray, duration: float) -> FloatArray:
    """Return the transition matrix of (s, x, w, v) over a duration: x^(n) = sum a_i x^(i) + w, w' = v.

    Parameters
    ----------
    a : (n,) array
        Coefficients a_0..a_{n-1} [1/s^(n-i)].
    duration : float
        Length of the piece [s].

    Returns
    -------
    (2n+2, 2n+2) array
        States in the order s..s^(n-1), x..x^(n-1), w, v.
    """
    n = a.size
    m = 2 * n + 2
    rate = 1e-6 / duration  # bound of the poles' magnitudes (Fujiwara): time in its unit, so that no entry dominates
    for i in range(n):
        rate = max(rate, 2.0 * abs(a[i]) ** (1.0 / (n - i)))
    scale = np.empty(m)
    for i in range(n):
        scale[n + i] = rate**i
        scale[i] = rate ** (i - n)
    scale[2 * n] = rate**n
    scale[2 * n + 1] = rate ** (n + 1)
    matrix = np.zeros((m, m))
    for i in range(n - 1):
        matrix[i, i + 1] = 1.0
        matrix[n + i, n + i + 1] = 1.0
    for i in range(n):
        matrix[n - 1, i] = a[i] / rate ** (n - i)
        matrix[2 * n - 1, n + i] = a[i] / rate ** (n - i)
    matrix[n - 1, n] = 1.0
    matrix[2 * n - 1, 2 * n] = 1.0
    matrix[2 * n, 2 * n + 1] = 1.0
    squarings = max(0, math.ceil(math.log2(rate * duration * 2.0 / 0.25)))
    matrix *= rate * duration / 2.0**squarings
    result = np.eye(m) + matrix
    power = matrix
    for term in range(2, _TERMS + 1):
        power = power @ matrix / term
        result += power
        if np.max(np.abs(power)) < 1e-17:
            break
    for _ in range(squarings):
        result = result @ result
    for i in range(m):
        for j in range(m):
            result[i, j] *= scale[i] / scale[j]
    return result


@njit(cache=True)
def cholesky_solve(G: FloatArray, g: FloatArray, smallest_pivot: float) -> tuple[FloatArray, float, bool]:
    """Return x of G x = g, g^T x and whether every pivot, relative to its diagonal entry, exceeds the smallest.

    Parameters
    ----------
    G : (p, p) array
        Symmetric, positive definite; scaled by its diagonal inside.
    g : (p,) array
        Right-hand side.
    smallest_pivot : float
        What counts as singular; 1e-12 leaves four digits.
    """
    p = g.size
    x = np.zeros(p)
    scale = np.empty(p)
    for i in range(p):
        if not G[i, i] > 0.0:
            return x, 0.0, False
        scale[i] = 1.0 / math.sqrt(G[i, i])
    L = np.zeros((p, p))
    z = np.empty(p)
    explained = 0.0
    for i in range(p):
        for j in range(i + 1):
            total = G[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > smallest_pivot:
                L[i, i] = math.sqrt(total)
            else:
                return x, 0.0, False
        total = g[i] * scale[i]
        for k in range(i):
            total -= L[i, k] * z[k]
        z[i] = total / L[i, i]
        explained += z[i] * z[i]
    for i in range(p - 1, -1, -1):
        total = z[i]
        for k in range(i + 1, p):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]
    for i in range(p):
        x[i] *= scale[i]
    return x, explained, True


@njit(cache=True)
def autocovariances(values: FloatArray, lags: int) -> FloatArray:
    """Return the sums of products at lags 0..lags, divided by the number of rows, shape (lags + 1,)."""
    result = np.zeros(lags + 1)
    for lag in range(lags + 1):
        total = 0.0
        for k in range(lag, values.size):
            total += values[k] * values[k - lag]
        result[lag] = total / values.size
    return result
