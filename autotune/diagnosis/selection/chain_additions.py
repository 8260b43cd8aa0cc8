"""One effect more in a chain: its starting points by the first order, the most promising ones fitted and judged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, STEPS, Fit, fit
from autotune.diagnosis.fitting.restarts import realign_effects
from autotune.diagnosis.selection.bench import Bench, at_once
from autotune.diagnosis.selection.hypothesis import hypothesis, is_stand_in
from autotune.diagnosis.selection.judged_chain import JudgedChain
from autotune.diagnosis.selection.prediction import distinct_starts, extend, predictions, signal_sizes, starting_effects
from autotune.diagnosis.selection.refits import move_time_of_change
from autotune.diagnosis.selection.scan import search_starts
from autotune.effects import taken_by
from autotune.effects.base import EffectKind, SignalSizes
from autotune.models import Effect

#: Share of what its numbers must bring near the noise that the first order must predict before an effect is fitted.
PROMISING = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class _Start:
    """An effect to be added to a hypothesis: where from, at which scale, and what the first order predicts."""

    base: JudgedChain
    kind: EffectKind
    odds: float
    effects: tuple[Effect, ...]
    near: Fit
    data: Data
    decrease: float


def judge_larger(beam: Sequence[JudgedChain], bench: Bench) -> list[JudgedChain]:
    """Return hypotheses with one effect more than those of a beam, the most promising ones judged.

    Parameters
    ----------
    beam : sequence of JudgedChain
        What effects are added to.
    bench : Bench
        Data at both scales, fits and judgement.
    """
    starts: list[_Start] = []
    for base in beam:
        found = _starts(base, bench)
        if base.leaves_noise:
            found = [s for s in found if s.decrease > PROMISING * _charge(s)]
        found.sort(key=lambda s: -s.decrease - 2.0 * math.log(s.odds))
        starts += [s for place, s in enumerate(found) if place < bench.limits.rig_tried or s.odds >= bench.limits.usual]
    fits = bench.pool.map(lambda s: _fit_added(s, bench), starts)
    best: dict[frozenset[str], tuple[Fit, float, JudgedChain]] = {}
    for s, result in zip(starts, fits, strict=True):
        if result is None or result.cost > s.base.fit.cost - 0.3:
            continue
        key, log_odds = frozenset((*s.base.names, s.kind.name)), s.base.log_odds + math.log(s.odds)
        if key not in best or result.cost < best[key][0].cost:
            best[key] = result, log_odds, s.base
    order = sorted(best.values(), key=lambda one: one[0].cost - 2.0 * one[1])
    able = [[one for one in order if one[2] is base][: bench.limits.rig_tried] for base in beam]
    done = bench.pool.map(lambda one: bench.judged(one[0], one[1]), [one for group in able for one in group])
    return [j for j in done if j is not None and np.all(np.isfinite(j.long_squares + j.short_squares))]


def _charge(start: _Start) -> float:
    """Return the decrease of chi-square that the numbers of an effect must bring, priors apart (Schwarz 1978)."""
    fitted = sum(q.is_fitted for q in start.kind.parameters)
    return fitted * math.log(start.base.fit.rows)


def _starts(base: JudgedChain, bench: Bench) -> list[_Start]:
    """Return every effect's starting points from which the first order predicts most, at each scale that helps.

    Where the free run through long windows is out of phase, no derivative there leads anywhere: short ones do.
    """
    scales = [(base.fit, bench.long)]
    if bench.has_shorter and base.error > bench.limits.out_of_phase:
        scales.append((bench.shortened(base.fit), bench.few))
    taken = taken_by(base.names)
    tried = [
        (kind, odds, near, data)
        for kind, odds in bench.odds
        for near, data in scales
        if kind.name not in taken and kind.suits.holds(near.sim.chain)
    ]
    sizes = {id(data): signal_sizes(near, data) for near, data in scales}
    effects = at_once(lambda t: _starting_points(t[0], t[2], t[3], sizes[id(t[3])], bench), tried)
    each = [(near, data, e) for (_, _, near, data), group in zip(tried, effects, strict=True) for e in group]
    predicted = iter(list(bench.pool.map(lambda t: predictions(t[0], t[2], t[1]), each)))
    found = []
    for (kind, odds, near, data), group in zip(tried, effects, strict=True):
        order = sorted((p for _ in group for p in next(predicted)), key=lambda p: -p.decrease)
        few = tuple(distinct_starts(order)[: bench.limits.rig_starts])
        if few:
            found.append(
                _Start(base=base, kind=kind, odds=odds, effects=few, near=near, data=data, decrease=order[0].decrease)
            )
    return found


def _starting_points(kind: EffectKind, near: Fit, data: Data, sizes: SignalSizes, bench: Bench) -> list[Effect]:
    """Return an effect's starting points: those of its record, and those that a direct search finds."""
    tried = starting_effects(kind, near, sizes)
    if kind.lasting:
        return tried + [e for e in bench.lasting if e.name == kind.name]
    return tried + (search_starts(kind.name, near, data, bench.pool) if kind.search is not None else [])


def _fit_added(start: _Start, bench: Bench) -> Fit | None:
    """Return the best fit of a hypothesis with one more effect to long windows; nothing where all run away."""
    done: list[Fit] = []
    steps = 2 * STEPS if start.kind.rough else STEPS
    for effect in start.effects:
        try:
            p, theta, states = extend(start.near, effect, start.data)
            result = fit(p, start.data, theta, states, iterations=steps, inherit=start.near)
            if start.data is not bench.long:
                result = bench.settled(p, result.theta)
        except RUNAWAY:
            continue
        if start.kind.moves is not None:
            result = realign_effects(result, bench.long)
        if not is_stand_in(hypothesis(result), bench.long):
            done.append(result)
    best = min(done, key=lambda f: f.cost, default=None)
    return move_time_of_change(best, bench.long) if best is not None and start.kind.is_event else best
