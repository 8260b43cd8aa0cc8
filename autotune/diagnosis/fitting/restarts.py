"""Restarts from where no descent leads: start states that friction holds, a converter's levels a little off."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit, fit, fit_from, residual_at
from autotune.diagnosis.fitting.parameters import Parametrisation
from autotune.effects import kind_of
from autotune.effects.base import EffectKind
from autotune.effects.stages import Values

#: How far effects are moved at first: for a converter its step as a share of what takes it a level off across u's span,
#: its origin as a share of the step; how often these are halved.
MOVES, HALVINGS = (0.5, 0.1), 5
#: How often start states are found anew at most.
RENEWALS = 3


def renew_start_states(result: Fit, data: Data) -> Fit:
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
    for _ in range(RENEWALS):
        again = fit_from(result.parametrisation, data, result.theta, states=30, iterations=30, rounds=4)
        if again.cost > result.cost - data.thresholds.beyond_chance:
            break
        result = again
    return result


def realign_effects(result: Fit, data: Data) -> Fit:
    """Return a fit whose effects were moved to where no derivative leads, where that explains more.

    Parameters
    ----------
    result, data
        As of :func:`renew_start_states`; the same fit is returned where no effect of its model has such moves.

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
    at: Values = result.model.effects[number].values
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
    return realign_effects(again, data) if again.cost < result.cost - data.thresholds.beyond_chance else result


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
    effects, held = list(p.model.effects), {}
    for key in effects[number].parameters:
        q = kind.quantity(key)
        if q is None or key not in values:
            continue
        if q.is_fitted:
            index = [f.name for f in p.free].index(f"{kind.name}.{key}")
            theta[index] = np.log(values[key]) if p.free[index].positive else values[key] / p.free[index].size
        else:
            held[key] = values[key]
    effects[number] = effects[number].with_values(held)
    p = replace(p, model=replace(p.model, effects=tuple(effects)))
    left = result.without_numbers(result.without_states(residual_at(p, data, theta, result.x0)))
    return _Moved(values=values, parametrisation=p, theta=theta, cost=float(left @ left))
