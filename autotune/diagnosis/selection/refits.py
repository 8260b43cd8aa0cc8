"""A fit made again: without one of its effects, or with a time of change moved."""

from __future__ import annotations

from dataclasses import replace

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit
from autotune.diagnosis.simulation.assembly import states_that_stay
from autotune.effects import kind_of

#: Decrease of the cost for which a time of change is moved: of chi-square, or as a share of it where model error and
#: not noise is its unit.
LEAST_GAIN, LEAST_SHARE = 1.0, 0.02


def fit_without(result: Fit, index: int, data: Data) -> Fit | None:
    """Fit again without one of the effects that a fit adds; nothing where the simulation runs away without it."""
    p = result.parametrisation
    index += p.own  # the nominal model's own effects stay
    keep = [i for i, f in enumerate(p.free) if f.kind != "effect" or f.index[0] != index]
    moved = [
        replace(f, index=(f.index[0] - 1, f.index[1])) if f.kind == "effect" and f.index[0] > index else f
        for f in (p.free[i] for i in keep)
    ]
    effects = tuple(e for i, e in enumerate(p.model.effects) if i != index)
    x0 = [x[:, states_that_stay(p.model.effects[index].name, x.shape[1])] for x in result.x0]
    smaller = replace(p, model=replace(p.model, effects=effects), free=tuple(moved), centre=p.centre[keep])
    try:
        return fit(smaller, data, result.theta[keep], x0, iterations=20, rounds=2)
    except RUNAWAY:
        return None


def move_time_of_change(result: Fit, data: Data) -> Fit:
    """Move a time of change where a fit of everything else is better; a first-order look may take one far from it."""
    effects = result.parametrisation.model.effects
    found = [(i, q.name) for i, e in enumerate(effects) for q in kind_of(e.name).parameters if q.is_time_of_change]
    if not found:
        return result
    number, key = found[-1]  # the one that was added last
    step, least = max(r.duration_s for r in data.driving) / 16.0, 0.5 * max(data.sample_times)
    while step > least:
        tried = [_moved(result, number, key, step * side, data) for side in (-1.0, 1.0)]
        best = min((t for t in tried if t is not None), key=lambda t: t.cost, default=result)
        if best.cost < result.cost - min(LEAST_GAIN, LEAST_SHARE * result.cost):
            result = best
        else:
            step /= 2.5
    return result


def _moved(result: Fit, number: int, key: str, shift: float, data: Data) -> Fit | None:
    """Fit again for a few steps with a time of change moved; nothing where the simulation runs away."""
    p = result.parametrisation
    effects = list(p.model.effects)
    effects[number] = effects[number].with_values({key: effects[number].values[key] + shift})
    try:
        there = replace(p, model=replace(p.model, effects=tuple(effects)))
        return fit(there, data, result.theta, result.x0, iterations=4, rounds=1, inherit=result)
    except RUNAWAY:
        return None
