"""What a search among chains proposes: effects of the catalogue put into the simulation, fitted and judged.

Models run free for as long as the plant allows: short windows with free start states favour whatever bends easily.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from autotune.arrays import BoolArray
from autotune.diagnosis.evidence.operating_point import unmoved
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import LAST_STEPS, RUNAWAY, STEPS, Fit, fit, states_in
from autotune.diagnosis.fitting.long_windows import cut, lengths_of, within
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.fitting.restarts import realign_effects
from autotune.diagnosis.selection.bench import Bench, at_once, fit_without, names_more_than_it_is, residual_sd
from autotune.diagnosis.selection.judged import each_best, rank
from autotune.diagnosis.selection.judged_chain import JudgedChain, at_both_scales
from autotune.diagnosis.selection.prediction import distinct_starts, extend, predictions, signal_sizes, starting_effects
from autotune.diagnosis.selection.scan import search_starts
from autotune.diagnosis.selection.search import Found, Proposals, search
from autotune.diagnosis.simulation.assembly import input_size
from autotune.diagnosis.simulation.chain import build_chain
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.effects import ALL, related_effects
from autotune.effects.base import PRIOR_ODDS, EffectKind, SignalSizes
from autotune.effects.rigs import rig_kind
from autotune.models import Effect, Model
from autotune.progress import Progress, quiet
from autotune.recording import Recording

#: Share of what its numbers must bring near the noise that the first order must predict before an effect is fitted.
PROMISING = 0.5


def search_chain(
    model: Model,
    recordings: Sequence[Recording],
    good: Sequence[BoolArray],
    left_out: Collection[str] = (),
    progress: Progress = quiet,
    limits: Thresholds = IN_USE,
    known: Sequence[JudgedChain] | None = None,
) -> Found[JudgedChain]:
    """Search for the physics that is missing in a chain.

    Parameters
    ----------
    model, recordings, good
        Nominal model, what was measured, and which rows count.
    left_out : collection of str
        Effects that are not looked for.
    progress, limits, known
        As in :func:`autotune.diagnosis.selection.search.search`; what decides between findings.

    Returns
    -------
    Found
        What was judged, and what predicts best.

    Raises
    ------
    AutotuneError, OverflowError, LinAlgError
        The nominal model runs away on the recordings.
    """
    with ThreadPoolExecutor(2) as pool:
        progress("retuning on long windows", 0.0)
        lengths = lengths_of(model, recordings, limits)
        cuts = [cut(model, recordings, good, length, limits) for length in lengths.between]
        few = cut(model, recordings, good, lengths.short, limits)
        if known:
            cuts[-1] = within(known[0].data, recordings, good)
            few = within(known[0].few, recordings, good) if len(cuts) == 1 else few
        odds = _odds(model, recordings, left_out) if known is None else ()  # what is known has its odds
        bench = Bench(cuts=tuple(cuts), few=few, odds=odds, pool=pool)
        return search(_begin(model, bench), progress, known)


@dataclass(frozen=True, kw_only=True, eq=False)
class _ChainProposals(Bench, Proposals[JudgedChain]):
    """A chain on its recordings; beside the retuned one the nominal one is a root where retuning moves a number far."""

    nominal: JudgedChain
    roots: tuple[JudgedChain, ...]

    def larger(self, beam: Sequence[JudgedChain], progress: Progress) -> list[JudgedChain]:
        """Return hypotheses with one effect more than those of a beam, the most promising ones."""
        starts: list[_Start] = []
        for base in beam:
            found = _starts(base, self.in_units_of(base))
            if base.leaves_noise:
                found = [s for s in found if s.decrease > PROMISING * _charge(s)]
            found.sort(key=lambda s: -s.decrease - 2.0 * math.log(s.odds))
            starts += [s for k, s in enumerate(found) if k < self.limits.tried or s.odds >= PRIOR_ODDS["usual"]]
        best: dict[frozenset[str], tuple[Fit, _Start]] = {}
        for s, result in zip(starts, self.pool.map(_fit_added, starts), strict=True):
            if result is None or result.cost > s.base.fit.cost - 0.3:
                continue
            key = frozenset((*s.base.names, s.kind.name))
            if key not in best or _absolute(result, s.base.data) < _absolute(best[key][0], best[key][1].base.data):
                best[key] = result, s
        order = sorted(best.values(), key=lambda one: one[0].cost - 2.0 * one[1].log_odds)
        able = [[one for one in order if one[1].base is base][: self.limits.tried] for base in beam]
        chosen = [one for group in able for one in group]
        done = self.pool.map(lambda one: one[1].bench.judged(one[0], one[1].log_odds), chosen)
        return [j for j in done if j is not None]

    def beside(self, best: JudgedChain) -> _ChainProposals:
        """Return what proposes beside a hypothesis, in units of the residual that it leaves."""
        return self.with_sd(residual_sd(best.fit, best.data), residual_sd(best.short, best.few))

    def refitted(self, some: Sequence[JudgedChain]) -> list[JudgedChain]:
        """Return hypotheses of other rows fitted to these from their numbers, without those that run away."""

        def refit(one: JudgedChain) -> JudgedChain | None:
            bench = self.in_units_of(one)
            with suppress(*RUNAWAY):
                begun = states_in(one.fit, one.data, bench.long)
                there = fit(one.fit.parametrisation, bench.long, one.fit.theta, begun, iterations=STEPS)
                return bench.judged(there, one.log_odds)
            return None

        return [j for j in self.pool.map(refit, some) if j is not None]

    def smaller(self, some: Sequence[JudgedChain], known: Sequence[JudgedChain]) -> list[JudgedChain]:
        """Return hypotheses with each of their effects left out."""
        given = {k.name: math.log(o) for k, o in self.odds}

        def judge_without(one: JudgedChain, at: Bench, index: int) -> JudgedChain | None:
            fewer = fit_without(one.fit, index, one.data)
            own = sum(given.get(n, -math.inf) for i, n in enumerate(one.names) if i != index)
            return None if fewer is None else at.judged(fewer, max(own, one.log_odds))

        def judge_smaller(one: JudgedChain) -> list[JudgedChain | None]:
            return list(self.pool.map(partial(judge_without, one, self.in_units_of(one)), range(len(one.names))))

        return [j for group in at_once(judge_smaller, some) for j in group if j is not None]

    def finish_leading(self, found: Sequence[JudgedChain]) -> list[JudgedChain]:
        """Return the leading hypotheses fitted to the end, and what is larger fitted on from where the first one is."""
        done = [j for j in self.pool.map(self.finished, each_best(found)[: self.limits.leading]) if j is not None]
        return [*done, *_refit_larger([*found, *done], self)]

    def settle_numbers(self, best: JudgedChain, found: Sequence[JudgedChain]) -> JudgedChain:
        """Return a hypothesis with the numbers that suit long and short windows together."""
        return at_both_scales(best, found)


def _odds(
    model: Model, recordings: Sequence[Recording], left_out: Collection[str]
) -> tuple[tuple[EffectKind, float], ...]:
    """Return the effects that may be missing, with their prior odds in a rig of the model's kind."""
    kind = rig_kind(model, build_chain(model))
    left_out = {*left_out, *unmoved(model, recordings)}
    able = [k for k in ALL if k.sought in ("hypothesis", "rig", "structure") and k.name not in left_out]
    return tuple((k, k.prior_odds(kind)) for k in able)


def _begin(model: Model, bench: Bench) -> _ChainProposals:
    """Return the bench in units of the retuned model's residual, with that model at its nominal numbers and retuned."""
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
    nominal = nominal if nominal is not None else retuned
    away = float(np.max(np.abs(retuned.fit.theta - p.centre) / p.spreads))
    roots = (retuned, nominal) if away > bench.limits.far_from_prior else (retuned,)
    sought = (search_starts(k.name, retuned.short, retuned.few, bench.pool) for k, _ in bench.odds if k.lasting)
    known = vars(bench) | {"lasting": tuple(e for found in sought for e in found)}
    return _ChainProposals(**known, nominal=nominal, roots=roots)


def _refit_larger(found: Sequence[JudgedChain], bench: Bench) -> list[JudgedChain]:
    """Return hypotheses that have one effect more than the first one, fitted on from where that came to.

    Fits under dry friction end in local minima: what is larger is compared with what is smaller from the same place.
    """
    best = rank(found)[0]
    larger = [j for j in rank(found) if set(j.names) > set(best.names) and len(j.names) == len(best.names) + 1]
    once = {frozenset(j.names): j for j in reversed(larger)}
    chosen = sorted(once.values(), key=larger.index)[: bench.limits.leading]
    return [j for j in bench.pool.map(lambda j: _fit_from_best(best, j, bench), chosen) if j is not None]


def _fit_from_best(best: JudgedChain, larger: JudgedChain, bench: Bench) -> JudgedChain | None:
    """Return a hypothesis fitted from another one's numbers, with the effect that it has besides as it was found."""
    effect = next(e for e in larger.fit.model.effects if e.name in set(larger.names) - set(best.names))
    bench = bench.in_units_of(best)
    try:
        p, theta, states = extend(best.fit, effect, bench.long)
        result = fit(p, bench.long, theta, states, iterations=LAST_STEPS, inherit=best.fit)
    except RUNAWAY:
        return None
    if _absolute(result, bench.long) >= _absolute(larger.fit, larger.data):
        return None
    return bench.judged(result, larger.log_odds)


def _absolute(result: Fit, data: Data) -> float:
    """Return a fit's cost in the reading's unit squared, from units of the data that it was fitted to."""
    return result.cost * data.noise.sd**2


@dataclass(frozen=True, kw_only=True, eq=False)
class _Start:
    """An effect to be added to a hypothesis: where from, at which scale, and what the first order predicts."""

    base: JudgedChain
    bench: Bench
    kind: EffectKind
    odds: float
    effects: tuple[Effect, ...]
    near: Fit
    data: Data
    decrease: float

    @property
    def log_odds(self) -> float:
        """Logarithm of the prior odds of all effects of the hypothesis."""
        return self.base.log_odds + math.log(self.odds)


def _charge(start: _Start) -> float:
    """Return the decrease of chi-square that the numbers of an effect must bring, priors apart (Schwarz 1978)."""
    return sum(q.is_fitted for q in start.kind.parameters) * math.log(start.base.fit.rows)


def _starts(base: JudgedChain, bench: Bench) -> list[_Start]:
    """Return every effect's starting points from which the first order predicts most, at each scale that helps.

    Where the free run through long windows is out of phase, no derivative there leads anywhere: short ones do.
    """
    scales = [(base.fit, bench.long)]
    if bench.has_shorter and base.error > bench.limits.linear:
        with suppress(*RUNAWAY):
            scales.append((bench.shortened(base.fit), bench.few))
    taken = related_effects(base.names)
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
        few = tuple(distinct_starts(order)[: bench.limits.followed])
        if few:
            most = order[0].decrease
            found.append(
                _Start(base=base, bench=bench, kind=kind, odds=odds, effects=few, near=near, data=data, decrease=most)
            )
    return found


def _starting_points(kind: EffectKind, near: Fit, data: Data, sizes: SignalSizes, bench: Bench) -> list[Effect]:
    """Return an effect's starting points: those of its record, and those that a direct search finds."""
    tried = starting_effects(kind, near, sizes)
    if kind.lasting:
        return tried + [e for e in bench.lasting if e.name == kind.name]
    return tried + (search_starts(kind.name, near, data, bench.pool) if kind.search is not None else [])


def _fit_added(start: _Start) -> Fit | None:
    """Return the best fit of a hypothesis with one more effect to long windows; nothing where all run away."""
    done: list[Fit] = []
    bench = start.bench
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
        if not names_more_than_it_is(result, bench.long):
            done.append(result)
    return min(done, key=lambda f: f.cost, default=None)
