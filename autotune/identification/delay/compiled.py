"""Small compiled pieces of the delay identification: matrix exponential and normal equations."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from autotune.arrays import FloatArray

_TERMS = 10  # of the exponential series: with a norm up to 1/4 the remainder is below 1e-13


@njit(cache=True, nogil=True)
def transitions(a: FloatArray, durations: FloatArray) -> FloatArray:
    """Return the blocks (E, S, G, H) of the transitions of (s, x, w, v): x^(n) = sum a_i x^(i) + w, w' = v, s likewise.

    Parameters
    ----------
    a : (n,) array
        Coefficients a_0..a_{n-1} [1/s^(n-i)].
    durations : (count,) array
        Lengths of the pieces [s], at least 0.

    Returns
    -------
    (count, n, 2n+4) array
        Per duration E (n columns), S (n), G (2) and H (2): x becomes E x + H (w, v), and s, the response of the same
        system to x, becomes E s + S x + G (w, v).

    Notes
    -----
    The powers of the matrix are shared, so that a duration costs one polynomial per entry and, where it is long
    against the plant's fastest time constant, a few squarings.
    """
    n = a.size
    m = 2 * n + 2
    longest = np.max(durations)
    rate = 1e-6 / longest if longest > 0.0 else 1.0
    for i in range(n):  # bound of the poles' magnitudes (Fujiwara): time in its unit, so that no entry dominates
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
    width = 2 * n + 4
    series = np.empty((_TERMS + 1, n * width))
    power = np.zeros((m, m))  # as `numpy.eye` and `numpy.outer` have it, which are slow to compile
    for i in range(m):
        power[i, i] = 1.0
    for term in range(_TERMS + 1):
        blocks = _blocks(power, n)
        for q in range(n * width):
            series[term, q] = blocks[q // width, q % width]
        power = power @ matrix / (term + 1)
    for i in range(m):
        for j in range(m):
            matrix[i, j] = scale[i] * (1.0 / scale[j])
    unscaled = _blocks(matrix, n)
    result = np.empty((durations.size, n, width))
    entries = np.empty(n * width)
    for c in range(durations.size):
        squarings = 0
        tau = rate * durations[c]
        while 2.0 * tau > 0.25:
            tau *= 0.5
            squarings += 1
        terms = 1
        remainder = 2.0 * tau
        while terms < _TERMS and remainder > 1e-17:
            terms += 1
            remainder *= 2.0 * tau / terms
        for q in range(entries.size):
            entries[q] = series[terms, q]
        for term in range(terms - 1, -1, -1):
            for q in range(entries.size):
                entries[q] = entries[q] * tau + series[term, q]
        for i in range(n):
            for j in range(width):
                result[c, i, j] = entries[i * width + j]
        for _ in range(squarings):
            _square(result[c], tau)
            tau *= 2.0
        for i in range(n):
            for j in range(width):
                result[c, i, j] *= unscaled[i, j]
    return result


@njit(cache=True, nogil=True)
def _blocks(matrix: FloatArray, n: int) -> FloatArray:
    """Return the blocks E, S, G, H of a matrix over (s, x, w, v), side by side."""
    blocks = np.empty((n, 2 * n + 4))
    for i in range(n):  # entry by entry: an assigned slice is compiled with the text of its error, for seconds
        for j in range(2 * n + 2):
            blocks[i, j] = matrix[i, j]
        for j in range(2):
            blocks[i, 2 * n + 2 + j] = matrix[n + i, 2 * n + j]
    return blocks


@njit(cache=True, nogil=True)
def _square(blocks: FloatArray, tau: float) -> None:
    """Replace the transition over tau by that over 2 tau: E^2, E S + S E, E G + S H + G J, E H + H J."""
    n = blocks.shape[0]
    old = blocks.copy()
    for i in range(n):
        for j in range(n):
            E = 0.0
            S = 0.0
            for k in range(n):
                E += old[i, k] * old[k, j]
                S += old[i, k] * old[k, n + j] + old[i, n + k] * old[k, j]
            blocks[i, j] = E
            blocks[i, n + j] = S
        for j in range(2):  # J = [[1, tau], [0, 1]]: w grows by v tau
            G = old[i, 2 * n + j] + j * tau * old[i, 2 * n]
            H = old[i, 2 * n + 2 + j] + j * tau * old[i, 2 * n + 2]
            for k in range(n):
                G += old[i, k] * old[k, 2 * n + j] + old[i, n + k] * old[k, 2 * n + 2 + j]
                H += old[i, k] * old[k, 2 * n + 2 + j]
            blocks[i, 2 * n + j] = G
            blocks[i, 2 * n + 2 + j] = H


@njit(cache=True, nogil=True)
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
