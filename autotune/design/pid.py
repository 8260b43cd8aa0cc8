"""PID with a first-order measurement filter: the same criterion and constraints, searched from several starts.

There is no certificate here: with four gains the norm has several basins (real and complex controller zeros), and the
best of the local optima is what is returned.
"""

from __future__ import annotations

import numpy as np

from autotune.controller import PIDController
from autotune.design.search import Problem, polished, separate
from autotune.errors import DesignError

_STARTS = 6


def best_pid(problem: Problem, pi: PIDController) -> PIDController:
    """Return the PID with filter of the smallest norm (11) that was found, never worse than the PI.

    Parameters
    ----------
    problem : Problem
        Plants and specification.
    pi : PIDController
        The best PI, around which the coarse grid lies.
    """
    K = abs(pi.K) * np.geomspace(0.05, 8.0, 12)
    Ti = pi.Ti_s * np.geomspace(0.1, 3.0, 9)
    Td_share = np.geomspace(0.03, 1.5, 9)
    ratio = np.array([0.5, 1.0, 2.0, 5.0, 12.0, 30.0])
    mesh = np.stack([axis.ravel() for axis in np.meshgrid(K, Ti, Td_share, ratio, indexing="ij")], axis=1)
    grid = np.stack((mesh[:, 0], mesh[:, 1], mesh[:, 1] * mesh[:, 2], mesh[:, 1] * mesh[:, 2] / mesh[:, 3]), axis=1)
    norms, slacks = problem.norms_and_slacks(grid, thin=4)
    feasible = np.min(slacks, axis=(1, 2)) >= 0.0
    if not np.any(feasible):
        return pi
    nodes = grid[feasible][np.argsort(norms[feasible])]
    try:
        best = polished(problem, separate(nodes, 0.9, _STARTS))
    except DesignError:  # no PID was found between the frequencies of the grid: the PI is one with T_d = 0
        return pi
    both = np.array([(abs(c.K), c.Ti_s, c.Td_s, c.Tf_s) for c in (pi, best)])
    norms, _ = problem.norms_and_slacks(both)
    return pi if norms[0] <= norms[1] else best
