"""Restarts from where no descent leads: start states that friction holds, a converter's levels a little off."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.descent import bounded
from autotune.diagnosis.fitting.fit import RUNAWAY, STEPS, Fit, fit, fit_from, residual_at
from autotune.diagnosis.fitting.parameters import Parametrisation
from autotune.effects import kind_of
from autotune.effects.base import EffectKind, Extent
from autotune.effects.stages import Values

#: Decrease of the cost for which an effect is moved: of chi-square, or as a share of it where model error and not noise
#: is its unit.
LEAST_GAIN, LEAST_SHARE = 1.0, 0.02
#: How often start states are found anew, or an effect is moved and all fitted again, at most.
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
    """Return a fit whose effect was moved to where no derivative leads, where that explains more.

    Parameters
    ----------
    result, data
        As of :func:`renew_start_states`; the same fit is returned where no effect of its model has such moves.

    Notes
    -----
    Every point of u that a converter's step takes to another level jumps, and a time of change acts from row to row:
    the criterion is a narrow well that derivatives do not show. Values around are tried, all other numbers and the
    start states following to first order, then what leaves least is fitted. Of several such effects it is the one that
    was added last.
    """
    effects = result.parametrisation.model.effects
    number = next((i for i in reversed(range(len(effects))) if kind_of(effects[i].name).moves is not None), -1)
    if number < 0:
        return result
    for _ in range(RENEWALS):
        best = _nearest_around(result, data, number)
        if best.values == result.model.effects[number].values:
            break
        try:
            again = fit(best.parametrisation, data, best.theta, result.x0, iterations=STEPS, inherit=result)
        except RUNAWAY:
            break
        if again.cost > result.cost - min(LEAST_GAIN, LEAST_SHARE * result.cost):
            break
        result = again
    return result


def _nearest_around(result: Fit, data: Data, number: int) -> _Moved:
    """Return what leaves least of an effect's values: those of a fit, or others around them, ever nearer."""
    kind = kind_of(result.model.effects[number].name)
    extent = Extent(
        span=max(float(np.ptp(r.u)) for r in data.driving),
        duration_s=max(r.duration_s for r in data.driving),
        dt_s=max(data.sample_times),
    )
    best = _moved(result, data, kind, number, result.model.effects[number].values)
    share = 1.0
    while tried := kind.moves(best.values, extent, share) if kind.moves is not None else []:
        best = min((best, *(_moved(result, data, kind, number, there) for there in tried)), key=lambda one: one.cost)
        share *= 0.5
    return best


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
    cost = math.inf
    with suppress(*RUNAWAY):
        left = result.without_numbers(result.without_states(residual_at(p, data, theta, result.x0)))
        cost = float(left @ left) if bounded(left) else math.inf
    return _Moved(values=values, parametrisation=p, theta=theta, cost=cost)
