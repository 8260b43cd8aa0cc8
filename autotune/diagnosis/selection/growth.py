"""Hypotheses made larger, smaller, or with one effect exchanged for another."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit
from autotune.diagnosis.selection.hypothesis import Hypothesis, hypothesis, is_stand_in, merged, penalised
from autotune.diagnosis.selection.parsimony import needed, simplest, simplicity_lead
from autotune.diagnosis.selection.polishing import polish
from autotune.diagnosis.selection.scan import searched
from autotune.diagnosis.selection.screening import Bench, Width, at_once, extend
from autotune.diagnosis.simulation.assembly import states_that_stay
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of, taken_by
from autotune.models import Effect


def lasting_starts(base: Hypothesis, data: Data, bench: Bench, names: Collection[str]) -> list[Effect]:
    """Return starts of long searches, whose result hardly depends on the base."""
    return [
        e for k in bench.kinds if k.lasting and k.name in names for e in searched(k.name, base.fit, data, bench.pool)
    ]


def grown(base: Hypothesis, data: Data, bench: Bench, width: Width, lasting: Sequence[Effect] = ()) -> list[Hypothesis]:
    """Return fits of a base with one more effect, what a direct search starts included.

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
    lasting : sequence of Effect
        What long searches found, where that is known; they are made anew otherwise.
    """
    names = bench.names - taken_by(base.names)
    kinds = [k for k in bench.kinds if k.name in names and not k.lasting and k.search is not None]
    groups = at_once(lambda k: searched(k.name, base.fit, data, bench.pool), kinds)
    found = [*lasting, *(e for group in groups for e in group)]
    found += [] if lasting else lasting_starts(base, data, bench, names)
    return extend(base, data, bench, width, found)


def larger(bases: Sequence[Hypothesis], data: Data, bench: Bench) -> list[Hypothesis]:
    """Return fits with one effect more than bases have, best first."""
    limits = data.thresholds
    width = Width(effects=limits.further_effects, starts=1, least=0.5 * limits.least_decrease)
    return merged([h for group in at_once(lambda base: grown(base, data, bench, width), bases) for h in group])


def pruned(
    chosen: Hypothesis, singles: Sequence[Hypothesis], data: Data, base: Fit, bench: Bench
) -> tuple[Hypothesis, list[Hypothesis]]:
    """Drop effects whose removal costs less than they are worth; return single effects found so among the singles."""
    known = list(singles)
    while len(chosen.names) > 1:
        tried = bench.pool.map(lambda i, h=chosen: without(h, i, data), range(len(chosen.names)))
        smaller = [h for h in tried if h is not None]
        if not smaller:
            break
        known = sorted((*known, *(h for h in smaller if len(h.names) == 1)), key=penalised)
        best = min(smaller, key=penalised)
        if needed(best, chosen, data, base):
            break
        chosen = best
    return chosen, known


def exchanged(chosen: Hypothesis, data: Data, base: Fit, bench: Bench) -> list[Hypothesis]:
    """Return fits with one effect exchanged for what it can be taken for.

    Effects are added one by one: what was taken for another while its partner was missing would stay.
    """

    def other(index: int) -> list[Hypothesis]:
        name, smaller = chosen.names[index], without(chosen, index, data)
        confusable = {*kind_of(name).confusable} - {*chosen.names, *kind_of(name).same}
        others = tuple(kind for kind in bench.kinds if kind.name in confusable)
        if smaller is None or not others:
            return []
        width = Width(effects=len(others), starts=2, least=data.thresholds.least_predicted)
        return grown(smaller, data, replace(bench, kinds=others), width)[:1]

    found = [h for group in at_once(other, range(len(chosen.names))) for h in group]
    return [h for h in bench.pool.map(lambda h: polish(h, data, base), found) if h is not None]


def without(h: Hypothesis, index: int, data: Data) -> Hypothesis | None:
    """Fit a hypothesis again without one of the effects it adds; nothing where the simulation runs away without it."""
    p = h.fit.parametrisation
    index += p.own  # the nominal model's own effects stay
    keep = [i for i, f in enumerate(p.free) if f.kind != "effect" or f.index[0] != index]
    moved = [
        replace(f, index=(f.index[0] - 1, f.index[1])) if f.kind == "effect" and f.index[0] > index else f
        for f in (p.free[i] for i in keep)
    ]
    effects = tuple(e for i, e in enumerate(p.model.effects) if i != index)
    x0 = [x[:, states_that_stay(p.model.effects[index].name, x.shape[1])] for x in h.fit.x0]
    smaller = replace(p, model=replace(p.model, effects=effects), free=tuple(moved), centre=p.centre[keep])
    try:
        found = hypothesis(fit(smaller, data, h.fit.theta[keep], x0, iterations=20, rounds=2))
    except RUNAWAY:
        return None
    return None if is_stand_in(found, data) else found


def polished(ranked: Sequence[Hypothesis], count: int, data: Data, base: Fit, bench: Bench) -> list[Hypothesis]:
    """Return the best hypotheses fitted to all data, best first."""
    few = [h for h in ranked[:count] if not _far_behind(h, ranked[0], base, data.thresholds)]
    fits = bench.pool.map(lambda h: polish(h, data, base), few)
    done = sorted((h for h in fits if h is not None), key=penalised)
    if done:
        first = simplest(done, simplicity_lead(base, done[0], data))
        done.remove(first)
        done.insert(0, first)
    return done


def _far_behind(h: Hypothesis, best: Hypothesis, base: Fit, limits: Thresholds) -> bool:
    """Whether a hypothesis is so far behind on the rows screened that all rows will not turn it."""
    share = h.fit.rows / base.rows
    behind, gained = penalised(h) - penalised(best), share * base.cost - best.fit.cost
    return behind > max(limits.far_behind_share * gained, limits.far_behind)
