"""A hypothesis of the screening fitted to all rows: start states first, then everything, then out of local minima."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit, start_states
from autotune.diagnosis.fitting.restarts import renewed
from autotune.diagnosis.fitting.retuning import far_from_prior
from autotune.diagnosis.selection.hypothesis import Hypothesis, is_stand_in
from autotune.diagnosis.selection.screening import freed
from autotune.effects import kind_of

#: Decrease of the cost for which a time of change is moved: of chi-square, or as a share of it where model error and
#: not noise is its unit.
LEAST_GAIN, LEAST_SHARE = 1.0, 0.02


def polish(h: Hypothesis, data: Data, base: Fit, rounds: int = 4) -> Hypothesis | None:
    """Fit a hypothesis of the screening to all data; nothing where its simulation runs away on rows not screened."""
    try:
        fitted = _polish(h, data, base, rounds)
    except RUNAWAY:
        return None
    return None if is_stand_in(fitted, data) else fitted


def _polish(h: Hypothesis, data: Data, base: Fit, rounds: int) -> Hypothesis:
    """Fit the start states that the screening has not seen first, then everything."""
    p = h.fit.parametrisation
    if h.fit.rows == data.rows:
        best = fit(p, data, h.fit.theta, h.fit.x0, iterations=30, rounds=rounds, inherit=h.fit)
    else:
        none = np.zeros(h.fit.theta.size, dtype=bool)
        settled = fit(p, data, h.fit.theta, states_for(h.fit, data, base), free=none)
        best = fit(p, data, h.fit.theta, settled.x0, iterations=30, rounds=rounds)
    nudges = [kind.nudge for kind in h.kinds if kind.is_rough]
    if nudges or any(kind.impacts for kind in h.kinds):
        best = freed(best, data)
    if nudges or far_from_prior(best, data.thresholds.far_from_prior):
        best = renewed(best, data)
    positive = np.array([f.kind == "effect" and f.positive for f in p.free])
    for shift in (-min(nudges), min(nudges)) if nudges and positive.any() else ():
        # thresholds make the criterion rough: a nudge brings a fit out of a local minimum
        again = fit(p, data, best.theta + shift * positive, best.x0, iterations=8, rounds=1, inherit=best)
        best = again if again.cost < best.cost else best
    return replace(h, fit=timed(best, data))


def timed(result: Fit, data: Data) -> Fit:
    """Move a time of change where a fit of everything else is better; a first-order look may take one far from it."""
    effects = result.parametrisation.model.effects
    found = [(i, q.name) for i, e in enumerate(effects) for q in kind_of(e.name).parameters if q.is_time_of_change]
    if not found:
        return result
    number, key = found[-1]  # the one that was added last
    step, least = max(r.duration_s for r in data.driving) / 16.0, 2.0 * max(data.sample_times)
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
    time = effects[number].parameters[key]
    moved = {**effects[number].parameters, key: replace(time, value=time.value + shift)}
    effects[number] = replace(effects[number], parameters=MappingProxyType(moved))
    try:
        there = replace(p, model=replace(p.model, effects=tuple(effects)))
        return fit(there, data, result.theta, result.x0, iterations=4, rounds=1, inherit=result)
    except RUNAWAY:
        return None


def states_for(result: Fit, data: Data, base: Fit | None) -> tuple[FloatArray, ...]:
    """Return start states for all windows: a fit's own where it has the window, else a base's or rest."""
    states = start_states(result.sim, data)
    if base is not None and states[0].shape == base.x0[0].shape:
        states = [x.copy() for x in base.x0]
    for full, starts, x0, known in zip(states, data.first_rows, result.x0, result.starts, strict=True):
        full[np.searchsorted(starts, known)] = x0
    return tuple(states)
