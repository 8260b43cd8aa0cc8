"""What moving numbers or start states can explain of a residual: orthonormal columns that span their derivatives."""

from __future__ import annotations

import numpy as np

from autotune.arrays import FloatArray

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
