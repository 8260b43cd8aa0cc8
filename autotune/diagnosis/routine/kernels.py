"""Inner loops of the routine fit: a sticking valve, its plant's lags, and sums over windows."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from autotune.arrays import FloatArray, IntArray


@njit(cache=True)
def valve_position(
    u: FloatArray, starts: IntArray, static: float, sliding: float, runs_on: bool, begins: float
) -> FloatArray:
    """Return the position of a valve with static and sliding friction, both in the unit of u.

    It rests while ``|u - x| <= static`` and then takes ``x = u -+ sliding`` (He et al. 2007). One that runs on follows
    u further in that direction until u stops or turns (Choudhury et al. 2005: S = static + sliding, J = static -
    sliding). Equal bands are play of the width S.

    Parameters
    ----------
    u : (N,) array
        Command.
    starts : (R,) array of int
        First row of every recording in u; the valve begins anew there.
    static, sliding : float
        Bands [u], ``static >= sliding >= 0``.
    runs_on : bool
        Whether a moving valve needs to overcome the static band once only.
    begins : float
        Position in the first row less u, as a share of ``static``, -1 to 1.
    """
    x = np.empty(u.size)
    upcoming, position, before, direction = 0, 0.0, 0.0, 0.0
    for k in range(u.size):
        if upcoming < starts.size and k == starts[upcoming]:
            upcoming += 1
            position, before, direction = u[k] + begins * static, u[k], 0.0
        change = u[k] - before
        if runs_on and change * direction > 0.0:
            position = u[k] - direction * sliding
        else:
            direction = 0.0
            away = u[k] - position
            if abs(away) > static:
                direction = 1.0 if away > 0.0 else -1.0
                position = u[k] - direction * sliding
        before = u[k]
        x[k] = position
    return x


@njit(cache=True)
def lagged(x: FloatArray, starts: IntArray, keep: float) -> FloatArray:
    """Return a first-order lag of a held input, read before the row's input acts; ``keep`` is exp(-dt/T), 0 to 1."""
    y = np.empty(x.size)
    upcoming, state = 0, 0.0
    for k in range(x.size):
        if upcoming < starts.size and k == starts[upcoming]:
            upcoming += 1
            state = x[k]
        y[k] = state
        state = keep * state + (1.0 - keep) * x[k]
    return y


@njit(cache=True)
def add_lag(x: FloatArray, starts: IntArray, keep: float) -> FloatArray:
    """Return a further lag of what is already a response: trapezoidal, so that it adds no dead time."""
    y = np.empty(x.size)
    upcoming, state, before = 0, 0.0, 0.0
    for k in range(x.size):
        if upcoming < starts.size and k == starts[upcoming]:
            upcoming += 1
            state, before = x[k], x[k]
        state = keep * state + (1.0 - keep) * 0.5 * (x[k] + before)
        before = x[k]
        y[k] = state
    return y


@njit(cache=True)
def window_sums(
    x: FloatArray, y: FloatArray, basis: FloatArray, windows: IntArray, firsts: IntArray, delays: IntArray
) -> FloatArray:
    """Return sums of x x and x y over every window at every delay, free of what the window's basis can do.

    Parameters
    ----------
    x, y : (N,) array
        Response, and measurement with the basis already taken out of it (0 where it is not a number).
    basis : (B, N) array
        Orthonormal within each window, 0 on rows that do not count.
    windows : (W, 2) array of int
        First row and the row after the last.
    firsts : (W,) array of int
        First row of the recording that the window is of: before it the response is its first value.
    delays : (D,) array of int
        Rows.

    Returns
    -------
    sums : (D, W, 2) array
    """
    sums = np.empty((delays.size, windows.shape[0], 2))
    size = basis.shape[0]
    on = np.empty(size)
    for i in range(delays.size):
        for w in range(windows.shape[0]):
            xx, xy = 0.0, 0.0
            on[:] = 0.0
            first, offset = firsts[w], x[max(windows[w, 0] - delays[i], firsts[w])]
            for k in range(windows[w, 0], windows[w, 1]):
                if basis[0, k] == 0.0:
                    continue
                value = x[max(k - delays[i], first)] - offset
                xx += value * value
                xy += value * y[k]
                for b in range(size):
                    on[b] += value * basis[b, k]
            for b in range(size):
                xx -= on[b] * on[b]
            sums[i, w, 0], sums[i, w, 1] = max(xx, 0.0), xy
    return sums


def keep_of(dt_s: float, lag_s: float) -> float:
    """Return exp(-dt/T), 0 for no lag."""
    return math.exp(-dt_s / lag_s) if lag_s > 0.0 else 0.0
