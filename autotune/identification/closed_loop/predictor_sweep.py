"""The one pass over the data: innovations of a predictor and their derivatives, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

from autotune.arrays import FloatArray

_BLOCK = 512


@njit(cache=True)
def innovations(F: FloatArray, H: FloatArray, x0: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
    """Return e(t) = y - H (x, u, 1) along x(t+1) = F (x, u, e, 1), shape (N, n_y)."""
    n, n_u, n_y = F.shape[0], u.shape[1], y.shape[1]
    x, following = x0.copy(), np.empty(n)
    e = np.empty((y.shape[0], n_y))
    for t in range(y.shape[0]):
        for o in range(n_y):
            value = y[t, o] - H[o, n + n_u]
            for i in range(n):
                value -= H[o, i] * x[i]
            for q in range(n_u):
                value -= H[o, n + q] * u[t, q]
            e[t, o] = value
        for i in range(n):
            value = F[i, n + n_u + n_y]
            for k in range(n):
                value += F[i, k] * x[k]
            for q in range(n_u):
                value += F[i, n + q] * u[t, q]
            for o in range(n_y):
                value += F[i, n + n_u + o] * e[t, o]
            following[i] = value
        x[:] = following
    return e


@njit(cache=True)
def scatter(F: FloatArray, H: FloatArray, x0: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
    """Return the sum of e e^T, shape (n_y, n_y), without storing the innovations."""
    n_y = y.shape[1]
    total = np.zeros((n_y, n_y))
    x = x0.copy()
    n, n_u = F.shape[0], u.shape[1]
    following, e = np.empty(n), np.empty(n_y)
    for t in range(y.shape[0]):
        for o in range(n_y):
            value = y[t, o] - H[o, n + n_u]
            for i in range(n):
                value -= H[o, i] * x[i]
            for q in range(n_u):
                value -= H[o, n + q] * u[t, q]
            e[o] = value
        for i in range(n):
            value = F[i, n + n_u + n_y]
            for k in range(n):
                value += F[i, k] * x[k]
            for q in range(n_u):
                value += F[i, n + q] * u[t, q]
            for o in range(n_y):
                value += F[i, n + n_u + o] * e[o]
            following[i] = value
        x[:] = following
        for o in range(n_y):
            for k in range(n_y):
                total[o, k] += e[o] * e[k]
    return total


@njit(cache=True, fastmath={"contract", "nsz"})  # fused multiply-add only: NaN and order of sums are kept
def normal_equations(
    F: FloatArray,
    H: FloatArray,
    x0: FloatArray,
    u: FloatArray,
    y: FloatArray,
    dF: FloatArray,
    dH: FloatArray,
    dx0: FloatArray,
    whitening: FloatArray,
) -> FloatArray:
    """Return J^T J of the whitened [derivatives of e, e], accumulated over the rows.

    Parameters
    ----------
    F, H, x0 : arrays
        The predictor, as in :class:`autotune.identification.closed_loop.predictor_directions.Predictor`.
    u, y : (N, n_u), (N, n_y) arrays
        Data.
    dF, dH, dx0 : (n, ..., P), (n_y, ..., P), (n, P) arrays
        Directions.
    whitening : (n_y, n_y) array
        W with W cov(e) W^T = I.

    Returns
    -------
    (P + 1, P + 1) array
        Information matrix, gradient in the last column, sum of squares in the last entry.
    """
    n, n_u, n_y, P = F.shape[0], u.shape[1], y.shape[1], dx0.shape[1]
    x, following = x0.copy(), np.empty(n)
    S, S_next = dx0.copy(), np.empty((n, P))
    phi, dE, e = np.empty(n + n_u + n_y + 1), np.empty((n_y, P)), np.empty(n_y)
    phi[n + n_u + n_y] = 1.0
    rows = np.zeros((_BLOCK * n_y, P + 1))
    total = np.zeros((P + 1, P + 1))
    filled = 0
    for t in range(y.shape[0]):
        for i in range(n):
            phi[i] = x[i]
        for q in range(n_u):
            phi[n + q] = u[t, q]
        for o in range(n_y):
            value = y[t, o] - H[o, n + n_u]
            for j in range(P):
                dE[o, j] = -dH[o, n + n_u, j]
            for i in range(n + n_u):
                value -= H[o, i] * phi[i]
                for j in range(P):
                    dE[o, j] -= phi[i] * dH[o, i, j]
            for i in range(n):
                for j in range(P):
                    dE[o, j] -= H[o, i] * S[i, j]
            e[o] = value
            phi[n + n_u + o] = value
        for i in range(n):
            value = 0.0
            for j in range(P):
                S_next[i, j] = 0.0
            for q in range(n + n_u + n_y + 1):
                value += F[i, q] * phi[q]
                for j in range(P):
                    S_next[i, j] += phi[q] * dF[i, q, j]
            for k in range(n):
                for j in range(P):
                    S_next[i, j] += F[i, k] * S[k, j]
            for o in range(n_y):
                for j in range(P):
                    S_next[i, j] += F[i, n + n_u + o] * dE[o, j]
            following[i] = value
        x[:] = following
        S[:, :] = S_next
        for o in range(n_y):
            rows[filled, :] = 0.0
            for k in range(n_y):
                w = whitening[o, k]
                for j in range(P):
                    rows[filled, j] += w * dE[k, j]
                rows[filled, P] += w * e[k]
            filled += 1
        if filled == rows.shape[0]:
            total += np.dot(rows.T, rows)
            filled = 0
    total += np.dot(rows[:filled].T, rows[:filled])
    return total
