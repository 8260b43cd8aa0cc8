"""Indirect closed-loop subspace identification of Pouliquen, Gehan and Pigeon 2011, steps 1 to 6 and section III-C.

The loop u = r - C y is analysed from r to y first (its extended observability matrix Gamma_cl), then the plant's own
Gamma is freed from it with the controller's Markov parameters. Everything is done on the triangular factor of
[R_f; Psi; Y_f; U_f], so the data are read once, whatever their length; M_ij below are blocks of its transpose.

Its weak step is B and D (step 6): refit them with :func:`autotune.identification.closed_loop.refit.refit_inputs`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.linalg import solve_triangular

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.lagged import lagged_factor, least_squares, triangle
from autotune.identification.closed_loop.state_space import InnovationModel

Instrument: TypeAlias = Literal["r", "r and y", "u and y"]
#: Singular values below this share of the largest are rounding in noise-free data.
_RANK = 1e-9
#: The same of the controller's Hankel matrix: Markov parameters estimated from data are known to about 1e-8.
_CONTROLLER_RANK = 1e-7


def toeplitz_blocks(markov: FloatArray, f: int) -> FloatArray:
    """Return the lower triangular block Toeplitz matrix H_f of f Markov parameters.

    Parameters
    ----------
    markov : (f or more, rows, columns) array
        Markov parameters, the one of no lag first.
    f : int
        Future window, in samples.

    Returns
    -------
    (f rows, f columns) array
        H_f.
    """
    rows, columns = markov.shape[1:]
    H = np.zeros((f * rows, f * columns))
    for i in range(f):
        for k in range(i + 1):
            H[i * rows : (i + 1) * rows, k * columns : (k + 1) * columns] = markov[i - k]
    return H


def indirect_subspace(
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    order: int,
    *,
    controller_markov: FloatArray,
    f: int,
    p: int | None = None,
    loop_order: int | None = None,
    instrument: Instrument = "r and y",
) -> InnovationModel:
    """Identify the plant from r, u, y and the controller's Markov parameters.

    Parameters
    ----------
    r : (N, n_u) array
        External excitation, added to the controller's output: u = r - C y.
    u, y : (N, n_u), (N, n_y) arrays
        Command and measurement, zero mean.
    order : int
        Order n of the plant.
    controller_markov : (>= f, n_u, n_y) array
        First Markov parameters D_c, C_c B_c, C_c A_c B_c ... of C(q); zero for an open loop (Remark 5: PI-MOESP with
        ``instrument = "r"``, PO-MOESP with ``"r and y"``). From data: :func:`controller_markov_parameters`.
    f, p : int
        Future and past window, p = f when absent; both above the loop's order.
    loop_order : int, optional
        Order n_cl of the loop; when absent n + n_c with the controller's order n_c from its Markov parameters
        (:func:`controller_order`), or the number of singular values (8) above rounding where there is no noise. Fewer
        than the minimal order make the estimate inconsistent, more only cost precision.
    instrument : {"r", "r and y", "u and y"}
        Psi = R_p, or [R_p; Y_p]; ``"u and y"`` only for an open loop, where R_p = U_p.

    Returns
    -------
    InnovationModel
        A, B, C, D of step 6 and K, sigma^2 of section III-C.

    Raises
    ------
    IdentificationError
        Record too short, windows too short for the orders, too few Markov parameters to tell the controller's order, or
        r not persistently exciting of order f.

    Notes
    -----
    Consistent, if n_cl is not below the loop's minimal order; exact without noise. On the paper's example the root mean
    square error of the poles is .77, .69, 1.46 and .78 over the root of 25,000, 100,000, 400,000 and 1,600,000 rows;
    with n_cl = n it stays near .01. A mode of the loop that r hardly excites is seen late: the ninth singular value of
    that example lies below its noise up to some 1e8 samples, and a loop order of 7 gives about half of the error there.
    To leave out what is not yet seen is no remedy: over seven loops it costs up to two thirds more error in the
    response (2.37 to 3.30 and .19 to .32 of it with 2,000 rows) where it rarely gains a fifth.
    Far from efficient in B and D with noise: on the paper's own example 22 of 100
    models are not stabilised by the true controller. Equations (7) to (11) of the paper.
    """
    p = f if p is None else p
    n_u, n_y = r.shape[1], y.shape[1]
    past = range(-p, 0)
    instruments = {"r": [(r, past)], "r and y": [(r, past), (y, past)], "u and y": [(u, past), (y, past)]}[instrument]
    R, rows = lagged_factor([(r, range(f)), *instruments, (y, range(f)), (u, range(f))])
    n_psi = sum(signal.shape[1] * len(offsets) for signal, offsets in instruments)
    M = _Blocks(R=R, sizes=(f * n_u, n_psi, f * n_y, f * n_u))
    M11 = M.block(0, 0)
    if np.min(np.abs(np.diag(M11))) <= _RANK * np.max(np.abs(np.diag(M11))):
        raise IdentificationError(
            f"r is not persistently exciting of order {f}", remedy="excite the loop with noise or many frequencies"
        )
    # steps 1 and 2: first projection O_cl = M32 N2', its SVD (8)
    U_1, s_cl, V_1t = np.linalg.svd(M.block(2, 1), full_matrices=True)
    n_cl = _loop_order(s_cl, order, controller_markov) if loop_order is None else loop_order
    if n_cl >= f * n_y or order > n_cl:
        raise IdentificationError(f"loop order {n_cl} needs f n_y above it, and order {order} at most it, f = {f}")
    free = U_1[:, n_cl:].T  # annihilates Gamma_cl
    # step 3: T_f H_f^d, block Toeplitz, from its rows outside Gamma_cl; then (10)
    impulse = markov_from_null_space(free, free @ M.block(2, 0), M11, n_u=n_u, n_y=n_y)
    TH = toeplitz_blocks(impulse, f)
    H_c = toeplitz_blocks(controller_markov, f)
    T_f = np.eye(f * n_y) - TH @ H_c
    # step 4: second projection, with Gamma_c X_c from (9); R_f has no part along N2
    controller_states = M.block(3, 1) + H_c @ M.block(2, 1)
    O_cl = (U_1[:, :n_cl] * s_cl[:n_cl]) @ V_1t[:n_cl]
    O_f = np.linalg.solve(T_f, O_cl - TH @ controller_states)
    # steps 5 and 6
    gamma = np.linalg.svd(O_f, full_matrices=False)[0][:, :order]
    C, A = gamma[:n_y], least_squares(gamma[:-n_y], gamma[n_y:])
    free_plant = free @ T_f  # annihilates T_f^-1 Gamma_cl
    right = free_plant @ np.linalg.solve(T_f, M.block(2, 0))
    B, D = input_matrices(free_plant, right, M11, gamma, n_u=n_u, n_y=n_y)
    K, sigma = _noise_from(free_plant, np.linalg.solve(T_f, M.block(2, 2)) / np.sqrt(rows), gamma, n_y=n_y)
    return InnovationModel(A=A, B=B, C=C, D=D, K=K, innovation_covariance=sigma @ sigma.T)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Blocks:
    """Blocks of the lower triangular M = R', by the position of their rows and columns in the stack."""

    R: FloatArray
    sizes: tuple[int, ...]

    def block(self, row: int, column: int) -> FloatArray:
        at = np.concatenate([[0], np.cumsum(self.sizes)])
        return self.R[at[column] : at[column + 1], at[row] : at[row + 1]].T


def _loop_order(s: FloatArray, order: int, controller_markov: FloatArray) -> int:
    noise_free = int(np.sum(s > _RANK * s[0]))
    return noise_free if noise_free < len(s) else order + controller_order(controller_markov)


def controller_order(markov: FloatArray) -> int:
    """Return the order n_c of a controller, the rank of the Hankel matrix of its Markov parameters.

    Parameters
    ----------
    markov : (count, n_u, n_y) array
        D_c, C_c B_c, C_c A_c B_c ...

    Raises
    ------
    IdentificationError
        The rank is full: with so few parameters the order may be higher still.
    """
    terms = markov[1:]
    high = (len(terms) + 1) // 2
    wide = len(terms) + 1 - high
    if not high or not np.any(terms):
        return 0
    hankel = np.block([[terms[i + k] for k in range(wide)] for i in range(high)])
    s = np.linalg.svd(hankel, compute_uv=False)
    rank = int(np.sum(s > _CONTROLLER_RANK * s[0]))
    if rank == len(s):
        raise IdentificationError(
            f"{len(markov)} Markov parameters do not show the controller's order",
            where="controller_markov",
            remedy="give twice as many as its order and more, or the loop's order",
        )
    return rank


def markov_from_null_space(free: FloatArray, right: FloatArray, M11: FloatArray, *, n_u: int, n_y: int) -> FloatArray:
    """Return (f, n_y, n_u) Markov parameters L of free H(L) M11 = right, by least squares.

    Parameters
    ----------
    free : (K, f n_y) array
        Rows that annihilate the loop's observability matrix.
    right : (K, f n_u) array
        Right-hand side.
    M11 : (f n_u, f n_u) array
        Lower triangular factor of r.
    n_u, n_y : int
        Numbers of commands and outputs.
    """
    f = free.shape[1] // n_y
    target = solve_triangular(M11, right.T, trans="T", lower=True).T
    blocks = free.reshape(len(free), f, n_y)
    regressors, targets = [], []
    for k in range(f):  # column block k of H: L_0 ... L_(f-1-k) below the diagonal
        part = np.zeros((len(free), f, n_y))
        part[:, : f - k] = blocks[:, k:]
        regressors.append(part.reshape(len(free), f * n_y))
        targets.append(target[:, k * n_u : (k + 1) * n_u])
    solution = least_squares(np.vstack(regressors), np.vstack(targets))
    return solution.reshape(f, n_y, n_u)


def input_matrices(
    free: FloatArray, right: FloatArray, M11: FloatArray, gamma: FloatArray, *, n_u: int, n_y: int
) -> tuple[FloatArray, FloatArray]:
    """Return B and D from free H_f^d(B, D) M11 = right, the last equation of step 6.

    Parameters
    ----------
    free : (K, f n_y) array
        Rows that annihilate the plant's observability matrix.
    right : (K, f n_u) array
        Right-hand side.
    M11 : (f n_u, f n_u) array
        Lower triangular factor of r.
    gamma : (f n_y, n) array
        The plant's observability matrix.
    n_u, n_y : int
        Numbers of commands and outputs.

    Returns
    -------
    tuple of array
        B, (n, n_u), and D, (n_y, n_u).
    """
    f = free.shape[1] // n_y
    target = solve_triangular(M11, right.T, trans="T", lower=True).T
    solution = least_squares(
        _input_regressors(free, gamma, f, n_y), np.vstack(np.split(target, f, axis=1)).reshape(-1, n_u)
    )
    return solution[n_y:], solution[:n_y]


def _input_regressors(free: FloatArray, gamma: FloatArray, f: int, n_y: int) -> FloatArray:
    """Return the matrix whose product with [D; B] stacks the column blocks of free H_f^d(B, D)."""
    stacked = []
    for k in range(f):
        below = free[:, (k + 1) * n_y :] @ gamma[: (f - 1 - k) * n_y]
        stacked.append(np.hstack([free[:, k * n_y : (k + 1) * n_y], below]))
    return np.vstack(stacked)


def _noise_from(free: FloatArray, spread: FloatArray, gamma: FloatArray, *, n_y: int) -> tuple[FloatArray, FloatArray]:
    """Return K and sigma of section III-C: min | free P - free H_f^s(K, sigma) |, linear in (sigma, K sigma)."""
    f = spread.shape[0] // n_y
    P = triangle(spread.T).T
    P = P * np.where(np.diag(P) < 0.0, -1.0, 1.0)  # Cholesky factor of P P'
    target = np.vstack(np.split(free @ P, f, axis=1))
    solution = least_squares(_input_regressors(free, gamma, f, n_y), target)
    sigma, K_sigma = solution[:n_y], solution[n_y:]
    if np.linalg.cond(sigma) > 1e12:  # no noise to speak of
        return np.zeros((gamma.shape[1], n_y)), sigma
    return K_sigma @ np.linalg.inv(sigma), sigma


def controller_markov_parameters(r: FloatArray, u: FloatArray, y: FloatArray, count: int) -> tuple[FloatArray, int]:
    """Return the controller's Markov parameters from the data (Remark 4), and the order its singular values show.

    Parameters
    ----------
    r, u, y : (N, n_u), (N, n_u), (N, n_y) arrays
        Data of the loop u = r - C y; the relation holds without noise, whatever disturbs y.
    count : int
        How many are wanted; also the future and the past window.

    Returns
    -------
    markov : (count, n_u, n_y) array
        D_c, C_c B_c, C_c A_c B_c ...
    order : int
        Numerical rank of the past's part in the future, the controller's order.

    Raises
    ------
    IdentificationError
        The relation is not exact: r is not what was added to the command, or the controller is not linear.
    """
    w = u - r  # = - C y
    n_u, n_y = u.shape[1], y.shape[1]
    R, _ = lagged_factor([(y, range(count)), (y, range(-count, 0)), (w, range(-count, 0)), (w, range(count))])
    M = _Blocks(R=R, sizes=(count * n_y, count * (n_u + n_y), count * n_u))
    U, s, _ = np.linalg.svd(M.block(2, 1), full_matrices=True)
    order = int(np.sum(s > 1e-7 * np.linalg.norm(M.block(2, 0)) / np.sqrt(count)))
    if order >= count * n_u:
        raise IdentificationError(
            "u - r is not a linear function of past y: no controller of moderate order explains it",
            remedy="check that r is the signal added to the command, or give the controller file",
        )
    free = U[:, order:].T
    return -markov_from_null_space(free, free @ M.block(2, 0), M.block(0, 0), n_u=n_y, n_y=n_u), order
