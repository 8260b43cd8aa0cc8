"""On what scale the parameters of a model are sought: in units of the prior's spread, most of them logarithmic.

A parameter with a nonzero value keeps its sign: ``p = value exp(spread z)`` with z standard normal, and in a straight
line towards nothing where it comes below ``value / e``.
"""

from __future__ import annotations

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.equations.simulate import Compiled

#: Part of a third of a value below which the straight scale is exponential again.
LAST_SHARE = 0.02


def values_of(compiled: Compiled, z: FloatArray) -> FloatArray:
    """Return the parameters at distances z from their nominal values, in prior standard deviations.

    Parameters
    ----------
    compiled : Compiled
        P parameters.
    z : (P,) array
        The distances.

    Returns
    -------
    (P,) array
        Values in their own units.
    """
    value, spread = compiled.parameter_vector, np.array([p.spread for p in compiled.parameters])
    scaled = value * _factors(spread * z)[0]
    least = np.array([p.least for p in compiled.parameters])
    scaled = np.where(np.abs(scaled) < least, np.copysign(least, value), scaled)
    moved = np.where(linear(compiled), value + spread * z, scaled)
    return np.asarray(np.where(spread > 0.0, moved, value), dtype=np.float64)


def slopes_of(compiled: Compiled, z: FloatArray) -> FloatArray:
    """Return how fast the parameters change with their distances z.

    Parameters
    ----------
    compiled : Compiled
        P parameters.
    z : (P,) array
        The distances.

    Returns
    -------
    (P,) array
        Derivatives, in the parameters' units.
    """
    value, spread = compiled.parameter_vector, np.array([p.spread for p in compiled.parameters])
    return np.asarray(np.where(linear(compiled), spread, value * spread * _factors(spread * z)[1]))


def linear(compiled: Compiled) -> BoolArray:
    """Return which parameters are sought on a linear scale."""
    return np.array([p.linear or p.value == 0.0 for p in compiled.parameters], dtype=bool)


def _factors(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return by what values are multiplied at a distance x on the logarithmic scale, and how fast that changes.

    Below 1/e the scale goes on in a straight line, so that a number whose part an effect takes comes to nothing at a
    finite distance from what is believed of it; the last 2 % are exponential again: it keeps its sign.
    """
    least, foot = LAST_SHARE, LAST_SHARE - 2.0
    grown = np.exp(np.clip(x, -1.0, 50.0))
    last = np.exp(np.clip((x - foot) / least, -50.0, 0.0))
    straight = x < -1.0
    factor = np.where(straight, np.where(x < foot, least * last, 2.0 + x) / np.e, grown)
    slope = np.where(straight, np.where(x < foot, last, 1.0) / np.e, grown)
    return factor, slope
