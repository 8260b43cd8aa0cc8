"""Coefficients of a delayed equation for many delays at once, by instrumental variables on modulated signals."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from autotune.arrays import BoolArray, FloatArray


def solve_shapes(
    Y: FloatArray,
    U: FloatArray,
    starts: NDArray[np.int64],
    shifts: NDArray[np.int64],
    past_unknown: bool,
    integrator: bool,
    offset: bool,
    area: float,
) -> tuple[FloatArray, BoolArray]:
    """Return a for every shift: unknowns a_0.., b, d; instruments the modulated input's derivatives and 1.

    Parameters
    ----------
    Y : (windows, n+1) array
        Modulated derivatives of y.
    U : (positions, n+1) array
        Those of u, at every position.
    starts : (windows,) array of int
        Position of each window of y.
    shifts : (S,) array of int
        Delays to try, in positions.
    past_unknown : bool
        Whether windows whose delayed input lies before the record are left out; else the first one's stands for it.
    integrator : bool
        Whether a_0 is 0.
    offset : bool
        Whether d is unknown; else 0.
    area : float
        Integral of the window, what multiplies d.

    Returns
    -------
    a : (S, n) array
        Coefficients a_0..a_{n-1} [1/s^(n-i)].
    valid : (S,) array of bool
        False where too few windows remain or the unknowns are not told apart.

    References
    ----------
    T. Soderstrom and P. Stoica, Instrumental Variable Methods for System Identification, 1983.
    """
    n = Y.shape[1] - 1
    lowest = 1 if integrator else 0
    scale_y = np.sqrt(np.sum(Y * Y, axis=0)) + 1e-300
    scale_u = np.sqrt(np.sum(U * U, axis=0)) + 1e-300
    M, g, rows = _moments(Y, U, starts, shifts, past_unknown, lowest, offset, area, scale_y, scale_u)
    a = np.zeros((shifts.size, n))
    valid = (rows >= 2 * n + 4) & np.all(np.isfinite(M), axis=(1, 2))
    valid[valid] = np.linalg.cond(M[valid]) <= 1e12
    solution = np.linalg.solve(M[valid], g[valid][..., np.newaxis])[..., 0]
    a[valid, lowest:] = solution[:, : n - lowest] / scale_y[lowest:n]
    return a, valid & np.all(np.isfinite(a), axis=1)


@njit(cache=True)
def _moments(
    Y: FloatArray,
    U: FloatArray,
    starts: NDArray[np.int64],
    shifts: NDArray[np.int64],
    past_unknown: bool,
    lowest: int,
    offset: bool,
    area: float,
    scale_y: FloatArray,
    scale_u: FloatArray,
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Return the instruments' products with the regressors and with y^(n) for every shift, and the rows in each."""
    n = Y.shape[1] - 1
    p = n - lowest + 1 + (1 if offset else 0)
    M, g = np.zeros((shifts.size, p, p)), np.zeros((shifts.size, p))
    rows = np.zeros(shifts.size, dtype=np.int64)
    for q in range(shifts.size):
        z = np.full(p, area)
        r = np.full(p, area)
        for k in range(starts.size):
            at = starts[k] - shifts[q]
            if past_unknown and at < 0:
                continue
            at = max(at, 0)
            rows[q] += 1
            for i in range(n - lowest):
                r[i] = (-1.0) ** (i + lowest) * Y[k, i + lowest] / scale_y[i + lowest]
                z[i] = U[at, i + 1] / scale_u[i + 1]
            r[n - lowest] = U[at, 0] / scale_u[0]
            z[n - lowest] = U[at, 0] / scale_u[0]
            for i in range(p):
                g[q, i] += z[i] * (-1.0) ** n * Y[k, n]
                for j in range(p):
                    M[q, i, j] += z[i] * r[j]
    return M, g, rows


def stabilise(a: FloatArray, duration_s: float) -> FloatArray:
    """Mirror poles that would grow by more than a factor e over the record into the left half plane.

    Parameters
    ----------
    a : (n,) array
        Coefficients a_0..a_{n-1} [1/s^(n-i)].
    duration_s : float
        Length of the record [s].

    Returns
    -------
    (n,) array
        Coefficients with the poles mirrored.
    """
    if a.size <= 2 and np.all(a <= 0.0):
        return a
    poles = np.roots([1.0, *-a[::-1]])
    mirrored = np.where(poles.real > 1.0 / duration_s, -np.conj(poles), poles)
    return np.asarray(-np.real(np.poly(mirrored))[:0:-1], dtype=np.float64)
