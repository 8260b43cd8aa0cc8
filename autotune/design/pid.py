"""PID with a first-order measurement filter: the same criterion and constraints, searched from several starts.

There is no certificate here: with four gains the norm has several basins (real and complex controller zeros), and the
best of the local optima is what is returned.
"""

from __future__ import annotations

import numpy as np

from autotune.controller import PIDController
from autotune.design.kernels import SampledPlant
from autotune.design.search import evaluate_on, evaluated_slacks, polished
from autotune.design.specification import Specification
from autotune.errors import DesignError
from autotune.models import TransferFunction

_STARTS = 6


def best_pid(
    H: TransferFunction, sampled: SampledPlant, specification: Specification, pi: PIDController
) -> PIDController:
    """Return the PID with filter of the smallest norm (11) that was found, never worse than the PI.

    Parameters
    ----------
    H : TransferFunction
        The plant.
    sampled : SampledPlant
        The same on its grid.
    specification : Specification
        Constraints (18); the noise bound (16) counts abs(K) max(1, T_d/T_f).
    pi : PIDController
        The best PI, around which the coarse grid lies.

    Raises
    ------
    DesignError
        No node of the coarse grid meets the specification.
    """
    K = abs(pi.K) * np.geomspace(0.05, 8.0, 12)
    Ti = pi.Ti_s * np.geomspace(0.1, 3.0, 9)
    Td_share = np.geomspace(0.03, 1.5, 9)
    ratio = np.array([0.5, 1.0, 2.0, 5.0, 12.0, 30.0])
    mesh = np.stack([axis.ravel() for axis in np.meshgrid(K, Ti, Td_share, ratio, indexing="ij")], axis=1)
    grid = np.stack((mesh[:, 0], mesh[:, 1], mesh[:, 1] * mesh[:, 2], mesh[:, 1] * mesh[:, 2] / mesh[:, 3]), axis=1)
    figures = evaluate_on(sampled.thinned(4), grid, specification)
    feasible = np.min(evaluated_slacks(figures, grid, specification), axis=1) >= 0.0
    if not np.any(feasible):
        raise DesignError("no PID on the coarse grid meets the specification", where="synthesis", remedy="use kind pi")
    nodes = grid[feasible][np.argsort(figures[feasible, 0])]
    starts = [nodes[0]]
    for node in nodes[1:]:
        if all(np.max(np.abs(np.log(node / other))) > 0.9 for other in starts):
            starts.append(node)
        if len(starts) == _STARTS:
            break
    best = polished(H, sampled, specification, np.array(starts))
    both = np.array([(abs(c.K), c.Ti_s, c.Td_s, c.Tf_s) for c in (pi, best)])
    norms = evaluate_on(sampled, both, specification)[:, 0]
    return pi if norms[0] <= norms[1] else best
