"""Which physics is missing: effects added one by one, judged by what they leave.

Models run free for as long as the plant allows: short windows with free start states favour whatever bends easily. What
is usual in a rig of its kind needs less evidence than what is rare.

The steps of one search: the file is a little longer than others.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from autotune.arrays import BoolArray
from autotune.diagnosis.evidence.operating_point import unmoved
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import LAST_STEPS, RUNAWAY, STEPS, Fit, fit, fit_from
from autotune.diagnosis.fitting.long_windows import cut, lengths_of
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.fitting.restarts import realign_effects
from autotune.diagnosis.selection.bench import Bench, at_once, residual_sd
from autotune.diagnosis.selection.hypothesis import hypothesis, is_stand_in
from autotune.diagnosis.selection.judged import add_smaller, built_on, leading, rank
from autotune.diagnosis.selection.judged_chain import Found, JudgedChain, at_both_scales
from autotune.diagnosis.selection.prediction import distinct_starts, extend, predictions, signal_sizes, starting_effects
from autotune.diagnosis.selection.probability import RARE
from autotune.diagnosis.selection.refits import fit_without, move_time_of_change
from autotune.diagnosis.selection.scan import search_starts
from autotune.diagnosis.simulation.assembly import input_size
from autotune.diagnosis.simulation.chain import build_chain
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.effects import ALL, taken_by
from autotune.effects.base import EffectKind, SignalSizes
from autotune.effects.rigs import rig_kind
from autotune.models import Effect, Model
from autotune.progress import Progress, quiet
from autotune.recording import Recording

#: Share of what its numbers must bring near the noise that the first order must predict before an effect is fitted.
PROMISING = 0.5


def search(
    model: Model,
    recordings: Sequence[Recording],
    good: Sequence[BoolArray],
    left_out: Collection[str] = (),
    progress: Progress = quiet,
    limits: Thresholds = IN_USE,
    begun: JudgedChain | None = None,
) -> Found:
    """Search for the physics that is missing.

    Parameters
    ----------
    model, recordings, good
        Nominal model, what was measured, and which rows count.
    left_out : collection of str
        Effects that are not looked for.
    progress : callable
        Told what is being done and the share done, 0 to 1.
    limits : Thresholds
        What decides between findings.
    begun : JudgedChain, optional
        What predicted best on more rows of these recordings: it is judged as well, from the numbers that it had there.

    Returns
    -------
    Found
        What was judged, and what predicts best.

    Raises
    ------
    AutotuneError, OverflowError, LinAlgError
        The nominal model runs away on the recordings.

    Notes
    -----
    Forward search with a beam, then what is not needed is dropped. An effect must be usual in a rig of its kind or the
    evidence outweigh that it is not. Where the model's error decides, it takes away a tenth of the held-out error, and
    stretches agree on it: what is excited in no stretch but one is found with less power.
    """
    with threadpool_limits(1), ThreadPoolExecutor(2) as pool:
        progress("retuning on long windows", 0.0)
        lengths = lengths_of(model, recordings, limits)
        bench = Bench(
            cuts=tuple(cut(recordings, good, length, limits) for length in lengths.between),
            few=cut(recordings, good, lengths.short, limits), odds=_odds(model, recordings, left_out), pool=pool,
        )  # fmt: skip
        bench, (nominal, retuned) = _roots(model, bench)
        away = np.abs(retuned.fit.theta - retuned.fit.parametrisation.centre) / retuned.fit.parametrisation.spreads
        beam = [retuned, nominal] if float(np.max(away)) > limits.nominal_too else [retuned]
        bench = replace(bench, lasting=tuple(_lasting(retuned, bench)))
        bench, found = _grow(retuned, beam, bench, progress, limits)
        found += _judge_begun(begun, bench)
        found = add_smaller(found, limits.rig_pruned, limits.rig_effects, lambda some, _: _without_each(some, bench))
        found = _refit_larger(_fit_to_end(found, bench), bench)
        chosen = at_both_scales(rank(found)[0], found)
        retuned = chosen if not chosen.names else rank([one for one in found if not one.names])[0]
        nominal, retuned, chosen = (one.spread_out() for one in (nominal, retuned, chosen))
        return Found(nominal=nominal, retuned=retuned, judged=tuple(found), best=chosen, chosen=chosen)


def _odds(
    model: Model, recordings: Sequence[Recording], left_out: Collection[str]
) -> tuple[tuple[EffectKind, float], ...]:
    """Return the effects that may be missing, with their prior odds in a rig of the model's kind."""
    kind = rig_kind(model, build_chain(model))
    left_out = {*left_out, *unmoved(model, recordings)}
    able = [k for k in ALL if k.sought in ("hypothesis", "rig", "structure") and k.name not in left_out]
    return tuple((k, max(k.odds.get(kind, k.odds.get("any", 0.0)), RARE)) for k in able)


def _grow(
    retuned: JudgedChain, beam: list[JudgedChain], bench: Bench, progress: Progress, limits: Thresholds
) -> tuple[Bench, list[JudgedChain]]:
    """Add effects one by one while one of them makes the free run better; return all that was judged."""
    found, best = [retuned], retuned
    for size in range(limits.rig_effects):
        progress("effects one by one", 0.1 + 0.8 * size / limits.rig_effects)
        larger = _judge_larger(beam, bench)
        if not larger:
            break
        found += larger
        larger = rank((best, *larger))
        leads = larger[0] is not best
        larger.remove(best)
        beam = built_on(larger, limits.rig_beam)
        if leads and larger[0].is_better(best, limits.material):
            best = larger[0]
            bench = bench.with_sd(residual_sd(best.fit, best.data), residual_sd(best.short, best.few))
            beam = [bench.again(j) for j in beam if j.leaves_noise or not best.leaves_noise]
        elif size > 0:
            break
    return bench, found


def _roots(model: Model, bench: Bench) -> tuple[Bench, list[JudgedChain]]:
    """Return the bench with the retuned model's residual, and that model at its nominal numbers and retuned."""
    recordings = bench.long.driving
    p = parametrise(model, [], input_size(model, recordings), recordings[0].sample_time_s,
                    bench.limits.prior_spread)  # fmt: skip
    result = bench.settled(p, None)
    for _ in range(2):
        bench = bench.with_sd(residual_sd(result, bench.long), bench.few.noise.sd)
        result = bench.settled(p, result.theta)
    short = bench.shortened(result) if bench.two_scales else result
    bench = bench.with_sd(bench.long.noise.sd, residual_sd(short, bench.near))
    retuned = bench.judged(result, 0.0)
    offset = np.array([f.kind == "u_offset" for f in p.free])
    at_prior = fit(p, bench.long, result.theta * offset + p.centre * ~offset, free=offset)
    nominal = bench.judged(at_prior, 0.0)
    if retuned is None:
        raise OverflowError("the retuned model runs away")
    return bench, [nominal if nominal is not None else retuned, retuned]


def _lasting(root: JudgedChain, bench: Bench) -> list[Effect]:
    names = [k.name for k, _ in bench.odds if k.lasting]
    return [e for name in names for e in search_starts(name, root.short, root.few, bench.pool)]


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


def _judge_larger(beam: Sequence[JudgedChain], bench: Bench) -> list[JudgedChain]:
    """Return hypotheses with one effect more than those of a beam, the most promising ones judged."""
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


def _judge_begun(begun: JudgedChain | None, bench: Bench) -> list[JudgedChain]:
    """Return what predicted best on more rows, judged on these: a search of fewer rows may miss where it lies."""
    if begun is None:
        return []
    try:
        there = fit_from(begun.fit.parametrisation, bench.long, begun.fit.theta, iterations=LAST_STEPS)
        judged = bench.finite(there, begun.log_odds)
    except RUNAWAY:
        return []
    return [] if judged is None else [judged]


def _fit_to_end(found: Sequence[JudgedChain], bench: Bench) -> list[JudgedChain]:
    """Return hypotheses and, beside them, the leading ones fitted to the end: the search leaves them before."""
    first = leading(found, bench.limits.rig_pruned)
    return [*found, *(j for j in bench.pool.map(bench.finished, first) if j is not None)]


def _refit_larger(found: Sequence[JudgedChain], bench: Bench) -> list[JudgedChain]:
    """Return hypotheses with those that have one effect more than the chosen one, fitted on from where that came to.

    Fits under dry friction end in local minima: what is larger is compared with what is smaller from the same place.
    """
    best = rank(found)[0]
    larger = [j for j in rank(found) if set(j.names) > set(best.names) and len(j.names) == len(best.names) + 1]
    once = {frozenset(j.names): j for j in reversed(larger)}
    chosen = sorted(once.values(), key=larger.index)[: bench.limits.rig_pruned]
    return [*found, *(j for j in bench.pool.map(lambda j: _fit_from_best(best, j, bench), chosen) if j is not None)]


def _fit_from_best(best: JudgedChain, larger: JudgedChain, bench: Bench) -> JudgedChain | None:
    """Return a hypothesis fitted from another one's numbers, with the effect that it has besides as it was found."""
    effect = next(e for e in larger.fit.model.effects if e.name in set(larger.names) - set(best.names))
    try:
        p, theta, states = extend(best.fit, effect, bench.long)
        result = fit(p, bench.long, theta, states, iterations=LAST_STEPS, inherit=best.fit)
    except RUNAWAY:
        return None
    if result.cost >= larger.fit.cost:
        return None
    return bench.finite(result, larger.log_odds)


def _without_each(some: Sequence[JudgedChain], bench: Bench) -> list[JudgedChain]:
    """Return hypotheses with each of their effects left out."""
    given = {k.name: math.log(o) for k, o in bench.odds}

    def judge_without(one: JudgedChain, index: int) -> JudgedChain | None:
        smaller = fit_without(one.fit, index, one.data)
        own = sum(given.get(n, -math.inf) for i, n in enumerate(one.names) if i != index)
        return None if smaller is None else bench.judged(smaller, max(own, one.log_odds))

    each = at_once(lambda one: list(bench.pool.map(partial(judge_without, one), range(len(one.names)))), some)
    return [j for group in each for j in group if j is not None]
