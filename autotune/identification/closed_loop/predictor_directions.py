"""Coordinates for prediction-error steps: every direction that changes the predictor, none that only renames states.

A state-space model of order n has n^2 + n directions (similarity and, with a constant in the state equation, a shift of
the state) along which its input-output behaviour does not change. The parameters move in the orthogonal complement of
these, computed afresh at each point (data-driven local coordinates, McKelvey, Helmersson and Ribarits 2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from autotune.arrays import FloatArray, IntArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictor:
    """Innovation form with constants: x(t+1) = F (x, u, e, 1), y = H (x, u, 1) + e, x(0) = x0.

    Attributes
    ----------
    F : (n, n + n_u + n_y + 1) array
        [A B K d].
    H : (n_y, n + n_u + 1) array
        [C D y_0].
    x0 : (n,) array
        Initial state, free: it stands for the n residuals before the first row.
    """

    F: FloatArray
    H: FloatArray
    x0: FloatArray

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Return n, n_u, n_y."""
        n, n_y = self.F.shape[0], self.H.shape[0]
        return n, self.H.shape[1] - n - 1, n_y

    def moved(self, step: FloatArray, directions: FloatArray) -> Predictor:
        """Return the predictor after a step (P,) along the directions (entries, P)."""
        moved = self.packed() + directions @ step
        at = np.cumsum([self.F.size, self.H.size])
        F, H, x0 = np.split(moved, at)
        return Predictor(F=F.reshape(self.F.shape), H=H.reshape(self.H.shape), x0=x0)

    def packed(self) -> FloatArray:
        """Return all entries in one vector: F row by row, H row by row, x0."""
        return np.concatenate([self.F.ravel(), self.H.ravel(), self.x0])


def free_entries(predictor: Predictor, *, feedthrough: bool, offset: bool) -> IntArray:
    """Return which entries of :meth:`Predictor.packed` are estimated, as indices."""
    n, n_u, _ = predictor.sizes
    F, H = np.ones(predictor.F.shape, dtype=bool), np.ones(predictor.H.shape, dtype=bool)
    F[:, -1] = H[:, -1] = offset
    H[:, n : n + n_u] = feedthrough
    return np.asarray(np.flatnonzero(np.concatenate([F.ravel(), H.ravel(), np.ones(n, dtype=bool)])), dtype=np.int64)


def renaming_directions(predictor: Predictor, *, offset: bool) -> FloatArray:
    """Return the directions that leave the input-output behaviour alone, shape (entries, n^2 + n or n^2)."""
    n, F, H, x0 = len(predictor.x0), predictor.F, predictor.H, predictor.x0
    count = n * n + (n if offset else 0)
    dF, dH, dx0 = np.zeros((*F.shape, count)), np.zeros((*H.shape, count)), np.zeros((n, count))
    k = np.arange(n)
    for i in range(n):  # E = e_i e_k' for every k: E [A B K d] - [A E], - C E, E x0
        column = i * n + k
        dF[i][:, column] += F.T
        dF[:, k, column] -= F[:, i, None]
        dH[:, k, column] -= H[:, i, None]
        dx0[i, column] += x0
    if offset:  # x -> x + e_i
        dF[:, -1, n * n :] = np.eye(n) - F[:, :n]
        dH[:, -1, n * n :] = -H[:, :n]
        dx0[:, n * n :] = np.eye(n)
    return np.concatenate([dF.reshape(-1, count), dH.reshape(-1, count), dx0])


def behaviour_directions(predictor: Predictor, *, feedthrough: bool, offset: bool) -> FloatArray:
    """Return an orthonormal basis of the directions that change the behaviour, shape (entries, P).

    Returns
    -------
    (entries, P) array
        P = n (n_u + 2 n_y) + n_y (offset) + n_y n_u (feedthrough) + ... : the number of free parameters with the
        initial state counted.
    """
    free = free_entries(predictor, feedthrough=feedthrough, offset=offset)
    renaming = renaming_directions(predictor, offset=offset)[free]
    basis = qr(renaming, check_finite=False)[0][:, renaming.shape[1] :]
    directions = np.zeros((predictor.packed().size, basis.shape[1]))
    directions[free] = basis
    return directions
