"""Where a search begins: controllers that keep the constraints, and one for each basin."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from autotune.arrays import BoolArray, FloatArray
from autotune.design.search import Problem

_ENOUGH = 0.01  # slack with which a controller counts as well inside


def admissible(problem: Problem, starts: FloatArray) -> FloatArray:
    """Return those (K, 4) controllers that a simplex, which raises the least slack, led to where all constraints hold.

    Parameters
    ----------
    problem : Problem
        Plants and constraints.
    starts : (S, 4) array
        Controllers that keep not all constraints, the most promising first; parameters with value 0 stay 0.
    """
    found = []
    for start in starts:
        free = start > 0.0

        def missed(x: FloatArray, start: FloatArray = start, free: BoolArray = free) -> float:
            p = start.copy()
            p[free] = start[free] * np.exp(x)
            return -min(float(np.min(problem.norms_and_slacks(p[None, :], thin=2)[1])), _ENOUGH)

        size = int(np.sum(free))
        simplex = 0.4 * (np.vstack((np.zeros(size), np.eye(size))) - 0.5 / size)
        result = minimize(
            missed,
            np.zeros(size),
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-5, "maxfev": 150 * size},
        )
        if result.fun <= 0.0:
            reached = start.copy()
            reached[free] = start[free] * np.exp(result.x)
            found.append(reached)
    return np.array(found).reshape(-1, 4)


def separate(nodes: FloatArray, distance: float, most: int) -> FloatArray:
    """Return the first of the (M, 4) controllers and those after it that are no neighbours: a start for each basin.

    Parameters
    ----------
    nodes : (M, 4) array
        Controllers, the best first.
    distance : float
        Largest difference of a logarithm within which two are neighbours.
    most : int
        How many are returned at most.
    """
    kept: list[FloatArray] = []
    for node in nodes:
        free = node > 0.0
        if all(np.max(np.abs(np.log(node[free] / other[free]))) > distance for other in kept):
            kept.append(node)
        if len(kept) == most:
            break
    return np.array(kept)
