"""Ways out of where no descent leads: start states that a stop holds, a converter's lattice a little off its levels."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.data import Data
from autotune.diagnosis.fitting import Fit, fit, residual_at, start_states
from autotune.diagnosis.parameters import Parametrisation

#: A window stands out whose misfit is this many times the median window's.
STANDS_OUT = 1.5
#: Share of a window on which a start state is found first: before a blow has carried its error far away.
BEGINNING = 4
#: How far a lattice is moved at first: its step as a share of what takes it a level off across u's span, its origin as
#: a share of the step; how often these are halved.
LATTICE_MOVES, HALVINGS = (0.5, 0.1), 5
CONVERTER = "actuator.quantisation"
#: Decrease of the cost from which on a moved lattice or renewed start states are taken, and tried again from there.
LEAST_GAIN = 10.0
#: How often start states are found anew at most.
RENEWALS = 3


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
    out = np.concatenate(standing_out(result))
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


def renewed(result: Fit, data: Data) -> Fit:
    """Return a fit whose start states were all found anew from rest, where that explains more.

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
    Where dry friction held the plant while the numbers were still wrong, start states stay behind and hold the numbers
    back in turn: a little everywhere, so that no window stands out.
    """
    p, held = result.parametrisation, np.zeros(result.theta.size, dtype=bool)
    for _ in range(RENEWALS):
        begun = fit(p, data, result.theta, free=held, iterations=30)
        again = fit(p, data, begun.theta, begun.x0, iterations=30, rounds=4)
        if again.cost > result.cost - LEAST_GAIN:
            break
        result = again
    return result


def standing_out(result: Fit) -> list[BoolArray]:
    """Return which windows of every recording a fit explains far worse than the median window."""
    misfits = _misfits(result)
    cuts = np.cumsum([len(starts) for starts in result.starts])[:-1]
    return np.split(misfits > STANDS_OUT * np.median(misfits), cuts)


def realigned(result: Fit, data: Data) -> Fit:
    """Return a fit whose converter has its lattice moved to where the levels are, where that explains more.

    Parameters
    ----------
    result : Fit
        Where a descent came to rest.
    data : Data
        What it was fitted to.

    Returns
    -------
    Fit
        A fit to the same data, of no greater cost; the same one where its model has no converter.

    Notes
    -----
    Every point of u that a move takes to another level jumps: the criterion is a narrow well that derivatives do not
    show. Steps and origins around are tried, all other numbers and the start states following to first order.
    """
    names = [e.name for e in result.parametrisation.model.effects]
    if CONVERTER not in names:
        return result
    index = [f.name for f in result.parametrisation.free].index(f"{CONVERTER}.step")
    span = max(float(np.ptp(r.u)) for r in data.recordings)

    def moved(step: float, origin: float) -> tuple[float, Parametrisation, FloatArray]:
        p, theta = _with_origin(result.parametrisation, names.index(CONVERTER), origin), result.theta.copy()
        theta[index] = np.log(step)
        left = result.without_numbers(result.without_states(residual_at(p, data, theta, result.x0)))
        return float(left @ left), p, theta

    q = result.model.effects[names.index(CONVERTER)].parameters
    at = q["step"].value, q["origin"].value
    before = best = moved(*at)
    wide, turn = LATTICE_MOVES
    for _ in range(HALVINGS):
        step, origin = at
        for i, k in ((i, k) for i in (-1, 0, 1) for k in (-1, 0, 1) if i or k):
            there = step * (1.0 + i * wide * step / max(span, step)), origin + k * turn * step
            tried = moved(*there)
            if tried[0] < best[0]:
                best, at = tried, there
        wide, turn = 0.5 * wide, 0.5 * turn
    if best is before:
        return result
    again = fit(best[1], data, best[2], result.x0, iterations=30, inherit=result)
    return realigned(again, data) if again.cost < result.cost - LEAST_GAIN else result


def _with_origin(p: Parametrisation, number: int, origin: float) -> Parametrisation:
    effects = list(p.model.effects)
    q = effects[number].parameters
    there = MappingProxyType({**q, "origin": replace(q["origin"], value=origin)})
    effects[number] = replace(effects[number], parameters=there)
    return replace(p, model=replace(p.model, effects=tuple(effects)))


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
