"""What moving numbers or start states can explain of a residual: orthonormal columns that span their derivatives."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from autotune.arrays import FloatArray, IntArray

#: Norm of a derivative that is none, and share of the largest eigenvalue up to which a direction is not determined.
NOT_FELT, UNTOLD = 1e-9, 1e-8


def state_bases(Jx: FloatArray, first: IntArray, last: IntArray) -> tuple[FloatArray, ...]:
    """Return orthonormal columns that span the well-determined part of Jx's columns within each window's rows."""
    together, counts = _bases(Jx, first, last)
    return tuple(together[a:b, :m] for a, b, m in zip(first, last, counts, strict=True))


@njit(cache=True, nogil=True)
def _bases(Jx: FloatArray, first: IntArray, last: IntArray) -> tuple[FloatArray, IntArray]:
    """Return the same as :func:`basis` without a prior for every window, and how many columns each has."""
    n = Jx.shape[1]
    found, counts = np.zeros(Jx.shape), np.zeros(first.size, dtype=np.int64)
    norms = np.empty(n)
    for w in range(first.size):
        X = Jx[first[w] : last[w]]
        for i in range(n):
            norms[i] = math.sqrt(np.sum(X[:, i] ** 2))
        felt = np.flatnonzero(norms > NOT_FELT)
        if felt.size == 0:
            continue
        scaled = np.empty((X.shape[0], felt.size))
        for i in range(felt.size):
            scaled[:, i] = X[:, felt[i]] / norms[felt[i]]
        values, vectors = np.linalg.eigh(scaled.T @ scaled)
        for i in range(felt.size):
            if values[i] > UNTOLD * values[-1]:
                found[first[w] : last[w], counts[w]] = (
                    scaled @ np.ascontiguousarray(vectors[:, i]) / math.sqrt(values[i])
                )
                counts[w] += 1
    return found, counts


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
