"""What moving numbers or start states can explain of a residual: orthonormal columns that span their derivatives."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from autotune.arrays import FloatArray, IntArray

#: Norm of a derivative that is none, and share of the largest eigenvalue up to which a direction is not determined.
NOT_FELT, UNTOLD = 1e-9, 1e-8


def basis(J: FloatArray, prior: FloatArray | None = None) -> FloatArray:
    """Return columns that span the well-determined part of J's columns: orthonormal with the rows of the prior."""
    norms = np.linalg.norm(J, axis=0)
    felt = norms > NOT_FELT
    scaled = J[:, felt] / norms[felt]
    if scaled.shape[1] == 0:
        return np.zeros((J.shape[0], 0))
    H = scaled.T @ scaled
    if prior is not None:
        H += np.diag((prior[felt] / norms[felt]) ** 2)
    values, vectors = np.linalg.eigh(H)
    keep = values > UNTOLD * values[-1]
    return np.asarray(scaled @ (vectors[:, keep] / np.sqrt(values[keep])))


@njit(cache=True, nogil=True)
def determined(Jx: FloatArray, windows: IntArray) -> int:
    """Return how many columns :func:`basis` has of every window's rows, all windows (W, 2) together."""
    count = 0
    norms = np.empty(Jx.shape[1])
    for first, last in windows:
        X = Jx[first:last]
        for i in range(norms.size):
            norms[i] = math.sqrt(np.sum(X[:, i] ** 2))
        felt = np.flatnonzero(norms > NOT_FELT)
        if felt.size == 0:
            continue
        scaled = np.empty((X.shape[0], felt.size))
        for i in range(felt.size):
            scaled[:, i] = X[:, felt[i]] / norms[felt[i]]
        values = np.linalg.eigvalsh(scaled.T @ scaled)
        count += int(np.sum(values > UNTOLD * values[-1]))
    return count
