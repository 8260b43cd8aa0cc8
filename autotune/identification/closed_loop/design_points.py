"""As many points of an identified response as the model has numbers, where a controller needs them."""

from __future__ import annotations

import math

import numpy as np

from autotune.arrays import FloatArray
from autotune.identification.closed_loop.loop_excitation import critical_frequency
from autotune.identification.closed_loop.structures import Structures
from autotune.points import FrequencyPoint

#: Band of the points, as multiples of the frequency at which the plant's phase has fallen to -135 degrees.
_LOWEST, _HIGHEST = 1.0 / 3.0, 2.0
#: Fewest points that a reduction can work with.
_FEWEST = 3


def design_points(found: Structures, grid_rad_s: FloatArray) -> tuple[FrequencyPoint, ...]:
    """Return points of the plant that may be joined with measured ones and given to a design.

    Parameters
    ----------
    found : Structures
        The chosen model, and those that the record leaves open beside it.
    grid_rad_s : (W,) array
        Ascending frequencies that the recording can speak of [rad/s].

    Returns
    -------
    tuple of FrequencyPoint
        n points for n states, at least three, the command's hold taken out, evenly spread in log frequency from a third
        to twice the frequency at which the plant's phase is -135 degrees; those known to less than 50 % are left out.

    Notes
    -----
    A design takes points as independent. A model with 2 n numbers has a response that n complex values fix; more points
    of it would count the same data again. Among these few, errors still are correlated, which each region leaves out.
    """
    estimate = found.chosen
    grid = np.asarray(grid_rad_s, dtype=np.float64)
    critical, _ = critical_frequency(grid, estimate.model.response(grid)[:, 0, 0], None)
    low = max(_LOWEST * critical, float(grid[0]))
    high = min(_HIGHEST * critical, float(grid[-1]), 0.49 * math.pi / estimate.model.sample_time_s)
    omega = np.geomspace(low, high, max(_FEWEST, estimate.model.order))
    return found.points(omega)[1]
