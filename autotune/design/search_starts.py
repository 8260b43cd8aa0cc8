"""Where a search begins: controllers that keep the constraints, and one for each basin."""

from __future__ import annotations

import numpy as np

from autotune.arrays import FloatArray
from autotune.design.search import Problem
from autotune.design.simplex import search_by_simplex

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

        def missed(p: FloatArray) -> float:
            return -min(float(np.min(problem.norms_and_slacks(p[None, :], thin=2)[1])), _ENOUGH)

        size = int(np.sum(start > 0.0))
        vertices = 0.4 * (np.vstack((np.zeros(size), np.eye(size))) - 0.5 / size)
        reached, least = search_by_simplex(missed, start, vertices, xatol=1e-4, fatol=1e-5, maxfev=150 * size)
        if least <= 0.0:
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
