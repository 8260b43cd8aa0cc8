"""The one pass over the data: innovations of a predictor and their derivatives, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

from autotune.arrays import FloatArray

#: Rows of derivatives that are projected at once, a block that stays in cache.
_BLOCK = 256


@njit(cache=True)
def innovations(F: FloatArray, H: FloatArray, x0: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
    """Return e(t) = y - H (x, u, 1) along x(t+1) = F (x, u, y, 1).

    Parameters
    ----------
    F : (n, n + n_u + n_y + 1) array
        Of the state equation.
    H : (n_y, n + n_u + 1) array
        Of the output equation.
    x0 : (n,) array
        Initial state.
    u, y : (N, n_u), (N, n_y) arrays
        The record.

    Returns
    -------
    (N, n_y) array
        e [output unit].
    """
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
                value += F[i, n + n_u + o] * y[t, o]
            following[i] = value
        x, following = following, x
    return e


@njit(cache=True)
def _put_negative(values: FloatArray, row: FloatArray) -> None:
    for i in range(
        values.size
    ):  # entry by entry: an assigned slice is compiled with the text of its error, for seconds
        row[i] = -values[i]


@njit(cache=True, fastmath={"contract", "nsz"})  # fused multiply-add only: NaN and order of sums are kept
def normal_equations(
    F: FloatArray,
    H: FloatArray,
    x0: FloatArray,
    u: FloatArray,
    y: FloatArray,
    regressors: FloatArray,
    directions: FloatArray,
    whitening: FloatArray,
) -> FloatArray:
    """Return J^T J of the whitened [derivatives of e, e], accumulated over the rows.

    Parameters
    ----------
    F, H, x0 : arrays
        The predictor, as in :class:`autotune.identification.closed_loop.predictor_directions.Predictor`.
    u, y : (N, n_u), (N, n_y) arrays
        Data.
    regressors : (m, n + n_u + n_y + 1) array
        Phi: F changes by G Phi only.
    directions : (n m + entries of H + n, P) array
        Of G row by row, H row by row and x0.
    whitening : (n_y, n_y) array
        W with W cov(e) W^T = I.

    Returns
    -------
    (P + 1, P + 1) array
        Information matrix, gradient in the last column, sum of squares in the last entry.

    Notes
    -----
    A change of G[i, q] acts on output o through w_i(t) with w(t+1) = A^T w(t) + C_o^T phi_q(t) (adjoint of the
    predictor), phi = Phi (x, u, y, 1), so one bank of n states per output and regressor serves the n entries of a
    column of G; with phi = 0 and w(0) = C_o^T the same recursion gives the derivatives by x0.
    """
    n, n_u, n_y, P = F.shape[0], u.shape[1], y.shape[1], directions.shape[1]
    m, h, inputs = regressors.shape[0], n + n_u + 1, n + n_u + n_y + 1
    width = n * (m + 1) + n_y * h + 1
    projection = np.zeros((width, P + 1))
    for i in range(n):
        for q in range(m):
            _put_negative(directions[i * m + q], projection[i * (m + 1) + q])
        _put_negative(directions[n * m + n_y * h + i], projection[i * (m + 1) + m])
    for r in range(n_y * h):
        _put_negative(directions[n * m + r], projection[n * (m + 1) + r])
    projection[width - 1, P] = 1.0
    C = np.ascontiguousarray(whitening @ np.ascontiguousarray(H[:, :n]))
    x, following, e = x0.copy(), np.empty(n), np.empty(n_y)
    phi, z = np.zeros(m + 1), np.ones(inputs)
    bank = np.zeros((n_y, n, m + 1))
    for o in range(n_y):
        for i in range(n):
            bank[o, i, m] = C[o, i]
    moved = np.empty((n, m + 1))
    rows = np.zeros((_BLOCK * n_y, width))
    total = np.zeros((P + 1, P + 1))
    filled = 0
    for t in range(y.shape[0]):
        for i in range(n):
            z[i] = x[i]
        for q in range(n_u):
            z[n + q] = u[t, q]
        for o in range(n_y):
            z[n + n_u + o] = y[t, o]
            value = y[t, o] - H[o, n + n_u]
            for i in range(n + n_u):
                value -= H[o, i] * z[i]
            e[o] = value
        for q in range(m):
            value = 0.0
            for k in range(inputs):
                value += regressors[q, k] * z[k]
            phi[q] = value
        for o in range(n_y):
            value = 0.0
            at = n * (m + 1)
            for k in range(n_y):
                w = whitening[o, k]
                value += w * e[k]
                for i in range(n + n_u):
                    rows[filled, at + i] = w * z[i]
                rows[filled, at + n + n_u] = w
                at += h
            rows[filled, width - 1] = value
            for i in range(n):
                at = i * (m + 1)
                for q in range(m + 1):
                    rows[filled, at + q] = bank[o, i, q]
                    moved[i, q] = C[o, i] * phi[q]
                for k in range(n):
                    a = F[k, i]
                    for q in range(m + 1):
                        moved[i, q] += a * bank[o, k, q]
            for i in range(n):
                for q in range(m + 1):
                    bank[o, i, q] = moved[i, q]
            filled += 1
        for i in range(n):
            value = 0.0
            for k in range(inputs):
                value += F[i, k] * z[k]
            following[i] = value
        x, following = following, x
        if filled == rows.shape[0]:
            part = np.dot(rows, projection)
            total += np.dot(part.T, part)
            filled = 0
    part = np.dot(rows[:filled], projection)
    total += np.dot(part.T, part)
    return total
