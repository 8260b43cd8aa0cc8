"""A simplex search over those gains of a controller that are free, in their logarithms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import minimize

from autotune.arrays import FloatArray


def search_by_simplex(
    cost: Callable[[FloatArray], float], start: FloatArray, vertices: FloatArray, **options: Any
) -> tuple[FloatArray, float]:
    """Return the (4,) gains that a simplex comes to by Nelder and Mead's rules, and their cost.

    Parameters
    ----------
    cost : callable
        Of (4,) gains K, T_I, T_d, T_f.
    start : (4,) array
        Gains that the vertices are counted from; those that are 0 stay so.
    vertices : (F + 1, F) array
        Where it begins, as logarithms of factors of the F gains that do not.
    **options : object
        Of scipy's Nelder-Mead: when it ends.
    """

    def moved(x: FloatArray) -> FloatArray:
        p = start.copy()
        p[start > 0.0] *= np.exp(x)
        return p

    def cost_of(x: FloatArray) -> float:
        return cost(moved(x))

    begin: FloatArray = vertices[0]
    ends: Any = {"initial_simplex": vertices, **options}
    result = minimize(cost_of, begin, method="Nelder-Mead", options=ends)
    return moved(result.x), float(result.fun)
