"""Response of x^(n) = sum a_i x^(i) + b u(t - h) + d and its sensitivities, exact between the samples, compiled.

The input is piecewise constant or linear between its own time stamps, the output is wanted at others; the delayed
stamps t_j + h cut the time between two outputs into pieces on which the transition is a matrix exponential.

With z the response to u(t - h) from rest, e the response to the constant 1 and phi_i the free responses,
x = b z + d e + sum x^(i)(t_s) phi_i. The sensitivities need one further chain s from rest, s^(n) = sum a_i s^(i) + x:
up to a free response, dx/da_i = s^(i) and dx/dh = -x'. The free responses matter to the covariance of the initial
state only.

The coefficients are passed as a tuple: its length is the order, and known to the compiler, which unrolls the loops
over the states (ten times faster than with an array).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from autotune.arrays import FloatArray
from autotune.identification.delay.compiled import cholesky_solve, transitions

_OVERFLOW = 1e100
_NEGLIGIBLE = 1e-150
_BLOCK = 2048  # pieces that are carried at once


@njit(cache=True, nogil=True)
def _begin(
    tu: FloatArray, ty: FloatArray, a: tuple[float, ...], h: float, theta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a_0.., chains (columns z, e, phi_0.., s, x; rows the derivatives) and clock at the first output."""
    n = len(a)
    coefficients, chains = np.empty(n), np.zeros((n, n + 4))
    for i in range(n):
        coefficients[i], chains[i, 2 + i], chains[i, 3 + n] = a[i], 1.0, theta[2 + i]
    return coefficients, chains, np.array([ty[0], np.searchsorted(tu, ty[0] - h, side="right") - 1, 0.0])


@njit(cache=True, nogil=True)
def _schedule(
    tu: FloatArray, u: FloatArray, before: float, linear: bool, ty: FloatArray, h: float, clock: FloatArray
) -> tuple[FloatArray, int, int]:
    """Cut the time from the clock on into pieces, up to a block of them.

    Returns
    -------
    pieces : (_BLOCK, 4) array
        Duration, input and its slope at the piece's beginning, and 1 where an output stands at its end.
    count, outputs : int
        Pieces and outputs among them. The clock (time, row of the delayed input, next output) has moved on.
    """
    pieces = np.empty((_BLOCK, 4))
    now = clock[0]
    j = int(clock[1])
    k = int(clock[2])
    first = k
    count = 0
    while k < ty.size and count < _BLOCK:
        until = ty[k]
        crossing = j + 1 < tu.size and tu[j + 1] + h < until
        if crossing:
            until = max(tu[j + 1] + h, now)
        w = before
        v = 0.0
        if j >= 0:
            w = u[j]
            if linear and j < tu.size - 1:
                v = (u[j + 1] - u[j]) / (tu[j + 1] - tu[j])
                w += v * (now - h - tu[j])
        pieces[count, 0] = until - now
        pieces[count, 1] = w
        pieces[count, 2] = v
        pieces[count, 3] = 0.0 if crossing else 1.0
        count += 1
        if crossing:
            j += 1
        else:
            k += 1
        now = until
    clock[0] = now
    clock[1] = j
    clock[2] = k
    return pieces, count, k - first


@njit(cache=True, nogil=True)
def _transitions(
    a: FloatArray, pieces: FloatArray, count: int, resolution: float
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the blocks of the distinct transitions among the pieces, and which of them each piece has."""
    which = np.empty(count, dtype=np.int64)
    known = np.empty(count)
    found = 0
    for i in range(count):
        which[i] = -1
        for c in range(max(0, found - 4), found):
            if abs(known[c] - pieces[i, 0]) <= 1e-10 * pieces[i, 0] + resolution:
                which[i] = c
                break
        if which[i] < 0:
            which[i] = found
            known[found] = pieces[i, 0]
            found += 1
    return transitions(a, known[:found]), which


@njit(cache=True, nogil=True)
def _propagate(
    a: tuple[float, ...],
    F: FloatArray,
    which: NDArray[np.int64],
    pieces: FloatArray,
    carried: FloatArray,
    out: FloatArray,
) -> bool:
    """Carry z, e and phi over the pieces, write them at the outputs, and say whether they stayed finite."""
    n = len(a)
    chains = np.empty((n, n + 2))
    new = np.empty((n, n + 2))
    for i in range(n):
        for c in range(n + 2):
            chains[i, c] = carried[i, c]
    k = 0
    for p in range(which.size):
        f = which[p]
        w = pieces[p, 1]
        v = pieces[p, 2]
        for i in range(n):
            for c in range(2 + n):
                new[i, c] = 0.0
            new[i, 0] = F[f, i, 2 * n + 2] * w + F[f, i, 2 * n + 3] * v
            new[i, 1] = F[f, i, 2 * n + 2]
            for j in range(n):
                for c in range(2 + n):
                    new[i, c] += F[f, i, j] * chains[j, c]
        for i in range(n):
            for c in range(2 + n):
                chains[i, c] = new[i, c]
        if pieces[p, 3] > 0.0:
            for c in range(2 + n):
                out[k, c] = chains[0, c]
            k += 1
    for i in range(n):
        for c in range(n + 2):
            # arithmetic on subnormal numbers, to which free responses decay, is ten times slower
            carried[i, c] = chains[i, c] if abs(chains[i, c]) > _NEGLIGIBLE else 0.0
    return bool(abs(chains[0, 0]) + abs(chains[0, 1 + n]) < _OVERFLOW)


@njit(cache=True, nogil=True)
def _propagate_sensitivities(
    a: tuple[float, ...],
    b: float,
    d: float,
    F: FloatArray,
    which: NDArray[np.int64],
    pieces: FloatArray,
    carried: FloatArray,
    out: FloatArray,
) -> None:
    """Carry x and s over the pieces and write s..s^(n-1), -x' and x at the outputs, into the last columns."""
    n = len(a)
    x = np.empty(n)
    s = np.empty(n)
    new_x = np.empty(n)
    new_s = np.empty(n)
    for i in range(n):
        x[i] = carried[i, n + 3]
        s[i] = carried[i, n + 2]
    k = 0
    for p in range(which.size):
        f = which[p]
        w = b * pieces[p, 1] + d
        v = b * pieces[p, 2]
        for i in range(n):
            new_s[i] = F[f, i, 2 * n] * w + F[f, i, 2 * n + 1] * v
            new_x[i] = F[f, i, 2 * n + 2] * w + F[f, i, 2 * n + 3] * v
            for j in range(n):
                new_s[i] += F[f, i, j] * s[j] + F[f, i, n + j] * x[j]
                new_x[i] += F[f, i, j] * x[j]
        for i in range(n):
            x[i] = new_x[i]
            s[i] = new_s[i]
        if pieces[p, 3] > 0.0:
            for i in range(n):
                out[k, 2 + n + i] = s[i]
            out[k, 2 + 2 * n] = -x[1] if n > 1 else -(a[0] * x[0] + w + v * pieces[p, 0])
            out[k, 3 + 2 * n] = x[0]
            k += 1
    for i in range(n):
        carried[i, n + 3] = x[i]
        carried[i, n + 2] = s[i]


@njit(cache=True, nogil=True)
def normal_matrix(
    tu: FloatArray,
    u: FloatArray,
    before: float,
    linear: bool,
    ty: FloatArray,
    y: FloatArray,
    a: tuple[float, ...],
    h: float,
    theta: FloatArray,
    sensitive: bool,
    whitening: FloatArray,
) -> tuple[FloatArray, bool]:
    """Return the Gram matrix of the columns and, last, of what they have to explain, and whether it is finite.

    Parameters
    ----------
    tu, u : (M,) array
        Input and its time stamps [s].
    before : float
        Input before the record.
    linear : bool
        Whether the input runs linearly between its stamps (else it is held).
    ty, y : (N,) array
        Output and its time stamps [s]; the first stamp is t_s, where the initial state stands.
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s], at least 0.
    theta : (2+n,) array
        b, d and the initial state; used with sensitivities only.
    sensitive : bool
        Whether the sensitivities to a and h are wanted besides.
    whitening : (p,) array
        Coefficients c_1..c_p of the filter 1 + c_1 q^-1 + ... that makes the noise white; its first p rows are
        dropped. Empty for white noise. Only for uniform records.

    Returns
    -------
    gram : (c+1, c+1) array
        Columns z, e, phi_0.. against y; with sensitivities z, e, phi_0.., s.., -x' against the residual y - x.
    finite : bool
        False where the response overflowed.

    Notes
    -----
    Time is linear in the rows; memory is one block of rows, whatever the record's length.
    """
    n = len(a)
    order = whitening.size
    width = 2 * n + 4 if sensitive else 3 + n
    gram = np.zeros((width, width))
    coefficients, chains, clock = _begin(tu, ty, a, h, theta)
    rows = np.zeros((order + _BLOCK, width))
    white = np.empty((_BLOCK, width))
    first = 0
    while first < ty.size:
        pieces, count, outputs = _schedule(tu, u, before, linear, ty, h, clock)
        F, which = _transitions(coefficients, pieces, count, 1e-13 * abs(clock[0]))
        finite = _propagate(a, F, which, pieces, chains, rows[order:])
        if not finite:
            return gram, False
        if sensitive:
            _propagate_sensitivities(a, theta[0], theta[1], F, which, pieces, chains, rows[order:])
        for k in range(outputs):
            rows[order + k, width - 1] = y[first + k] - (rows[order + k, width - 1] if sensitive else 0.0)
        skip = max(0, min(order - first, outputs))
        if order > 0:
            _filter(rows, whitening, skip, outputs, white)
        used = white[skip:outputs] if order > 0 else rows[:outputs]
        gram += used.T @ used
        for i in range(order):
            rows[i] = rows[outputs + i]
        first += outputs
    return gram, bool(np.all(np.isfinite(gram)))


@njit(cache=True, nogil=True)
def _filter(rows: FloatArray, whitening: FloatArray, skip: int, count: int, white: FloatArray) -> None:
    p = whitening.size
    for k in range(skip, count):
        for c in range(rows.shape[1]):
            total = rows[p + k, c]
            for i in range(p):
                total += whitening[i] * rows[p + k - 1 - i, c]
            white[k, c] = total


@njit(cache=True, nogil=True)
def output(
    tu: FloatArray,
    u: FloatArray,
    before: float,
    linear: bool,
    ty: FloatArray,
    a: tuple[float, ...],
    h: float,
    theta: FloatArray,
) -> FloatArray:
    """Return x at the output times, (N,), NaN from where it overflows.

    Parameters
    ----------
    tu, u : (M,) array
        Input and its time stamps [s].
    before : float
        Input before the record.
    linear : bool
        Whether the input runs linearly between its stamps (else it is held).
    ty : (N,) array
        Output times [s].
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s], at least 0.
    theta : (2+n,) array
        b, d and the initial state.
    """
    n = len(a)
    x = np.full(ty.size, np.nan)
    coefficients, chains, clock = _begin(tu, ty, a, h, theta)
    rows = np.zeros((_BLOCK, 2 + n))
    first = 0
    while first < ty.size:
        pieces, count, outputs = _schedule(tu, u, before, linear, ty, h, clock)
        F, which = _transitions(coefficients, pieces, count, 1e-13 * abs(clock[0]))
        if not _propagate(a, F, which, pieces, chains, rows):
            break
        x[first : first + outputs] = rows[:outputs] @ theta
        first += outputs
    return x


@njit(cache=True, nogil=True)
def sensitivities(
    tu: FloatArray,
    u: FloatArray,
    before: float,
    linear: bool,
    ty: FloatArray,
    a: tuple[float, ...],
    h: float,
    theta: FloatArray,
) -> FloatArray:
    """Return the columns z, e, phi_0.., s.., -x' of :func:`normal_matrix` row by row, shape (N, 2n+3).

    Parameters
    ----------
    tu, u : (M,) array
        Input and its time stamps [s].
    before : float
        Input before the record.
    linear : bool
        Whether the input runs linearly between its stamps (else it is held).
    ty : (N,) array
        Output times [s].
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s], at least 0.
    theta : (2+n,) array
        b, d and the initial state.
    """
    n = len(a)
    columns = np.zeros((ty.size, 2 * n + 4))
    coefficients, chains, clock = _begin(tu, ty, a, h, theta)
    first = 0
    while first < ty.size:
        pieces, count, outputs = _schedule(tu, u, before, linear, ty, h, clock)
        F, which = _transitions(coefficients, pieces, count, 1e-13 * abs(clock[0]))
        if not _propagate(a, F, which, pieces, chains, columns[first:]):
            break
        _propagate_sensitivities(a, theta[0], theta[1], F, which, pieces, chains, columns[first:])
        first += outputs
    return columns[:, : 2 * n + 3]


@njit(cache=True, nogil=True)
def linear_part(
    tu: FloatArray,
    u: FloatArray,
    before: float,
    linear: bool,
    ty: FloatArray,
    y: FloatArray,
    a: tuple[float, ...],
    h: float,
    offset: bool,
    whitening: FloatArray,
) -> tuple[FloatArray, float]:
    """Return the best b, d and initial state for given (a, h), and the sum of squares; infinite where not finite.

    Parameters
    ----------
    tu, u : (M,) array
        Input and its time stamps [s].
    before : float
        Input before the record.
    linear : bool
        Whether the input runs linearly between its stamps (else it is held).
    ty, y : (N,) array
        Output and its time stamps [s].
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s], at least 0.
    offset : bool
        Whether d is estimated.
    whitening : (p,) array
        As of :func:`normal_matrix`.

    Returns
    -------
    tuple
        The (2+n,) theta, and the sum of squares [y unit^2].
    """
    n = len(a)
    theta = np.zeros(2 + n)
    gram, finite = normal_matrix(tu, u, before, linear, ty, y, a, h, theta, False, whitening)
    if not finite:
        return theta, np.inf
    free = np.array([i for i in range(2 + n) if offset or i != 1])
    solution, explained, regular = cholesky_solve(gram[free][:, free], gram[free, 2 + n], 1e-12)
    if not regular:
        return theta, np.inf
    for i in range(free.size):
        theta[free[i]] = solution[i]
    total = gram[2 + n, 2 + n]
    return theta, max(total - explained, 1e-15 * total)
