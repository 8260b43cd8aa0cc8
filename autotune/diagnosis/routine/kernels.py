"""Inner loops of the valve test: a sticking valve, and the half cycles of its command."""

from __future__ import annotations

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
def half_cycles(u: FloatArray, width: float) -> IntArray:
    """Return the number of the half cycle of every row, (N,) array; a turn by more than a width begins a new one.

    Parameters
    ----------
    u : (N,) array
        Command.
    width : float
        Turns by less are none [u].
    """
    number = np.zeros(u.size, dtype=np.int64)
    direction, low, high, turned, count = 0, 0, 0, 0, 0
    for k in range(u.size):
        if u[k] > u[high]:
            high = k
        if u[k] < u[low]:
            low = k
        fell, rose = direction >= 0 and u[high] - u[k] > width, direction <= 0 and u[k] - u[low] > width
        if fell or rose:
            if direction != 0:
                number[turned : high if fell else low] = count
                turned, count = high if fell else low, count + 1
            direction = -1 if fell else 1
            if fell:
                low = k
            else:
                high = k
    number[turned:] = count
    return number
