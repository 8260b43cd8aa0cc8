"""Compiled steps of the on-line modulating functions: chains of kernels, the equations, one row's update."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from autotune.arrays import FloatArray
from autotune.identification.delay.compiled import cholesky_solve

#: places in the vector of scalars that a state carries from row to row
H, LAST_T, LAST_U, LAST_Y, FIRST_T, ROW, WEIGHT, SPREAD = range(8)
#: what is added to the averaged equations so that they can be solved before they are excited, relative to themselves
_TRACE = 1e-9
#: weight of the averaged equations from which on what they leave is taken for noise, and then of that itself
_SETTLED = 0.8
#: Age of the kernels, in their number over lambda, from which on the equations are averaged.
_FILLED = 2.5
#: degrees of freedom of the noise's density from which on a covariance is stated
_FREEDOM = 3.0
_LONGER = 3.0


class Settings(NamedTuple):
    """What stays from row to row.

    Attributes
    ----------
    n : int
        Order of the equation.
    lam : float
        Decay of the kernels lambda [1/s].
    gain : float
        Above 0 that of the paper's gradient flow; else the gain matrix is the inverse of the averaged equations.
    memory_s : float
        Memory of the averages [s].
    linear : bool
        Whether u runs linearly between its rows (else it is held).
    delayed, offset : bool
        Whether a delay and a constant are unknowns.
    after : float
        Time since the first row from which on the delay moves [s].
    rate : float
        How fast it does [1/s].
    """

    n: int
    lam: float
    gain: float
    memory_s: float
    linear: bool
    delayed: bool
    offset: bool
    after: float
    rate: float


class Carried(NamedTuple):
    """What is carried over from row to row, changed in place.

    Attributes
    ----------
    Jy, Ju : (kernels,) array
        Chains of y and u.
    A : (P,) array
        The unknowns: coefficients, b, b times what the delay lacks, constant.
    R : (P, P) array
        Averaged equations.
    slow : (P,) array
        Averaged right-hand side.
    spread : (P, P) array
        What the equations leave, averaged.
    scalars : (8,) array
        Delay [s], stamps and values of the last row, and weights; places as named above.
    """

    Jy: FloatArray
    Ju: FloatArray
    A: FloatArray
    R: FloatArray
    slow: FloatArray
    spread: FloatArray
    scalars: FloatArray


@njit(cache=True)
def advance(J: FloatArray, step: float, first: float, last: float, lam: float, new: FloatArray) -> None:
    """Carry the chain over a step during which the signal runs linearly from first to last, exactly.

    Parameters
    ----------
    J : (kernels,) array
        The chain, changed in place.
    step : float
        Length of the step [s].
    first, last : float
        The signal at its ends.
    lam : float
        Decay of the kernels lambda [1/s].
    new : (kernels,) array
        Room to work in.
    """
    decay = np.exp(-lam * step)
    for j in range(J.size):
        total = 0.0
        binomial = 1.0  # C(j, i) step^i
        for i in range(j + 1):
            total += binomial * J[j - i]
            binomial *= step * (j - i) / (i + 1.0)
        new[j] = decay * total
    # int_0^step v(step - s) s^j exp(-lam s) ds by four Gauss points, exact to (lam step)^8
    for node, weight in (
        (0.06943184420297371, 0.17392742256872692),
        (0.33000947820757187, 0.32607257743127307),
        (0.6699905217924281, 0.32607257743127307),
        (0.9305681557970262, 0.17392742256872692),
    ):
        s = node * step
        value = (last + (first - last) * node) * weight * step * np.exp(-lam * s)
        for j in range(J.size):
            new[j] += value
            value *= s
    for j in range(J.size):
        J[j] = new[j]


@njit(cache=True)
def _derivatives(J: FloatArray, n: int, lam: float) -> FloatArray:
    """Return I_{x, g_j^(i)} for i = 0..n, shape (n+1, kernels)."""
    result = np.empty((n + 1, J.size))
    result[0] = J
    for i in range(1, n + 1):
        for j in range(J.size):
            result[i, j] = lam * result[i - 1, j] - (j * result[i - 1, j - 1] if j > 0 else 0.0)
    return result


@njit(cache=True)
def _chain_in_past(
    t: FloatArray, u: FloatArray, past: FloatArray, k: int, at: float, row: int, lam: float, linear: bool
) -> tuple[FloatArray, int]:
    """Return the chain of u at a time in the past, and the row it was carried on from."""
    J = np.zeros(past.shape[1])
    if at <= t[0]:
        return J, 0
    while row < k and t[row + 1] <= at:
        row += 1
    while row > 0 and t[row] > at:
        row -= 1
    J[:] = past[row]
    if row < k and at > t[row]:
        share = (at - t[row]) / (t[row + 1] - t[row])
        last = u[row] + share * (u[row + 1] - u[row]) if linear else u[row]
        advance(J, at - t[row], u[row], last, lam, np.empty(J.size))
    return J, row


@njit(cache=True)
def _equations(Jy: FloatArray, Jh: FloatArray, n: int, lam: float, delayed: bool) -> tuple[FloatArray, FloatArray]:
    """Return C and D of the kernels j >= n, each in the unit of the n-th derivative of y."""
    Y = _derivatives(Jy, n, lam)
    U = _derivatives(Jh, 1, lam)
    kernels = Jy.size
    unknowns = n + 2 if delayed else n + 1
    C = np.empty((kernels - n, unknowns))
    D = np.empty(kernels - n)
    for j in range(n, kernels):
        for i in range(n):
            C[j - n, i] = (-1.0) ** i * Y[i, j]
        C[j - n, n] = U[0, j]
        if delayed:
            C[j - n, n + 1] = U[1, j]
        D[j - n] = (-1.0) ** n * Y[n, j]
    return C, D


@njit(cache=True)
def step_row(
    k: int, t: FloatArray, u: FloatArray, past: FloatArray, y: float, carried: Carried, settings: Settings
) -> tuple[FloatArray, FloatArray, bool]:
    """Carry everything over to row k, in place; return state, covariance of the unknowns and whether lock holds.

    Parameters
    ----------
    k : int
        The row.
    t, u : (N,) array
        Time stamps [s] and command [u unit], up to row k at least.
    past : (N, kernels) array
        Chain of u at every row.
    y : float
        Measurement at row k [y unit].
    carried : Carried
        From the row before.
    settings : Settings
        Those of the estimator.
    """
    Jy, Ju, A, R, _, spread, scalars = carried
    n, lam, gain, memory_s, linear, delayed, offset, after, rate = settings
    kernels = Jy.size
    step = t[k] - scalars[LAST_T]
    new = np.empty(kernels)
    advance(Jy, step, scalars[LAST_Y], y, lam, new)
    advance(Ju, step, scalars[LAST_U], u[k] if linear else scalars[LAST_U], lam, new)
    past[k] = Ju
    Jh = Ju
    if delayed:
        Jh, row = _chain_in_past(t, u, past, k, t[k] - scalars[H], int(scalars[ROW]), lam, linear)
        scalars[ROW] = row
    C, D = _equations(Jy, Jh, n, lam, delayed)
    if gain > 0.0:
        # the implicit step (I + dt Lambda C^T C) A_new = A + dt Lambda C^T D; its matrix is positive definite
        A[:] = cholesky_solve(np.eye(A.size) + step * gain * (C.T @ C), A + step * gain * (C.T @ D), 0.0)[0]
    elif (t[k] - scalars[FIRST_T] - scalars[H]) * lam > _FILLED * kernels:  # what was before the first row is forgotten
        if offset:
            whole = np.ones((C.shape[0], A.size))
            whole[:, : A.size - 1] = C
            C = whole
        _solve_averaged(C, D, carried, step, settings)
    if delayed and t[k] - scalars[FIRST_T] > after and A[n] != 0.0:
        lacking = A[n + 1] / A[n]
        moved = max(step * rate * lacking, -scalars[H])  # u is not known ahead of its time
        scalars[H] += moved
        if gain <= 0.0:
            A[n + 1] -= A[n] * moved  # b_1 = b (h - h_hat) has got smaller by what h_hat moved
        if not (scalars[H] > 0.0 or lacking * lam > -1.0) or not scalars[H] <= t[k] - scalars[FIRST_T]:
            return np.zeros(n), R, False
    scalars[LAST_T], scalars[LAST_U], scalars[LAST_Y] = t[k], u[k], y
    state = _state(A, _derivatives(Jy, n, lam), _derivatives(Jh, 1, lam), n, lam, offset)
    covariance = _covariance(R, spread, scalars[WEIGHT], scalars[SPREAD], memory_s, _corner(kernels, lam))
    return state, covariance, True


@njit(cache=True)
def step_rows(
    t: FloatArray, u: FloatArray, past: FloatArray, y: FloatArray, carried: Carried, settings: Settings
) -> tuple[FloatArray, FloatArray, int]:
    """Carry everything over all rows after the first; return state, covariance and the row where lock was lost, or 0.

    Parameters
    ----------
    t, u, past : (N,), (N,), (N, kernels) arrays
        As of :func:`step_row`.
    y : (N,) array
        Measurement [y unit].
    carried, settings
        As of :func:`step_row`.
    """
    state, covariance = np.full(settings.n, np.nan), np.full(carried.R.shape, np.nan)
    for k in range(1, t.size):
        state, covariance, locked = step_row(k, t, u, past, y[k], carried, settings)
        if not locked:
            return state, covariance, k
    return state, covariance, 0


@njit(cache=True)
def _solve_averaged(C: FloatArray, D: FloatArray, carried: Carried, step: float, settings: Settings) -> None:
    """Move A by the averaged equations' own inverse, which no unit changes; keep what its covariance is made of."""
    A, R, slow, spread, scalars = carried.A, carried.R, carried.slow, carried.spread, carried.scalars
    n, lam, memory_s, offset = settings.n, settings.lam, settings.memory_s, settings.offset
    factor = 1.0
    known = A.size - 1 if offset else A.size
    for j in range(n + C.shape[0]):  # kernels of area 1: every equation in the same unit, whatever that of time
        factor *= lam / max(j, 1)
        if j >= n:
            C[j - n, :known] *= factor  # a constant's integral over a kernel of area 1 is itself
            D[j - n] *= factor
    fresh = 1.0 - np.exp(-step / memory_s)
    scalars[WEIGHT] += fresh * (1.0 - scalars[WEIGHT])
    R += fresh * (C.T @ C - R)
    regular = R.copy()
    for i in range(A.size):
        regular[i, i] += _TRACE * R[i, i] + 1e-300
    A += fresh * cholesky_solve(regular, C.T @ (D - C @ A), 0.0)[0]
    if scalars[WEIGHT] < _SETTLED:  # the way to the estimate is not its noise
        return
    # the density at frequency zero of the regressors times what the equations leave
    corner = _corner(n + C.shape[0], lam)
    slow += (1.0 - np.exp(-step * corner)) * (C.T @ (D - C @ A) - slow)
    newer = fresh / _LONGER  # few independent values come in one memory
    spread += newer * (np.outer(slow, slow) * 2.0 / corner - spread)
    scalars[SPREAD] += newer * (1.0 - scalars[SPREAD])


@njit(cache=True)
def _corner(kernels: int, lam: float) -> float:
    """Return the frequency [rad/s] below which what overlapping kernels leave has the density it has at zero."""
    return lam / (2.0 * kernels)


@njit(cache=True)
def _covariance(
    R: FloatArray, spread: FloatArray, weight: float, known: float, memory_s: float, corner: float
) -> FloatArray:
    """Return the covariance of least squares that forgets: R^-1 Phi R^-1 / (2 memory), more while the memory fills.

    The estimate follows the equations with its memory, and so takes from what they leave all that is slower: of the
    density that the filter at ``corner`` lets through the share corner/(corner + 1/memory) is seen. The average over
    LONGER memories of the square of what is left between the two frequencies has 2 LONGER memory (corner + 1/memory)
    degrees of freedom; the answer is larger by the square of Student's quantile over the normal one, so that 1.96
    standard deviations are a 95 % interval.
    """
    size = R.shape[0]
    scale = np.sqrt(np.diag(R))
    seen = corner / (corner + 1.0 / memory_s)
    freedom = 2.0 * _LONGER * (1.0 + memory_s * corner) * known / (2.0 - known)
    if freedom < _FREEDOM or np.min(scale) <= 0.0:
        return np.full((size, size), np.nan)
    inverse = np.linalg.inv(R / np.outer(scale, scale) + _TRACE * np.eye(size)) / np.outer(scale, scale)
    factor = _student(freedom) * weight * (2.0 - weight) / (2.0 * memory_s * known * seen)
    return np.asarray(inverse @ spread @ inverse * factor, dtype=np.float64)


@njit(cache=True)
def _student(freedom: float) -> float:
    """Return the square of Student's 97.5 % quantile over the normal one (Cornish-Fisher, Abramowitz 26.7.5)."""
    z, v = 1.959963984540054, freedom
    first = (z**3 + z) / (4.0 * v)
    second = (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / (96.0 * v**2)
    third = (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / (384.0 * v**3)
    return float(((z + first + second + third) / z) ** 2)


@njit(cache=True)
def _state(A: FloatArray, Y: FloatArray, U: FloatArray, n: int, lam: float, offset: bool) -> FloatArray:
    """Solve the equations of the kernels j < n, whose end terms carry x..x^(n-1)(T)."""
    ends = np.zeros((n + 1, n))  # g_j^(k)(T)
    ends[0, 0] = 1.0
    for k in range(1, n + 1):
        for j in range(n):
            ends[k, j] = lam * ends[k - 1, j] - (j * ends[k - 1, j - 1] if j > 0 else 0.0)
    M = np.zeros((n, n))
    r = np.zeros(n)
    area = 1.0
    for j in range(n):
        area *= max(j, 1) / lam
        r[j] = -A[n] * U[0, j] - (A[A.size - 1] * area if offset else 0.0)
        for i in range(n + 1):
            coefficient = -1.0 if i == n else A[i]
            r[j] -= coefficient * (-1.0) ** i * Y[i, j]
            for order in range(i):
                M[j, order] += coefficient * (-1.0) ** (i - order - 1) * ends[i - order - 1, j]
    return np.asarray(np.linalg.solve(M, r), dtype=np.float64)
