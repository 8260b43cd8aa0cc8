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


def quantised(values: FloatArray, step: float) -> FloatArray:
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
    return quantised(u, step)


#: What may be done to the held samples of an input, by one number.
OPERATIONS: Mapping[str, Callable[[FloatArray, FloatArray, float], FloatArray]] = {
    "play": backlash,
    "stick": stiction,
    "steps": _converter,
}
