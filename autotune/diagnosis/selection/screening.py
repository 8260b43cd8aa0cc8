"""Screening: a first-order look at every effect, then a few steps of those that predict most, then fits of the best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit
from autotune.diagnosis.fitting.restarts import realigned, restarted
from autotune.diagnosis.selection.hypothesis import Hypothesis, hypothesis, is_stand_in, penalised
from autotune.diagnosis.selection.prediction import (
    Prediction,
    extended,
    predictions,
    signal_sizes,
    starting_effects,
)
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of
from autotune.effects.base import EffectKind
from autotune.models import Effect

#: Steps of a fit after which it is decided whether it goes on.
FIRST_STEPS = 3
#: Tasks side by side at most.
SIDE_BY_SIDE = 4
_T = TypeVar("_T")
_R = TypeVar("_R")


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What a search works with.

    Attributes
    ----------
    pool : Executor
        Where simulations run.
    kinds : tuple of EffectKind
        What is looked for.
    """

    pool: Executor
    kinds: tuple[EffectKind, ...]

    @property
    def names(self) -> frozenset[str]:
        """Names of what is looked for."""
        return frozenset(kind.name for kind in self.kinds)


def at_once(task: Callable[[_T], _R], over: Sequence[_T]) -> list[_R]:
    """Return a task's results, in order; the tasks go on side by side and leave what takes long to a pool.

    A pool that waits for one task's slowest simulation works on the next task's meanwhile.
    """
    if len(over) < 2:
        return [task(one) for one in over]
    with ThreadPoolExecutor(min(len(over), SIDE_BY_SIDE)) as threads:
        return list(threads.map(task, over))


@dataclass(frozen=True, kw_only=True)
class Width:
    """How wide a screening looks.

    Attributes
    ----------
    effects : int
        Effects of which fits are begun.
    starts : int
        Starting points of each.
    least : float
        Predicted decrease of chi2 from which on one is begun.
    """

    effects: int
    starts: int
    least: float


def best_predictions(
    base: Fit, data: Data, bench: Bench, found_directly: Sequence[Effect] = ()
) -> dict[str, list[Prediction]]:
    """Return each effect's predictions on top of a base, best first."""
    sizes = signal_sizes(base, data)
    present = {e.name for e in base.model.effects}
    effects = [
        effect
        for kind in bench.kinds
        if kind.name not in present and kind.suits.holds(base.sim.chain)
        for effect in starting_effects(kind, base, sizes)
    ]
    effects += [e for e in found_directly if e.name not in present]
    found: dict[str, list[Prediction]] = {}
    for group in bench.pool.map(lambda effect: predictions(base, effect, data), effects):
        found.setdefault(group[0].effect.name, []).extend(group)
    return {name: sorted(group, key=lambda g: -g.decrease) for name, group in found.items()}


def _begun(base: Fit, effect: Effect, data: Data) -> Hypothesis | None:
    """Fit a base with one more effect for a few steps; nothing where the simulation runs away."""
    try:
        p, theta, states = extended(base, effect, data)
        result = fit(p, data, theta, states, iterations=FIRST_STEPS, rounds=1, inherit=base)
        if result.cost > base.cost:  # start states that dry friction holds need more steps to come free
            result = fit(p, data, result.theta, result.x0, iterations=4 * FIRST_STEPS, rounds=1)
    except RUNAWAY:
        return None
    return hypothesis(result)


def _finished(h: Hypothesis, data: Data) -> Hypothesis:
    """Go on with a fit that has begun; where it began to run away, what it had reached stands."""
    try:
        f = h.fit
        result = fit(f.parametrisation, data, f.theta, f.x0, iterations=30, inherit=f)
    except RUNAWAY:
        return h
    stuck = any(kind.impacts or kind.moves is not None for kind in h.kinds)
    return replace(h, fit=freed(result, data) if stuck else result)


def freed(result: Fit, data: Data) -> Fit:
    """Return a fit brought out of where no descent leads; itself where a simulation runs away on that way."""
    try:
        return realigned(restarted(result, data), data)
    except RUNAWAY:
        return result


def distinct(group: Sequence[Prediction]) -> list[Effect]:
    """Return the starting points of one effect that differ once they have the size that is predicted."""
    kept: list[Effect] = []
    for p in group:
        values = np.array([q.value for q in p.scaled.parameters.values()])
        known = ([q.value for q in e.parameters.values()] for e in kept)
        if p.decrease > 0.0 and not any(np.allclose(values, other, rtol=0.2, atol=0.0) for other in known):
            kept.append(p.scaled)
    return kept


def extend(
    base: Hypothesis, data: Data, bench: Bench, width: Width, found_directly: Sequence[Effect] = ()
) -> list[Hypothesis]:
    """Fit the effects that predict most on top of a base, best first.

    Parameters
    ----------
    base : Hypothesis
        What one more effect is added to.
    data : Data
        What is fitted to.
    bench : Bench
        What is looked for.
    width : Width
        How wide.
    found_directly : sequence of Effect
        Starting points besides those of the records.
    """
    ranked = sorted(best_predictions(base.fit, data, bench, found_directly).values(), key=lambda g: -g[0].decrease)
    first, rest = ranked[: width.effects], ranked[width.effects :]
    tried = [*first, *(group for group in rest if kind_of(group[0].effect.name).impacts)]
    starts = [e for group in tried if group[0].decrease > width.least for e in distinct(group)[: width.starts]]
    begun = [h for h in bench.pool.map(lambda effect: _begun(base.fit, effect, data), starts) if h is not None]
    begun.sort(key=penalised)
    finished = [h for k, h in enumerate(begun) if _goes_on(h, begun[:k], base, data.thresholds)]
    fits: dict[str, Hypothesis] = {}
    for h in bench.pool.map(lambda h: _finished(h, data), finished):
        if is_stand_in(h, data):
            continue
        known = fits.get(h.names[-1])
        if known is None or penalised(h) < penalised(known):
            fits[h.names[-1]] = h
    return sorted(fits.values(), key=penalised)


def _goes_on(h: Hypothesis, better: Sequence[Hypothesis], base: Hypothesis, limits: Thresholds) -> bool:
    """Whether a fit that has begun is worth finishing: among the best few, or near them, and not one name too often."""
    same = [other for other in better if other.names == h.names]
    gained = base.fit.cost - h.fit.cost
    if len(same) >= limits.finished_each or (
        same and gained < limits.finished_second * (base.fit.cost - same[0].fit.cost)
    ):
        return False
    lead = base.fit.cost - better[0].fit.cost if better else 0.0
    names = {other.names for other in better} | {h.names}
    return len(names) <= limits.finished_effects or gained > limits.finished_near * lead
