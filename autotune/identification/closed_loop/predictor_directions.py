"""Coordinates for prediction-error steps: every direction that changes the predictor, none that only renames states.

A state-space model of order n has n^2 directions (similarity) along which its input-output behaviour does not change.
The parameters move in a complement of these, computed at the point (local coordinates, after McKelvey, Helmersson and
Ribarits 2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from autotune.arrays import FloatArray, IntArray
from autotune.identification.closed_loop.state_space import InnovationModel


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictor:
    """One-step predictor with constants: x(t+1) = F (x, u, y, 1), y = H (x, u, 1) + e, x(0) = x0.

    Stable wherever the noise model is, the plant unstable or not.

    Attributes
    ----------
    F : (n, n + n_u + n_y + 1) array
        [A - K C, B - K D, K, d - K y_0].
    H : (n_y, n + n_u + 1) array
        [C D y_0].
    x0 : (n,) array
        Initial state, free: it stands for the n residuals before the first row.
    """

    F: FloatArray
    H: FloatArray
    x0: FloatArray

    @classmethod
    def of(cls, model: InnovationModel, offset_x: FloatArray, offset_y: FloatArray, x0: FloatArray) -> Predictor:
        """Return the predictor of a model with constants in its two equations.

        Parameters
        ----------
        model : InnovationModel
            Order n, n_u inputs, n_y outputs.
        offset_x, offset_y : (n,), (n_y,) arrays
            Constants d and y_0 of its two equations.
        x0 : (n,) array
            Initial state.
        """
        entries = np.hstack([model.A, model.B, model.K, offset_x[:, None]])
        n, n_y = model.order, len(model.C)
        H = np.hstack([model.C, model.D, offset_y[:, None]])
        F = entries.copy()
        F[:, : entries.shape[1] - n_y - 1] -= model.K @ H[:, :-1]
        F[:, -1] -= model.K @ offset_y
        return cls(F=F, H=H, x0=np.asarray(x0, dtype=np.float64).reshape(n))

    @property
    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A - K C, B - K D, K, C, D."""
        n, n_u, n_y = self.sizes
        F, H = self.F, self.H
        return F[:, :n], F[:, n : n + n_u], F[:, n + n_u : n + n_u + n_y], H[:, :n], H[:, n : n + n_u]

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Return n, n_u, n_y."""
        n, n_y = self.F.shape[0], self.H.shape[0]
        return n, self.H.shape[1] - n - 1, n_y

    def move_along(self, step: FloatArray, directions: FloatArray) -> Predictor:
        """Return the predictor after a step.

        Parameters
        ----------
        step : (P,) array
            Along the directions.
        directions : (entries, P) array
            In the order of :meth:`packed`.
        """
        moved = self.packed() + directions @ step
        at = np.cumsum([self.F.size, self.H.size])
        F, H, x0 = np.split(moved, at)
        return Predictor(F=F.reshape(self.F.shape), H=H.reshape(self.H.shape), x0=x0)

    def packed(self) -> FloatArray:
        """Return all entries in one vector: F row by row, H row by row, x0."""
        return np.concatenate([self.F.ravel(), self.H.ravel(), self.x0])


def _free_entries(predictor: Predictor) -> IntArray:
    """Return which entries of :meth:`Predictor.packed`, D and constants left out, are estimated, as indices."""
    n, n_u, _ = predictor.sizes
    F, H = np.ones(predictor.F.shape, dtype=bool), np.ones(predictor.H.shape, dtype=bool)
    F[:, -1] = H[:, -1] = False
    H[:, n : n + n_u] = False
    return np.asarray(np.flatnonzero(np.concatenate([F.ravel(), H.ravel(), np.ones(n, dtype=bool)])), dtype=np.int64)


def renaming_directions(predictor: Predictor) -> FloatArray:
    """Return the directions that leave the input-output behaviour alone, shape (entries, n^2); no constants."""
    n, F, H, x0 = len(predictor.x0), predictor.F, predictor.H, predictor.x0
    dF, dH, dx0 = np.zeros((*F.shape, n * n)), np.zeros((*H.shape, n * n)), np.zeros((n, n * n))
    k = np.arange(n)
    for i in range(n):  # E = e_i e_k' for every k: E F - [(A - K C) E, 0], - C E, E x0
        column = i * n + k
        dF[i][:, column] += F.T
        dF[:, k, column] -= F[:, i, None]
        dH[:, k, column] -= H[:, i, None]
        dx0[i, column] += x0
    return np.concatenate([dF.reshape(-1, n * n), dH.reshape(-1, n * n), dx0])


def behaviour_directions(predictor: Predictor, *, offset: bool) -> FloatArray:
    """Return a basis of the directions that change the behaviour, D as it is.

    Parameters
    ----------
    predictor : Predictor
        Where they hold.
    offset : bool
        Whether y_0 is free.

    Returns
    -------
    (entries, P) array
        P = n (n_u + 2 n_y) + n + n_y (offset): the number of free parameters with the initial state counted. The
        constants' columns are the last.

    Notes
    -----
    With one output, output injection g C reaches every change of A - K C that matters, so that C can stay and the
    columns are unit vectors but for g; they hold until the coordinates change. With several outputs whose
    observability indices differ it does not, and an orthonormal complement of the renaming directions is computed.
    """
    n, _, n_y = predictor.sizes
    entries = predictor.packed().size
    if n_y == 1:
        behaviour = _injection_directions(predictor, entries)
    else:
        free = _free_entries(predictor)
        renaming = renaming_directions(predictor)[free]
        behaviour = np.zeros((entries, len(free) - n * n))
        behaviour[free] = qr(renaming, check_finite=False)[0][:, n * n :]
    return np.hstack([behaviour, constant_directions(predictor)]) if offset else behaviour


def regressors(predictor: Predictor) -> FloatArray:
    """Return Phi (m, n + n_u + n_y + 1) such that every direction changes F by some G Phi.

    With one output and injection directions these are the prediction, u, y and 1; else all of x, u, y and 1.
    """
    n, _, n_y = predictor.sizes
    everything = np.eye(predictor.F.shape[1])
    if n_y > 1:
        return everything
    prediction = np.zeros((1, len(everything)))
    prediction[0, :n] = predictor.H[0, :n]
    return np.vstack([prediction, everything[n:]])


def constant_directions(predictor: Predictor) -> FloatArray:
    """Return the directions of the constants, shape (entries, n_y).

    Where there are states enough they are loads on the states, along which the prediction shifts most: the drift that a
    load means does not change as a mode of plant or predictor comes near one, whereas y_0 for the same drift runs away.
    """
    n, n_u, n_y = predictor.sizes
    at = predictor.F.size + (n + n_u + 1) * np.arange(1, n_y + 1) - 1  # y_0
    loads = np.eye(n_y)
    if n >= n_y:
        at = (n + n_u + n_y + 1) * np.arange(1, n + 1) - 1  # d
        loads = np.linalg.qr(np.linalg.solve(np.eye(n) - predictor.F[:, :n].T, predictor.H[:, :n].T))[0]
    directions = np.zeros((predictor.packed().size, n_y))
    directions[at] = loads
    return directions


def _injection_directions(predictor: Predictor, entries: int) -> FloatArray:
    n, n_u, _ = predictor.sizes
    m, C = predictor.F.shape[1], predictor.H[0, :n]
    states = np.arange(n)
    unit = [states * m + n + q for q in range(n_u + 1)]  # B and K
    rows = np.concatenate([*unit, np.arange(entries - n, entries)])
    directions = np.zeros((entries, n + len(rows)))
    for i in range(n):
        directions[i * m : i * m + n, i] = C
    directions[rows, n + np.arange(len(rows))] = 1.0
    return directions
