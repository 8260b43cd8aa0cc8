"""The other closed-loop subspace methods of the paper's figures 3 and 4, small, for comparison.

Van Overschee and De Moor 1997 (indirect, needs the controller's Markov parameters), Oku and Tanaka 2006 and Katayama's
orthogonal decomposition 2005/2007 (need r only). PBSIDopt and SSARX are in ``subspace_direct``. All work on the
triangular factor of the lagged data; A and C come from the shift of the observability matrix. None is efficient.
"""

from __future__ import annotations

import numpy as np

from autotune.arrays import FloatArray
from autotune.identification.closed_loop.lagged import lagged_factor, least_squares, triangle
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.identification.closed_loop.subspace_indirect import (
    input_matrices,
    markov_from_null_space,
    toeplitz_blocks,
)


def van_overschee_de_moor(
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    order: int,
    *,
    controller_markov: FloatArray,
    f: int,
    p: int | None = None,
) -> InnovationModel:
    """Identify by the indirect N4SID of Van Overschee and De Moor 1997.

    N_f = U_f + H_f^c Y_f = R_f + Gamma_c X_c holds no present or future noise, so the oblique projection of Y_f along
    N_f on the past u and y gives T_f Gamma_f, and its null space T_f H_f.

    Parameters
    ----------
    r, u, y : (N, n_u), (N, n_u), (N, n_y) arrays
        Zero-mean data of u = r - C y; r is not used beyond that.
    order : int
        Order of the plant.
    controller_markov : (>= f, n_u, n_y) array
        Markov parameters of C(q).
    f, p : int
        Future and past window.

    Returns
    -------
    InnovationModel
        Deterministic part; K = 0.
    """
    p = f if p is None else p
    n_u, n_y = u.shape[1], y.shape[1]
    past = range(-p, 0)
    R, _ = lagged_factor([(u, past), (y, past), (u, range(f)), (y, range(f))])
    width = p * (n_u + n_y)
    H_c = toeplitz_blocks(controller_markov, f)
    U_f, Y_f = R[:, width : width + f * n_u], R[:, width + f * n_u :]
    N_f = U_f + Y_f @ H_c.T
    M = triangle(np.hstack([N_f, R[:, :width], Y_f])).T
    a, b = f * n_u, f * n_u + width
    U, s, _ = np.linalg.svd(M[b:, a:b], full_matrices=True)
    free = U[:, order:].T  # annihilates T_f Gamma_f
    impulse = markov_from_null_space(free, free @ M[b:, :a], M[:a, :a], n_u=n_u, n_y=n_y)
    T_f = np.eye(f * n_y) - toeplitz_blocks(impulse, f) @ H_c
    gamma = np.linalg.solve(T_f, U[:, :order] * np.sqrt(s[:order]))
    right = free @ M[b:, :a]
    return _model(gamma, free @ T_f, right, M[:a, :a], n_u=n_u, n_y=n_y)


def oku_tanaka(
    r: FloatArray, u: FloatArray, y: FloatArray, order: int, *, f: int, p: int | None = None
) -> InnovationModel:
    """Identify by the closed-loop MOESP of Oku and Tanaka 2006: the future u and y projected on past and future r.

    Parameters
    ----------
    r, u, y : (N, n_u), (N, n_u), (N, n_y) arrays
        Zero-mean data; the controller need not be known.
    order : int
        Order of the plant.
    f, p : int
        Future and past window.

    Returns
    -------
    InnovationModel
        Deterministic part; K = 0.

    Notes
    -----
    Written from its description by Pouliquen et al.; the original (in Japanese) was not compared line by line.
    """
    p = f if p is None else p
    n_u, n_y = u.shape[1], y.shape[1]
    R, _ = lagged_factor([(r, range(-p, f)), (u, range(f)), (y, range(f))])
    width = (p + f) * r.shape[1]
    explained = R[:width, width:]  # the parts of U_f and Y_f along r
    M = triangle(explained).T
    return _moesp(M[: f * n_u, : f * n_u], M[f * n_u :], order, n_u=n_u, n_y=n_y)


def orthogonal_decomposition(
    r: FloatArray, u: FloatArray, y: FloatArray, order: int, *, f: int, p: int | None = None
) -> InnovationModel:
    """Identify by Katayama's ORT (2005, 2007): the joint process (u, y) freed of noise by r, then PO-MOESP.

    Parameters
    ----------
    r, u, y : (N, n_u), (N, n_u), (N, n_y) arrays
        Zero-mean data; the controller need not be known.
    order : int
        Order of the plant.
    f, p : int
        Future and past window.

    Returns
    -------
    InnovationModel
        Deterministic part; K = 0.

    Notes
    -----
    With as many past lags as future ones the projections span the same rows as Oku and Tanaka's, and the observability
    matrix is theirs: the paper's figures 3 and 4 show it, too. Weighting as PI-MOESP or N4SID does moves the scatter of
    the example's first pole from 0.040 to 0.054 at most.
    """
    p = f if p is None else p
    n_u, n_y = u.shape[1], y.shape[1]
    past = range(-p, 0)
    R, _ = lagged_factor([(r, range(-p, f)), (u, range(f)), (u, past), (y, past), (y, range(f))])
    width = (p + f) * r.shape[1]
    M = triangle(R[:width, width:]).T
    a, b = f * n_u, f * n_u + p * (n_u + n_y)
    return _moesp(M[:a, :a], np.hstack([M[b:, :a], M[b:, a:b]]), order, n_u=n_u, n_y=n_y)


def _moesp(L11: FloatArray, L2: FloatArray, order: int, *, n_u: int, n_y: int) -> InnovationModel:
    """Return the model from Y_f = [L21 L22] N with U_f = L11 N1: Gamma from L22, B and D from L21."""
    a = len(L11)
    U, _, _ = np.linalg.svd(L2[:, a:], full_matrices=True)
    free = U[:, order:].T
    return _model(U[:, :order], free, free @ L2[:, :a], L11, n_u=n_u, n_y=n_y)


def _model(
    gamma: FloatArray, free: FloatArray, right: FloatArray, M11: FloatArray, *, n_u: int, n_y: int
) -> InnovationModel:
    A = least_squares(gamma[:-n_y], gamma[n_y:])
    B, D = input_matrices(free, right, M11, gamma, n_u=n_u, n_y=n_y)
    n = gamma.shape[1]
    return InnovationModel(
        A=A, B=B, C=gamma[:n_y], D=D, K=np.zeros((n, n_y)), innovation_covariance=np.zeros((n_y, n_y))
    )
