"""PID with a first-order measurement filter: the same criterion and constraints, searched from several starts.

With four gains the norm has several basins (real and complex controller zeros). Two coarse grids are looked at, one
over all gains that the specification allows and one around the best PI where there is one, and the best of the local
optima is what is returned: no proof of a global one.
"""

from __future__ import annotations

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.corners import plainest
from autotune.design.search import Problem, polish
from autotune.design.search_starts import admissible, separate
from autotune.errors import DesignError

_STARTS = 8
#: of each grid's nodes that keep nothing, so many are led towards what is asked for
_LED = 6


def best_pid(problem: Problem, pi: PIDController | None, largest: float, omega_ref: float) -> PIDController | None:
    """Return the PID with filter of the smallest norm (11) that was found, never worse than the PI; None where none is.

    Parameters
    ----------
    problem : Problem
        Plants and specification.
    pi : PIDController or None
        The best PI, which is a PID with T_d = 0; None where no PI keeps the constraints.
    largest : float
        Largest gain worth looking at.
    omega_ref : float
        Frequency [rad/s] about which the integral times lie.
    """
    grid = _everywhere(largest, omega_ref)
    if pi is not None:
        grid = np.vstack((grid, _around(pi)))
    norms, slacks = problem.norms_and_slacks(grid, thin=4)
    slack = np.min(slacks, axis=(1, 2))
    kept = slack >= 0.0
    if np.any(kept):
        nodes = separate(grid[kept][np.argsort(norms[kept])], 0.7, _STARTS)
    else:
        nodes = admissible(problem, separate(grid[np.argsort(-slack)], 0.5, _LED))
    if not len(nodes):
        return pi
    try:
        best = polish(problem, nodes)
    except DesignError:  # no PID was found between the frequencies of the grid: the PI is one with T_d = 0
        return pi
    both = [np.array((abs(c.K), c.Ti_s, c.Td_s, c.Tf_s)) for c in (pi, best) if c is not None]
    found = plainest(both, lambda p: 0.5 * float(np.log(problem.norms_and_slacks(p[None, :])[0][0])), problem.kept)
    return problem.controller(found)


def _everywhere(largest: float, omega_ref: float) -> FloatArray:
    # with a filter the gain that noise sees is K T_d/T_f, so that K itself may be far below what is allowed
    return _mesh(
        largest * np.geomspace(1e-4, 1.0, 15),
        np.geomspace(0.05, 100.0, 12) / omega_ref,
        np.geomspace(0.03, 4.0, 7),
        np.array([0.5, 1.0, 2.0, 5.0, 12.0, 30.0]),
    )


def _around(pi: PIDController) -> FloatArray:
    return _mesh(
        abs(pi.K) * np.geomspace(0.05, 8.0, 12),
        pi.Ti_s * np.geomspace(0.1, 3.0, 9),
        np.geomspace(0.03, 1.5, 9),
        np.array([0.5, 1.0, 2.0, 5.0, 12.0, 30.0]),
    )


def _mesh(K: FloatArray, Ti: FloatArray, share: FloatArray, ratio: FloatArray) -> FloatArray:
    """Return the (M, 4) controllers of all gains, integral times, T_d/T_I and T_d/T_f."""
    mesh = np.stack([axis.ravel() for axis in np.meshgrid(K, Ti, share, ratio, indexing="ij")], axis=1)
    return np.stack((mesh[:, 0], mesh[:, 1], mesh[:, 1] * mesh[:, 2], mesh[:, 1] * mesh[:, 2] / mesh[:, 3]), axis=1)
