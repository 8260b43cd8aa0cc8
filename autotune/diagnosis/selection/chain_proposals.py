"""What a search among chains proposes: effects of the catalogue put into the simulation, fitted and judged.

Models run free for as long as the plant allows: short windows with free start states favour whatever bends easily.
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
from autotune.diagnosis.fitting.fit import LAST_STEPS, RUNAWAY, fit, fit_from
from autotune.diagnosis.fitting.long_windows import cut, lengths_of
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.selection.bench import Bench, at_once, residual_sd
from autotune.diagnosis.selection.chain_additions import judge_larger
from autotune.diagnosis.selection.judged import leading, rank
from autotune.diagnosis.selection.judged_chain import JudgedChain, at_both_scales
from autotune.diagnosis.selection.prediction import extend
from autotune.diagnosis.selection.probability import RARE
from autotune.diagnosis.selection.refits import fit_without
from autotune.diagnosis.selection.scan import search_starts
from autotune.diagnosis.selection.search import Found, search
from autotune.diagnosis.simulation.assembly import input_size
from autotune.diagnosis.simulation.chain import build_chain
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.effects import ALL
from autotune.effects.base import EffectKind
from autotune.effects.rigs import rig_kind
from autotune.models import Effect, Model
from autotune.progress import Progress, quiet
from autotune.recording import Recording


def search_chain(
    model: Model,
    recordings: Sequence[Recording],
    good: Sequence[BoolArray],
    left_out: Collection[str] = (),
    progress: Progress = quiet,
    limits: Thresholds = IN_USE,
    begun: JudgedChain | None = None,
) -> Found[JudgedChain]:
    """Search for the physics that is missing in a chain.

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
        What predicted best on more rows of these recordings.

    Returns
    -------
    Found
        What was judged, and what predicts best.

    Raises
    ------
    AutotuneError, OverflowError, LinAlgError
        The nominal model runs away on the recordings.
    """
    with threadpool_limits(1), ThreadPoolExecutor(2) as pool:
        progress("retuning on long windows", 0.0)
        lengths = lengths_of(model, recordings, limits)
        bench = Bench(
            cuts=tuple(cut(recordings, good, length, limits) for length in lengths.between),
            few=cut(recordings, good, lengths.short, limits), odds=_odds(model, recordings, left_out), pool=pool,
        )  # fmt: skip
        return search(_begin(model, bench), progress, begun)


@dataclass(frozen=True, kw_only=True, eq=False)
class ChainProposals:
    """A chain on its recordings, as :class:`autotune.diagnosis.selection.search.Proposals` asks for it.

    Attributes
    ----------
    bench : Bench
        Data at both scales, fits and judgement.
    nominal : JudgedChain
        The chain with its nominal numbers, the operating point fitted.
    roots : tuple of JudgedChain
        The retuned chain, and the nominal one where retuning moves a number far.
    """

    bench: Bench
    nominal: JudgedChain
    roots: tuple[JudgedChain, ...]

    @property
    def limits(self) -> Thresholds:
        """What decides between two findings."""
        return self.bench.limits

    def larger(self, beam: Sequence[JudgedChain], progress: Progress) -> list[JudgedChain]:
        """Return hypotheses with one effect more than those of a beam, the most promising ones."""
        return judge_larger(beam, self.bench)

    def beside(self, best: JudgedChain) -> ChainProposals:
        """Return what proposes beside a hypothesis, in units of the residual that it leaves."""
        sds = residual_sd(best.fit, best.data), residual_sd(best.short, best.few)
        return replace(self, bench=self.bench.with_sd(*sds))

    def again(self, one: JudgedChain) -> JudgedChain:
        """Return a hypothesis fitted again, in units of the residual that the best one leaves."""
        return self.bench.again(one)

    def resumed(self, one: JudgedChain) -> JudgedChain | None:
        """Return a hypothesis that was fitted to more rows, fitted to these from its numbers; None if it runs away."""
        try:
            there = fit_from(one.fit.parametrisation, self.bench.long, one.fit.theta, iterations=LAST_STEPS)
            return self.bench.finite(there, one.log_odds)
        except RUNAWAY:
            return None

    def smaller(self, some: Sequence[JudgedChain], known: Sequence[JudgedChain]) -> list[JudgedChain]:
        """Return hypotheses with each of their effects left out."""
        return _without_each(some, self.bench)

    def finished(self, found: Sequence[JudgedChain]) -> list[JudgedChain]:
        """Return the leading hypotheses fitted to the end, and what is larger fitted on from where the first one is."""
        first = leading(found, self.limits.rig_pruned)
        done = [j for j in self.bench.pool.map(self.bench.finished, first) if j is not None]
        return [*done, *_refit_larger([*found, *done], self.bench)]

    def settled(self, best: JudgedChain, found: Sequence[JudgedChain]) -> JudgedChain:
        """Return a hypothesis with the numbers that suit long and short windows together."""
        return at_both_scales(best, found)


def _odds(
    model: Model, recordings: Sequence[Recording], left_out: Collection[str]
) -> tuple[tuple[EffectKind, float], ...]:
    """Return the effects that may be missing, with their prior odds in a rig of the model's kind."""
    kind = rig_kind(model, build_chain(model))
    left_out = {*left_out, *unmoved(model, recordings)}
    able = [k for k in ALL if k.sought in ("hypothesis", "rig", "structure") and k.name not in left_out]
    return tuple((k, max(k.odds.get(kind, k.odds.get("any", 0.0)), RARE)) for k in able)


def _begin(model: Model, bench: Bench) -> ChainProposals:
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
    roots = (retuned, nominal) if away > bench.limits.nominal_too else (retuned,)
    return ChainProposals(bench=replace(bench, lasting=tuple(_lasting(retuned, bench))), nominal=nominal, roots=roots)


def _lasting(root: JudgedChain, bench: Bench) -> list[Effect]:
    names = [k.name for k, _ in bench.odds if k.lasting]
    return [e for name in names for e in search_starts(name, root.short, root.few, bench.pool)]


def _refit_larger(found: Sequence[JudgedChain], bench: Bench) -> list[JudgedChain]:
    """Return hypotheses that have one effect more than the first one, fitted on from where that came to.

    Fits under dry friction end in local minima: what is larger is compared with what is smaller from the same place.
    """
    best = rank(found)[0]
    larger = [j for j in rank(found) if set(j.names) > set(best.names) and len(j.names) == len(best.names) + 1]
    once = {frozenset(j.names): j for j in reversed(larger)}
    chosen = sorted(once.values(), key=larger.index)[: bench.limits.rig_pruned]
    return [j for j in bench.pool.map(lambda j: _fit_from_best(best, j, bench), chosen) if j is not None]


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
