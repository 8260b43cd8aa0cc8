"""Restarts from where no descent leads: start states that a stop holds, a converter's levels a little off."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit, fit, residual_at, start_states
from autotune.diagnosis.fitting.parameters import Parametrisation
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of
from autotune.effects.base import EffectKind
from autotune.effects.stages import Values

#: Share of a window on which a start state is found first: before an impact has carried its error far away.
BEGINNING = 4
#: How far effects are moved at first: for a converter its step as a share of what takes it a level off across u's span,
#: its origin as a share of the step; how often these are halved.
MOVES, HALVINGS = (0.5, 0.1), 5
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
    before = _mean_squares(result)
    out = np.concatenate(standing_out(result, data.thresholds.stands_out)) > 0.0
    if not out.any():
        return result
    p, held = result.parametrisation, np.zeros(result.theta.size, dtype=bool)
    begun = fit(p, _beginnings(data), result.theta, start_states(result.sim, data), free=held, rounds=1)
    cuts = np.cumsum([len(starts) for starts in data.starts])[:-1]

    def chosen(which: BoolArray, new: tuple[FloatArray, ...]) -> list[FloatArray]:
        return [np.where(w[:, None], a, b) for w, a, b in zip(np.split(which, cuts), new, result.x0, strict=True)]

    settled = fit(p, data, result.theta, chosen(out, begun.x0), free=held, rounds=1)
    better = out & (_mean_squares(settled) < before)
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
        if again.cost > result.cost - data.thresholds.restart_decrease:
            break
        result = again
    return result


def standing_out(result: Fit, times: float = Thresholds.stands_out) -> list[FloatArray]:
    """Return the mean squares of windows that a fit explains far worse than the median window; 0 for the others."""
    sizes = _mean_squares(result)
    cuts = np.cumsum([len(starts) for starts in result.starts])[:-1]
    return np.split(np.where(sizes > times * np.median(sizes), sizes, 0.0), cuts)


def realigned(result: Fit, data: Data) -> Fit:
    """Return a fit whose effects were moved to where no derivative leads, where that explains more.

    Parameters
    ----------
    result : Fit
        Where a descent came to rest.
    data : Data
        What it was fitted to.

    Returns
    -------
    Fit
        A fit to the same data, of no greater cost; the same one where no effect of its model has such moves.

    Notes
    -----
    Every point of u that a converter's step takes to another level jumps: the criterion is a narrow well that
    derivatives do not show. Steps and origins around are tried, all other numbers and the start states following to
    first order.
    """
    moved = next((e for e in result.parametrisation.model.effects if kind_of(e.name).moves is not None), None)
    if moved is None:
        return result
    number = result.parametrisation.model.effects.index(moved)
    kind, span = kind_of(moved.name), max(float(np.ptp(r.u)) for r in data.driving)
    at: Values = {key: q.value for key, q in result.model.effects[number].parameters.items()}
    before = best = _moved(result, data, kind, number, at)
    wide, turn = MOVES
    for _ in range(HALVINGS):
        for there in kind.moves(at, span, wide, turn) if kind.moves is not None else ():
            tried = _moved(result, data, kind, number, there)
            if tried.cost < best.cost:
                best = tried
        at, wide, turn = best.values, 0.5 * wide, 0.5 * turn
    if best is before:
        return result
    again = fit(best.parametrisation, data, best.theta, result.x0, iterations=30, inherit=result)
    return realigned(again, data) if again.cost < result.cost - data.thresholds.restart_decrease else result


@dataclass(frozen=True, kw_only=True, eq=False)
class _Moved:
    """A point around a fit, all other numbers and the start states following to first order."""

    values: Values
    parametrisation: Parametrisation
    theta: FloatArray
    cost: float


def _moved(result: Fit, data: Data, kind: EffectKind, number: int, values: Values) -> _Moved:
    """Return what a fit leaves with an effect's parameters moved."""
    p, theta = result.parametrisation, result.theta.copy()
    effects = list(p.model.effects)
    parameters = dict(effects[number].parameters)
    for key in parameters:
        q = kind.quantity(key)
        if q is None or key not in values:
            continue
        if q.is_fitted:
            index = [f.name for f in p.free].index(f"{kind.name}.{key}")
            theta[index] = np.log(values[key]) if p.free[index].positive else values[key] / p.free[index].size
        else:
            parameters[key] = replace(parameters[key], value=values[key])
    effects[number] = replace(effects[number], parameters=MappingProxyType(parameters))
    p = replace(p, model=replace(p.model, effects=tuple(effects)))
    left = result.without_numbers(result.without_states(residual_at(p, data, theta, result.x0)))
    return _Moved(values=values, parametrisation=p, theta=theta, cost=float(left @ left))


def _mean_squares(result: Fit) -> FloatArray:
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
