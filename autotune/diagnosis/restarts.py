"""Windows started anew: a start state that a stop or dry friction holds is not felt, and no descent brings it free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.data import Data
from autotune.diagnosis.fitting import Fit, fit, start_states

#: A window stands out whose misfit is this many times the median window's.
STANDS_OUT = 1.5
#: Share of a window on which a start state is found first: before a blow has carried its error far away.
BEGINNING = 4


def restarted(result: Fit, data: Data) -> Fit:
    """Return a fit whose windows that stand out were started anew, where it explains more.

    Parameters
    ----------
    result : Fit
        Where a descent came to rest.
    data : Data
        What it was fitted to.

    Returns
    -------
    Fit
        A fit to the same data, of no greater cost.

    Notes
    -----
    Start states are fitted to the windows' beginnings alone, from rest; from there to whole windows, all else held.
    Those that then explain their window better replace the old ones, and everything is fitted again.
    """
    before = _misfits(result)
    out = before > STANDS_OUT * np.median(before)
    if not out.any():
        return result
    p, held = result.parametrisation, np.zeros(result.theta.size, dtype=bool)
    begun = fit(p, _beginnings(data), result.theta, start_states(result.sim, data), free=held, rounds=1)
    cuts = np.cumsum([len(starts) for starts in data.starts])[:-1]

    def chosen(which: BoolArray, new: tuple[FloatArray, ...]) -> list[FloatArray]:
        return [np.where(w[:, None], a, b) for w, a, b in zip(np.split(which, cuts), new, result.x0, strict=True)]

    settled = fit(p, data, result.theta, chosen(out, begun.x0), free=held, rounds=1)
    better = out & (_misfits(settled) < before)
    if not better.any():
        return result
    again = fit(p, data, result.theta, chosen(better, settled.x0), iterations=30, inherit=result)
    return again if again.cost < result.cost else result


def _misfits(result: Fit) -> FloatArray:
    """Return every window's mean square of the whitened residual."""
    e = result.e
    return np.array([float(np.mean(e[a:b] ** 2)) for a, b in result.windows])


def _beginnings(data: Data) -> Data:
    """Return the data with the first part of every window alone."""
    stops = tuple(a + np.maximum((b - a) // BEGINNING, 1) for a, b in zip(data.starts, data.stops, strict=True))
    good = []
    for ok, starts, ends in zip(data.good, data.starts, stops, strict=True):
        edge = np.zeros(ok.size + 1, dtype=np.int64)
        np.add.at(edge, starts, 1)
        np.add.at(edge, ends, -1)
        good.append(ok & (np.cumsum(edge)[:-1] > 0))
    return replace(data, stops=stops, good=tuple(good))
