"""Where searches in log gains do not arrive: a PI in a corner of its constraints, and a PID that is a PI."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from autotune.arrays import FloatArray

if TYPE_CHECKING:
    from autotune.design.search import Problem

#: the grid about the best PI: nodes each way, first and last half-width in log gains, most grids
_ZOOM_NODES, _ZOOM_SPAN, _ZOOM_END, _ZOOMS = 9, 0.3, 1e-5, 60
#: relative decrease of the squared norm that is worth another controller
_WORTHWHILE = 1e-4
#: slacks that are asked for on the grid of frequencies so that the margins are kept between them
_SLIGHTLY_TIGHTER = (1e-5, 1e-4, 1e-3)
#: share of the norm that a derivative buys at least
_NO_DERIVATIVE = 1e-4


def out_of_corner(problem: Problem, start: FloatArray) -> FloatArray:
    """Return the best PI near one that keeps the constraints exactly, at least as good as it.

    Parameters
    ----------
    problem : Problem
        Plants and specification.
    start : (4,) array
        K, T_I, 0, 0, which keep the constraints.

    Notes
    -----
    The modulus margin is the least of several dips of abs(1 + L): where two of them are as deep, sequential quadratic
    programming sees the gradient of one at a time and stops. A grid that follows the best controller and shrinks about
    it needs no gradient. What it keeps it keeps on the grid of frequencies, with as much more as the exact margins ask.
    """
    enough = float(problem.norms_and_slacks(start[None, :])[0][0]) * (1.0 - _WORTHWHILE)
    for more in (0.0, *_SLIGHTLY_TIGHTER):
        squared, found = _search_on_grids(problem, start, more)
        if squared > enough:
            break
        if problem.kept(found):
            return found
    return start


def _search_on_grids(problem: Problem, start: FloatArray, more: float) -> tuple[float, FloatArray]:
    """Return squared norm and gains of the best PI that shrinking grids find whose slacks are at least ``more``."""
    free = start > 0.0
    steps = np.linspace(-1.0, 1.0, _ZOOM_NODES)
    # in log K and log K/T_I, by which the norm goes
    mesh = np.array([(K, K - k) for K in steps for k in steps])
    best, span, least = start, _ZOOM_SPAN, math.inf
    for _ in range(_ZOOMS):
        nodes = np.tile(best, (len(mesh), 1))
        nodes[:, free] = best[free] * np.exp(span * mesh)
        squared, slacks = problem.norms_and_slacks(nodes)
        squared[np.min(slacks, axis=(1, 2)) < more] = math.inf
        at = int(np.argmin(squared))
        if squared[at] < least * (1.0 - 1e-9):
            best, least = nodes[at], float(squared[at])
        else:
            span *= 0.3
        if span < _ZOOM_END:
            break
    return least, best


def plainest(
    found: Sequence[FloatArray], log_norm: Callable[[FloatArray], float], kept: Callable[[FloatArray], bool]
) -> FloatArray:
    """Return the (4,) controller of least norm, without a derivative where that buys less than a ten-thousandth.

    A search in logarithms of the gains comes as near to a PI as it has steps: its T_d of 1e-30 s says nothing, and no
    device holds it.

    Parameters
    ----------
    found : sequence of (4,) array
        Controllers (K, T_I, T_d, T_f) that keep the constraints, times in s.
    log_norm : callable
        Logarithm of a (4,) controller's norm.
    kept : callable
        Whether a (4,) controller keeps the constraints.
    """
    cut = [p * np.array([1.0, 1.0, 0.0, 0.0]) for p in found]
    plain = [p for p in cut if kept(p)]
    best = min(found, key=log_norm)
    without = min(plain, key=log_norm, default=best)
    return without if log_norm(without) <= log_norm(best) + _NO_DERIVATIVE else best
