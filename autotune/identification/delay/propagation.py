"""Compiled propagation of a delayed linear response and its sensitivities, piece by piece of a held or linear input."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from autotune.arrays import FloatArray

_OVERFLOW = 1e100
_NEGLIGIBLE = 1e-150
_RESOLUTION = 1e-13  # of the time: durations that differ by less are rounding's
BLOCK = 2048  # pieces that are carried at once


def begin(
    tu: FloatArray, ty: FloatArray, a: tuple[float, ...], h: float, theta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a_0.., chains (columns z, e, phi_0.., s, x, r, z; rows the derivatives) and clock at the first output.

    Parameters
    ----------
    tu : (M,) array
        Stamps of the input [s].
    ty : (N,) array
        Output times [s].
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s].
    theta : (2+n+m,) array
        b_0, d, the initial state, b_1..b_m.
    """
    n = len(a)
    chains = np.zeros((n, n + 6))
    np.fill_diagonal(chains[:, 2:], 1.0)
    chains[:, 3 + n] = theta[2 : 2 + n]
    return np.array(a), chains, np.array([ty[0], np.searchsorted(tu, ty[0] - h, side="right") - 1, 0.0])


@njit(cache=True, nogil=True)
def schedule(
    tu: FloatArray,
    u: FloatArray,
    before: float,
    linear: bool,
    ty: FloatArray,
    h: float,
    clock: FloatArray,
) -> tuple[FloatArray, int, FloatArray, NDArray[np.int64]]:
    """Cut the time from the clock on into pieces, up to a block of them.

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
    h : float
        Delay [s].
    clock : (3,) array
        Time [s], row of the delayed input, next output; moves on in place.

    Returns
    -------
    pieces : (BLOCK, 4) array
        Duration, input and its slope at the piece's beginning, and 1 where an output stands at its end.
    outputs : int
        How many outputs stand in the block.
    durations : (distinct,) array
        The distinct durations [s].
    which : (count,) array
        Which of them each piece has; as many pieces as there are count.
    """
    pieces = np.empty((BLOCK, 4))
    now = clock[0]
    j = int(clock[1])
    k = int(clock[2])
    first = k
    count = 0
    while k < ty.size and count < BLOCK:
        until = ty[k]
        # a command that is held at the value it has does not cut the time: steps and relays leave one piece per output
        while not linear and j + 1 < tu.size and tu[j + 1] + h < until and u[j + 1] == (u[j] if j >= 0 else before):
            j += 1
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
    durations, which = _distinct(pieces, count, _RESOLUTION * abs(now))
    return pieces, k - first, durations, which


@njit(cache=True, nogil=True)
def _distinct(pieces: FloatArray, count: int, resolution: float) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the distinct durations among the pieces, and which of them each piece has."""
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
    return known[:found], which


@njit(cache=True, nogil=True)
def propagate(
    a: tuple[float, ...],
    F: FloatArray,
    which: NDArray[np.int64],
    pieces: FloatArray,
    zeros: int,
    carried: FloatArray,
    out: FloatArray,
) -> bool:
    """Carry z, e and phi over the pieces, write them and z'.. at the outputs, and say whether they stayed finite.

    Parameters
    ----------
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    F : (distinct, n, 2n+4) array
        Transitions over the distinct durations.
    which : (count,) array
        From :func:`schedule`.
    pieces : (BLOCK, 4) array
        From :func:`schedule`.
    zeros : int
        m: as many derivatives of z are written behind phi.
    carried : (n, n+6) array
        The chains, changed in place.
    out : (outputs or more, 2+n+m or more) array
        Takes the columns.
    """
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
            for j in range(zeros):
                out[k, 2 + n + j] = chains[j + 1, 0]
            k += 1
    for i in range(n):
        for c in range(n + 2):
            # arithmetic on subnormal numbers, to which free responses decay, is ten times slower
            carried[i, c] = chains[i, c] if abs(chains[i, c]) > _NEGLIGIBLE else 0.0
    return bool(abs(chains[0, 0]) + abs(chains[0, 1 + n]) < _OVERFLOW)


@njit(cache=True, nogil=True)
def propagate_sensitivities(
    a: tuple[float, ...],
    theta: FloatArray,
    F: FloatArray,
    which: NDArray[np.int64],
    pieces: FloatArray,
    carried: FloatArray,
    out: FloatArray,
) -> None:
    """Carry x and s over the pieces and write s..s^(n-1), -y' and y at the outputs, into the last columns.

    With zeros, y = x + b_1 z' + .. + b_m z^(m), where x is the response to b_0 u + d; z is from rest, of b = 1, and r
    is driven by z as s is by x: what y drives is s + b_1 r' + .. + b_m r^(m).

    Parameters
    ----------
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    theta : (2+n+m,) array
        b_0, d, the initial state, b_1..b_m.
    F : (distinct, n, 2n+4) array
        Transitions over the distinct durations.
    which : (count,) array
        From :func:`schedule`.
    pieces : (BLOCK, 4) array
        From :func:`schedule`.
    carried : (n, n+6) array
        The chains, of which s, x, r and the last z are changed in place.
    out : (outputs or more, 2n+4+m) array
        Takes the columns.
    """
    n = len(a)
    m = theta.size - 2 - n
    state = np.empty((4, n))  # x, s, z, r
    new = np.empty((4, n))
    more = np.empty((2, 2 * n))  # z and r with their higher derivatives
    for i in range(n):
        state[0, i] = carried[i, n + 3]
        state[1, i] = carried[i, n + 2]
        state[2, i] = carried[i, n + 5]
        state[3, i] = carried[i, n + 4]
    b = theta[0]
    d = theta[1]
    k = 0
    for p in range(which.size):
        f = which[p]
        w = pieces[p, 1]
        v = pieces[p, 2]
        for h in range(2 if m > 0 else 1):
            drive = w if h > 0 else b * w + d
            slope = v if h > 0 else b * v
            for i in range(n):
                new[2 * h, i] = F[f, i, 2 * n + 2] * drive + F[f, i, 2 * n + 3] * slope
                new[2 * h + 1, i] = F[f, i, 2 * n] * drive + F[f, i, 2 * n + 1] * slope
                for j in range(n):
                    new[2 * h, i] += F[f, i, j] * state[2 * h, j]
                    new[2 * h + 1, i] += F[f, i, j] * state[2 * h + 1, j] + F[f, i, n + j] * state[2 * h, j]
            for i in range(n):
                state[2 * h, i] = new[2 * h, i]
                state[2 * h + 1, i] = new[2 * h + 1, i]
        if pieces[p, 3] > 0.0:
            end = w + v * pieces[p, 0]
            for i in range(n):
                out[k, 2 + n + m + i] = state[1, i]
            turned = state[0, 1] if n > 1 else a[0] * state[0, 0] + b * end + d
            y = state[0, 0]
            if m > 0:
                for i in range(n):
                    more[0, i] = state[2, i]
                    more[1, i] = state[3, i]
                more[0, n] = end
                for j in range(n):
                    more[0, n] += a[j] * more[0, j]
                for i in range(m):
                    more[1, n + i] = more[0, i]
                    for j in range(n):
                        more[1, n + i] += a[j] * more[1, i + j]
                for j in range(1, m + 1):
                    c = theta[1 + n + j]
                    y += c * more[0, j]
                    turned += c * more[0, j + 1]
                    for i in range(n):
                        out[k, 2 + n + m + i] += c * more[1, i + j]
            out[k, 2 + 2 * n + m] = -turned
            out[k, 3 + 2 * n + m] = y
            k += 1
    for i in range(n):
        carried[i, n + 3] = state[0, i]
        carried[i, n + 2] = state[1, i]
        carried[i, n + 4] = state[3, i]
        carried[i, n + 5] = state[2, i]
