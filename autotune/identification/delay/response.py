"""Response of x^(n) = sum a_i x^(i) + b u(t - h) + d and its sensitivities, exact between the samples, compiled.

The input is piecewise constant or linear between its own time stamps, the output is wanted at others; the delayed
stamps t_j + h cut the time between two outputs into pieces on which the transition is a matrix exponential.

With z the response to u(t - h) from rest, e the response to the constant 1 and phi_i the free responses,
x = b_0 z + b_1 z' + .. + b_m z^(m) + d e + sum x^(i)(t_s) phi_i; without zeros, m = 0, b_0 is b. With them what belongs
to phi_i is the state of the equation whose input is u, not x^(i)(t_s). The sensitivities need one further chain s from
rest, s^(n) = sum a_i s^(i) + x: up to a free response, dx/da_i = s^(i) and dx/dh = -x'. The free responses matter to
the covariance of the initial state only.

The coefficients are passed as a tuple: its length is the order, and known to the compiler, which unrolls the loops
over the states (ten times faster than with an array). Only what has such loops is compiled for every order; the loop
over the blocks is Python's, as a compiled one would contain, and compile, all of the rest again for every order.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numba import njit
from numpy.typing import NDArray

from autotune.arrays import FloatArray
from autotune.identification.delay.compiled import cholesky_solve, transitions
from autotune.identification.delay.data import DelayData
from autotune.identification.delay.propagation import (
    BLOCK,
    begin,
    propagate,
    propagate_sensitivities,
    schedule,
)
from autotune.identification.noise_filter import Whitening, filter_rows

#: A sum of squares is what y has less what is explained, but below this share of y's, where that difference has lost
#: its digits: there the residuals are squared themselves.
_DIFFERENCE_TOLD = 1e-8


def normal_matrix(
    data: DelayData,
    a: tuple[float, ...],
    h: float,
    theta: FloatArray,
    sensitive: bool,
    whitening: Whitening,
) -> tuple[FloatArray, bool]:
    """Return the Gram matrix of the columns and, last, of what they have to explain, and whether it is finite.

    Parameters
    ----------
    data : DelayData
        N rows of y, at whose first stamp t_s the initial state stands; an input of unknown past is 0 there.
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s], at least 0.
    theta : (2+n+m,) array
        b_0, d, the initial state, b_1..b_m; without sensitivities its size counts and not its values.
    sensitive : bool
        Whether the sensitivities to a and h are wanted besides.
    whitening : Whitening
        The filter that makes the noise white. Only for uniform records.

    Returns
    -------
    gram : (c+1, c+1) array
        Columns z, e, phi_0.., z'.. against y; with sensitivities z, e, phi_0.., z'.., s.., -x' against the residual.
    finite : bool
        False where the response overflowed.

    Notes
    -----
    Time is linear in the rows; memory is one block of rows, whatever the record's length.
    """
    n, m = len(a), theta.size - 2 - len(a)
    order, moving = whitening.ar.size, whitening.ma.size
    width = 2 * n + m + 4 if sensitive else 3 + n + m
    gram = np.zeros((width, width))
    coefficients, chains, clock = begin(data.tu, data.ty, a, h, theta)
    rows = np.zeros((order + BLOCK, width))
    white = np.zeros((moving + BLOCK, width))
    for first, outputs, pieces, F, which in _blocks(data, h, coefficients, clock):
        if not propagate(a, F, which, pieces, m, chains, rows[order:]):
            return gram, False
        if sensitive:
            propagate_sensitivities(a, theta, F, which, pieces, chains, rows[order:])
        skip = max(0, min(whitening.lost - first, outputs))
        y = data.y[first : first + outputs]
        _add_rows(gram, rows, white, y, skip, whitening.ar, whitening.ma, sensitive)
    return gram, bool(np.all(np.isfinite(gram)))


def _blocks(
    data: DelayData,
    h: float,
    coefficients: FloatArray,
    clock: FloatArray,
) -> Iterator[tuple[int, int, FloatArray, FloatArray, NDArray[np.int64]]]:
    """Yield each block's first output, how many it has, its pieces, their distinct transitions, and each piece's."""
    first, before = 0, data.before or 0.0
    while first < data.ty.size:
        pieces, outputs, durations, which = schedule(data.tu, data.u, before, data.linear, data.ty, h, clock)
        yield first, outputs, pieces, transitions(coefficients, durations), which
        first += outputs


@njit(cache=True, nogil=True)
def _add_rows(
    gram: FloatArray,
    rows: FloatArray,
    white: FloatArray,
    y: FloatArray,
    skip: int,
    ar: FloatArray,
    ma: FloatArray,
    sensitive: bool,
) -> None:
    """Add a block's rows, filtered and but for those to skip, to the Gram matrix; keep what the next block filters."""
    order, moving, outputs, width = ar.size, ma.size, y.size, rows.shape[1]
    for k in range(outputs):
        rows[order + k, width - 1] = y[k] - (rows[order + k, width - 1] if sensitive else 0.0)
    if order > 0:
        filter_rows(rows[: order + outputs], ar, ma, white)
    used = white[moving + skip : moving + outputs] if order > 0 else rows[:outputs]
    gram += used.T @ used
    for i in range(order):
        for c in range(width):
            rows[i, c] = rows[outputs + i, c]
    for i in range(moving):
        for c in range(width):
            white[i, c] = white[outputs + i, c]


def output(
    data: DelayData,
    a: tuple[float, ...],
    h: float,
    theta: FloatArray,
) -> FloatArray:
    """Return x at the output times, (N,), NaN from where it overflows.

    Parameters
    ----------
    data : DelayData
        N rows of y, whose values do not count.
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s], at least 0.
    theta : (2+n+m,) array
        b_0, d, the initial state, b_1..b_m.
    """
    n = len(a)
    x = np.full(data.ty.size, np.nan)
    coefficients, chains, clock = begin(data.tu, data.ty, a, h, theta)
    rows = np.zeros((BLOCK, theta.size))
    for first, outputs, pieces, F, which in _blocks(data, h, coefficients, clock):
        if not propagate(a, F, which, pieces, theta.size - 2 - n, chains, rows):
            break
        x[first : first + outputs] = sum(rows[:outputs, c] * theta[c] for c in range(theta.size))
    return x


def sensitivities(
    data: DelayData,
    a: tuple[float, ...],
    h: float,
    theta: FloatArray,
) -> FloatArray:
    """Return the columns z, e, phi_0.., z'.., s.., -x' of :func:`normal_matrix` row by row, shape (N, 2n+m+3).

    Parameters
    ----------
    data : DelayData
        N rows of y, whose values do not count.
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s], at least 0.
    theta : (2+n+m,) array
        b_0, d, the initial state, b_1..b_m.
    """
    n, m = len(a), theta.size - 2 - len(a)
    columns = np.zeros((data.ty.size, 2 * n + m + 4))
    coefficients, chains, clock = begin(data.tu, data.ty, a, h, theta)
    for first, _, pieces, F, which in _blocks(data, h, coefficients, clock):
        if not propagate(a, F, which, pieces, m, chains, columns[first:]):
            break
        propagate_sensitivities(a, theta, F, which, pieces, chains, columns[first:])
    return columns[:, : 2 * n + m + 3]


def linear_part(
    data: DelayData,
    a: tuple[float, ...],
    h: float,
    offset: bool,
    zeros: int,
    whitening: Whitening,
) -> tuple[FloatArray, float]:
    """Return the best b, d and initial state for given (a, h), and the sum of squares; infinite where not finite.

    Parameters
    ----------
    data : DelayData
        N rows of y.
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s], at least 0.
    offset : bool
        Whether d is estimated.
    zeros : int
        m, below n.
    whitening : Whitening
        As of :func:`normal_matrix`.

    Returns
    -------
    tuple
        The (2+n+m,) theta, and the sum of squares [y unit^2].
    """
    theta = np.zeros(2 + len(a) + zeros)
    gram, finite = normal_matrix(data, a, h, theta, False, whitening)
    cost = _least_squares(gram, offset, theta) if finite else np.inf
    total = gram[-1, -1]
    if cost < _DIFFERENCE_TOLD * total:
        gram, finite = normal_matrix(data, a, h, theta, True, whitening)
        cost = max(float(gram[-1, -1]), np.finfo(float).eps ** 2 * total) if finite else np.inf
    return theta, cost


@njit(cache=True, nogil=True)
def _least_squares(gram: FloatArray, offset: bool, theta: FloatArray) -> float:
    """Write the best theta, and return its sum of squares; infinite where the columns are not told apart."""
    size = theta.size
    free = np.array([i for i in range(size) if offset or i != 1])
    solution, explained, regular = cholesky_solve(gram[free][:, free], gram[free, size], 1e-12)
    if not regular:
        return np.inf
    for i in range(free.size):
        theta[free[i]] = solution[i]
    return float(gram[size, size] - explained)
