"""On-line identification by modulating functions with exponential forgetting: Ollivier et al. (2007), sections 2 and 4.

Kernels g_j(t) = (T - t)^j exp(-lambda (T - t)) up to the current time T; their integrals J_j = I_{x,g_j} obey
J_0' = x - lambda J_0, J_j' = j J_{j-1} - lambda J_j, and d g_j/dt = lambda g_j - j g_{j-1} gives those of the
derivatives. The kernels with j >= n vanish at T together with n - 1 derivatives and give the parameters; those with
j < n give the state. The equations C A = D are not solved but followed by the gradient flow
A' = -Lambda C^T (C A - D), which is stiff: explicit Euler steps diverge at 100 Hz, so the steps are implicit.

Misprints of the paper: in section 4 the second column is b_1 I_{u,f'}, not b_1 I_{u,f}; the factor in the delayed
input's chain is (1 - lambda_h b_1/b_0), with the printed plus sign the estimate loses lock. Here the chain of u is
evaluated at t - h exactly, from its stored past, and needs no factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError, InputError
from autotune.identification.delay.compiled import cholesky_solve
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True)
class DelayTracking:
    """How the delay is followed.

    Attributes
    ----------
    start_s : float
        Delay the tracking begins with [s]; the true one must be near, compared with 1/lambda.
    after_s : float
        T_0: time from the first row until which the delay is held at its start [s].
    rate : float
        lambda_h: share of the correction b_1/b_0 taken per second [1/s].
    """

    start_s: float = 0.0
    after_s: float
    rate: float


@dataclass(frozen=True, kw_only=True, eq=False)
class OnlineEstimate:
    """Estimates row by row.

    Attributes
    ----------
    t : (N,) array
        Time stamps [s].
    a : (N, n) array
        a_0..a_{n-1}.
    b, delay_s : (N,) array
        Input gain and delay [s].
    state : (N, n) array
        x, x', .. at each row; NaN until the kernels have filled.
    """

    t: FloatArray
    a: FloatArray
    b: FloatArray
    delay_s: FloatArray
    state: FloatArray


def follow(
    recording: Recording,
    order: int,
    *,
    forgetting: float,
    gain: float,
    delay: DelayTracking | None = None,
    linear: bool = True,
) -> OnlineEstimate:
    """Follow the parameters, the state and, where asked for, the delay, row by row.

    Parameters
    ----------
    recording : Recording
        Rows of t, u, y.
    order : int
        Order n.
    forgetting : float
        lambda [1/s]; the kernels of the parameters look back (n+2)/lambda.
    gain : float
        Lambda of the gradient flow: large follows faster and lets more noise through.
    delay : DelayTracking, optional
        How the delay is followed; the plant has none where not given.
    linear : bool
        Whether u runs linearly between rows; held otherwise.

    Returns
    -------
    OnlineEstimate
        Every row uses rows up to itself only.

    Raises
    ------
    InputError
        Bad values in the rows, or settings that are not positive.
    IdentificationError
        The delay ran out of the record: lock was lost.

    Notes
    -----
    The estimate carries no covariance, and noise on y stands in its regressors; where bands are needed, fit windows
    by output error (:mod:`autotune.identification.delay.tracking`).

    References
    ----------
    Section 2, Example 1; section 4, Examples 4 and 5.
    """
    recording.require_finite()
    if not (forgetting > 0 and gain > 0 and order >= 1):
        raise InputError("forgetting, gain and order must be positive", where="follow")
    start, after, rate = (delay.start_s, delay.after_s, delay.rate) if delay else (0.0, np.inf, 0.0)
    a, b, h, state, lost = _follow(
        recording.t, recording.u, recording.y, order, forgetting, gain, linear, delay is not None, start, after, rate
    )
    if lost >= 0:
        raise IdentificationError(
            f"the delay estimate left the record at t = {recording.t[lost]:g} s: lock was lost",
            where=recording.name,
            remedy="start nearer to the delay, later, or with a lower rate; identify_delay finds a start",
        )
    filled = recording.t - recording.t[0] > (order + 2) / forgetting + 10.0 * recording.sample_time_s
    state[~filled] = np.nan
    return OnlineEstimate(t=recording.t, a=a, b=b, delay_s=h, state=state)


@njit(cache=True)
def _advance(J: FloatArray, step: float, first: float, last: float, lam: float, new: FloatArray) -> None:
    """Carry the chain over a step during which the signal runs linearly from first to last, exactly."""
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
def _delayed(
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
    if row < t.size - 1 and at > t[row]:
        share = (at - t[row]) / (t[row + 1] - t[row])
        last = u[row] + share * (u[row + 1] - u[row]) if linear else u[row]
        _advance(J, at - t[row], u[row], last, lam, np.empty(J.size))
    return J, row


@njit(cache=True)
def _follow(
    t: FloatArray,
    u: FloatArray,
    y: FloatArray,
    n: int,
    lam: float,
    gain: float,
    linear: bool,
    delayed: bool,
    h: float,
    after: float,
    rate: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, int]:
    N = t.size
    kernels = 2 * n + 2
    unknowns = n + 2 if delayed else n + 1
    Jy = np.zeros(kernels)
    Ju = np.zeros(kernels)
    new = np.empty(kernels)
    past = np.zeros((N if delayed else 1, kernels))
    A = np.zeros(unknowns)
    a = np.zeros((N, n))
    b = np.zeros(N)
    delay = np.full(N, h)
    state = np.zeros((N, n))
    row = 0
    for k in range(1, N):
        step = t[k] - t[k - 1]
        _advance(Jy, step, y[k - 1], y[k], lam, new)
        _advance(Ju, step, u[k - 1], u[k] if linear else u[k - 1], lam, new)
        Jh = Ju
        if delayed:
            past[k] = Ju
            Jh, row = _delayed(t, u, past, k, t[k] - h, row, lam, linear)
        Y = _derivatives(Jy, n, lam)
        U = _derivatives(Jh, 1, lam)
        C = np.empty((kernels - n, unknowns))
        D = np.empty(kernels - n)
        for j in range(n, kernels):
            for i in range(n):
                C[j - n, i] = (-1.0) ** i * Y[i, j]
            C[j - n, n] = U[0, j]
            if delayed:
                C[j - n, n + 1] = U[1, j]
            D[j - n] = (-1.0) ** n * Y[n, j]
        # the implicit step (I + dt Lambda C^T C) A_new = A + dt Lambda C^T D; its matrix is positive definite
        A = cholesky_solve(np.eye(unknowns) + step * gain * (C.T @ C), A + step * gain * (C.T @ D), 0.0)[0]
        if delayed and t[k] - t[0] > after and A[n] != 0.0:
            h += step * rate * A[n + 1] / A[n]
            if not 0.0 <= h <= t[k] - t[0]:
                return a, b, delay, state, k
        a[k] = A[:n]
        b[k] = A[n]
        delay[k] = h
        state[k] = _state(A, Y, U, n, lam)
    return a, b, delay, state, -1


@njit(cache=True)
def _state(A: FloatArray, Y: FloatArray, U: FloatArray, n: int, lam: float) -> FloatArray:
    """Solve the equations of the kernels j < n, whose end terms carry x..x^(n-1)(T)."""
    ends = np.zeros((n + 1, n))  # g_j^(k)(T)
    ends[0, 0] = 1.0
    for k in range(1, n + 1):
        for j in range(n):
            ends[k, j] = lam * ends[k - 1, j] - (j * ends[k - 1, j - 1] if j > 0 else 0.0)
    M = np.zeros((n, n))
    r = np.zeros(n)
    for j in range(n):
        r[j] = -A[n] * U[0, j]
        for i in range(n + 1):
            coefficient = -1.0 if i == n else A[i]
            r[j] -= coefficient * (-1.0) ** i * Y[i, j]
            for order in range(i):
                M[j, order] += coefficient * (-1.0) ** (i - order - 1) * ends[i - order - 1, j]
    return np.asarray(np.linalg.solve(M, r), dtype=np.float64)
