"""Effects on samples: what a held command becomes on its way, what a converter makes of readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numba import njit

from autotune.arrays import FloatArray


@njit(cache=True)
def backlash(t: FloatArray, u: FloatArray, width: float) -> FloatArray:
    """Return what follows u with a play of a width.

    Parameters
    ----------
    t : (N,) array
        Time stamps [s]; not used.
    u : (N,) array
        Command.
    width : float
        Of the play [u unit].

    Returns
    -------
    (N,) array
        The far side.
    """
    w = np.empty_like(u)
    now = u[0]
    for k in range(u.size):
        now = min(max(now, u[k] - 0.5 * width), u[k] + 0.5 * width)
        w[k] = now
    return w


@njit(cache=True)
def stiction(t: FloatArray, u: FloatArray, band: float) -> FloatArray:
    """Return what stays until u is further away than a band, and then jumps to u.

    Parameters
    ----------
    t : (N,) array
        Time stamps [s]; not used.
    u : (N,) array
        Command.
    band : float
        The band [u unit].

    Returns
    -------
    (N,) array
        The position.
    """
    w = np.empty_like(u)
    now = u[0]
    for k in range(u.size):
        if abs(u[k] - now) > band:
            now = u[k]
        w[k] = now
    return w


@njit(cache=True)
def lag_signal(t: FloatArray, u: FloatArray, time_constant_s: float, straight: bool) -> FloatArray:
    """Return what follows u behind a lag, exact at the rows, at rest before the first one.

    Parameters
    ----------
    t, u : (N,) arrays
        Time stamps [s], and the signal.
    time_constant_s : float
        Of the lag [s], positive.
    straight : bool
        Whether u runs straight from row to row, or is held.
    """
    w = np.empty_like(u)
    w[0] = u[0]
    for k in range(u.size - 1):
        step = t[k + 1] - t[k]
        kept = np.exp(-step / time_constant_s)
        w[k + 1] = kept * w[k] + (1.0 - kept) * u[k]
        if straight and step > 0.0:
            w[k + 1] += (u[k + 1] - u[k]) * (1.0 - time_constant_s / step * (1.0 - kept))
    return w


def quantise(values: FloatArray, step: float) -> FloatArray:
    """Return values on a converter's steps; a step of 0 leaves them.

    Parameters
    ----------
    values : (N,) array
        Values.
    step : float
        In their unit.

    Returns
    -------
    (N,) array
        The levels.
    """
    return step * np.floor(values / step + 0.5) if step > 0.0 else values


def _converter(t: FloatArray, u: FloatArray, step: float) -> FloatArray:
    return quantise(u, step)


#: What may be done to the held samples of an input, by one number.
OPERATIONS: Mapping[str, Callable[[FloatArray, FloatArray, float], FloatArray]] = {
    "play": backlash,
    "stick": stiction,
    "steps": _converter,
}
