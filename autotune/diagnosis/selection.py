"""Which physics is missing: the nominal structure retuned, effects added in ones, twos and threes, then judged."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from autotune.arrays import BoolArray
from autotune.diagnosis.catalogue import CATALOGUE, STRUCTURES, Entry
from autotune.diagnosis.data import Data
from autotune.diagnosis.direct import periodic_load_starts, quantisation_starts, step_load_starts, stiction_starts
from autotune.diagnosis.fitting import RUNAWAY, Fit, fit
from autotune.diagnosis.noise import Noise, noise_from_differences
from autotune.diagnosis.parsimony import (
    LEAST_DECREASE,
    MODEL_ERROR,
    final_lead,
    needed,
    simplest,
    simplicity_lead,
    worth,
)
from autotune.diagnosis.polishing import own, polish
from autotune.diagnosis.restarts import standing_out
from autotune.diagnosis.retuning import COARSE, LONGER, at_operating_point, bent, floored, holds, misfit, prepare
from autotune.diagnosis.search import Hypothesis, extend, is_stand_in, kept_states, score, signal_ranges
from autotune.diagnosis.simulation import entry_of
from autotune.diagnosis.windows import slowest_lag_s
from autotune.models import Effect, Model
from autotune.recording import Recording

#: A screened hypothesis this share of the best one's decrease behind, and this much, is not fitted to all rows.
FAR_BEHIND = (0.3, 60.0)
#: Rows on which hypotheses are screened; those that lead are fitted to all.
SCREENING_ROWS = 4500
Report = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """Everything that the search found.

    Attributes
    ----------
    data : Data
        Recordings with windows and noise.
    nominal : Fit
        Nominal numbers, start states fitted.
    retuned : Hypothesis
        Nominal structure, numbers fitted.
    singles, pairs, triples : tuple of Hypothesis
        Hypotheses fitted, best first.
    chosen : Hypothesis
        The one that the data ask for; the retuned model where no effect is needed.
    """

    data: Data
    nominal: Fit
    retuned: Hypothesis
    singles: tuple[Hypothesis, ...] = ()
    pairs: tuple[Hypothesis, ...] = ()
    triples: tuple[Hypothesis, ...] = ()
    chosen: Hypothesis


def search(
    model: Model,
    recordings: Sequence[Recording],
    good: Sequence[BoolArray],
    without: Sequence[str] = (),
    report: Report = lambda what, share: None,
) -> Search:
    """Search for the physics that is missing.

    Parameters
    ----------
    model : Model
        Nominal model.
    recordings, good : sequences
        What was measured, and which rows count.
    without : sequence of str
        Effects left out of the catalogue.
    report : callable
        Told what is being done and the share done, 0 to 1.

    Returns
    -------
    Search
        All hypotheses with their fits.

    Notes
    -----
    Forward search with a beam: pairs are built on the best four singles, whether or not these help alone, so that
    partners that only help together are found as long as one of them is among the four. What brings the residual to
    noise must do so on longer windows too; else everything is searched again on those.
    """
    entries = [entry for name, entry in (CATALOGUE | STRUCTURES).items() if name not in without]
    with threadpool_limits(1), ThreadPoolExecutor(2) as pool:
        found = _on_windows(1, model, recordings, good, entries, pool, report)
        if not holds(found.chosen.fit, found.data):
            report("once more, on longer windows", 0.0)
            found = _on_windows(LONGER, model, recordings, good, entries, pool, report)
        return found


def _on_windows(
    times: int,
    model: Model,
    recordings: Sequence[Recording],
    good: Sequence[BoolArray],
    entries: Sequence[Entry],
    pool: Executor,
    report: Report,
) -> Search:
    """Search with windows so many times as long as usual."""
    report("retuning", 0.0)
    data, base = prepare(model, recordings, good, times)
    try:
        nominal = fit(base.parametrisation, data, x0=base.x0, free=np.zeros(base.theta.size, dtype=bool))
    except RUNAWAY:
        nominal = base  # nominal numbers that run away have no error that could be told
    try:
        return _searched(data, base, nominal, entries, pool, report)
    except RUNAWAY:
        # what breaks off explains nothing: the retuned model stands, and is judged by its misfit
        retuned = Hypothesis(names=(), fit=base)
        return Search(data=data, nominal=nominal, retuned=retuned, chosen=retuned)


def _searched(data: Data, base: Fit, nominal: Fit, entries: Sequence[Entry], pool: Executor, report: Report) -> Search:
    """Add effects in ones, twos and threes as far as the residual asks for them."""
    chosen = retuned = Hypothesis(names=(), fit=base)
    report("single effects", 0.1)
    few = data.thinned(SCREENING_ROWS, standing_out(base))
    screen = (
        retuned if few is data else Hypothesis(names=(), fit=fit(base.parametrisation, few, base.theta, own(base, few)))
    )
    lattices = lattice_starts(screen, few, pool, [entry.name for entry in entries])
    candidates = grown(screen, few, pool, entries, most=7, lattices=lattices)
    if bent(base):
        believed = Hypothesis(names=(), fit=at_operating_point(base.parametrisation, few))
        lattices = lattice_starts(believed, few, pool, [entry.name for entry in entries])
        unbent = grown(believed, few, pool, entries, most=7, starts_each=2, lattices=lattices)
        candidates = merged(candidates, unbent)
    singles = polished(candidates, 3, data, base, pool)
    if singles and misfit(base, data) > COARSE:
        data, base, few = _finer(singles[0], base, data)
        retuned = chosen = Hypothesis(names=(), fit=base)
        candidates = [_again(h, few) for h in candidates[:3]]
        singles = polished(candidates, 3, data, base, pool)
    if not singles or not (worth(retuned, singles[0]) or misfit(base, data) > 1.1):
        return Search(data=data, nominal=nominal, retuned=retuned, singles=tuple(singles), chosen=retuned)
    if worth(retuned, singles[0]):
        chosen = singles[0]
    report("pairs of effects", 0.4)
    wider = _paired(singles, candidates, data, few, pool, entries)
    pairs, triples = polished(wider, 2, data, base, pool), list[Hypothesis]()
    if pairs and worth(retuned, pairs[0]) and needed(singles[0], pairs[0], data, base):
        chosen = pairs[0]
        if misfit(pairs[0].fit, data) > 1.05:
            report("three effects", 0.8)
            triples = polished(_larger(wider, 1, few, pool, entries), 1, data, base, pool)
        if triples and needed(pairs[0], triples[0], data, base):
            chosen = triples[0]
    if len(chosen.names) > 1:
        report("dropping what is not needed", 0.85)
        chosen = _pruned(chosen, singles, data, base, pool)
    if len(chosen.names) > 1:
        ranked = sorted((chosen, *_exchanged(chosen, data, base, pool, entries)), key=score)
        pairs, chosen = [*pairs, *ranked], simplest(ranked, simplicity_lead(base, ranked[0], data))
    if misfit(chosen.fit, data) > MODEL_ERROR:
        fewer = [h for h in (*singles, *pairs) if h.parameters < chosen.parameters]
        chosen = simplest([chosen, *fewer], final_lead(base, chosen, data))
    return Search(
        data=data,
        nominal=nominal,
        retuned=retuned,
        singles=tuple(singles),
        pairs=tuple(pairs),
        triples=tuple(triples),
        chosen=retuned if STRUCTURES.keys() & set(chosen.names) else chosen,
    )


def _paired(
    singles: list[Hypothesis],
    candidates: list[Hypothesis],
    data: Data,
    few: Data,
    pool: Executor,
    entries: Sequence[Entry],
) -> list[Hypothesis]:
    """Return pairs built on the best singles.

    A single effect that leaves noise alone is given one chance to be half of a pair, a bad one three.
    """
    settled = misfit(singles[0].fit, data) < 1.03
    lead = [h for h in candidates if h.names == singles[0].names]
    bases = [*lead, *(h for h in candidates[:3] if h not in lead)]
    wider = _larger(bases, 1 if settled else 3, few, pool, entries)
    return [h for h in wider if score(lead[0]) - score(h) > 5.0]


def _pruned(chosen: Hypothesis, singles: list[Hypothesis], data: Data, base: Fit, pool: Executor) -> Hypothesis:
    """Drop effects whose removal costs less than they are worth; single effects found so join the singles."""
    while len(chosen.names) > 1:
        tried = pool.map(lambda i, h=chosen: _without(h, i, data), range(len(chosen.names)))
        smaller = [h for h in tried if h is not None]
        if not smaller:
            break
        singles += [h for h in smaller if len(h.names) == 1]
        singles.sort(key=score)
        best = min(smaller, key=score)
        if needed(best, chosen, data, base):
            break
        chosen = best
    return chosen


def _exchanged(chosen: Hypothesis, data: Data, base: Fit, pool: Executor, entries: Sequence[Entry]) -> list[Hypothesis]:
    """Return fits with one effect exchanged for what it can be taken for.

    Effects are added one by one: what stood in for another while its partner was missing would stay.
    """
    found: list[Hypothesis] = []
    for index, name in enumerate(chosen.names):
        smaller = _without(chosen, index, data)
        confusable = {*entry_of(name).confusable} - {*chosen.names, *entry_of(name).same}
        rivals = [entry for entry in entries if entry.name in confusable]
        if smaller is not None and rivals:
            found += grown(smaller, data, pool, rivals, most=len(rivals), starts_each=2)[:1]
    return [h for h in pool.map(lambda h: polish(h, data, base), found) if h is not None]


def _without(h: Hypothesis, index: int, data: Data) -> Hypothesis | None:
    """Fit a hypothesis again with one of its effects left out; nothing where the simulation runs away without it."""
    p = h.fit.parametrisation
    keep = [i for i, f in enumerate(p.free) if f.kind != "effect" or f.index[0] != index]
    moved = [
        replace(f, index=(f.index[0] - 1, f.index[1])) if f.kind == "effect" and f.index[0] > index else f
        for f in (p.free[i] for i in keep)
    ]
    effects = tuple(e for i, e in enumerate(p.model.effects) if i != index)
    x0 = [x[:, kept_states(p.model.effects[index].name, x.shape[1])] for x in h.fit.x0]
    smaller = replace(p, model=replace(p.model, effects=effects), free=tuple(moved), centre=p.centre[keep])
    try:
        result = fit(smaller, data, h.fit.theta[keep], x0, iterations=20, rounds=2)
    except RUNAWAY:
        return None
    h = Hypothesis(names=tuple(e.name for e in effects), fit=result)
    return None if is_stand_in(h, data) else h


def _finer(best: Hypothesis, base: Fit, data: Data) -> tuple[Data, Fit, Data]:
    """Return data with the noise that the best hypothesis leaves, the retuned model under it, and the thinned data."""
    noise = noise_from_differences(best.fit.residuals, data.good)
    if misfit(best.fit, data) > COARSE:
        noise = Noise(sd=float(np.sqrt(np.mean(np.concatenate(best.fit.residuals) ** 2))))
    data = replace(data, noise=floored(noise, data.recordings))
    base = fit(base.parametrisation, data, base.theta, base.x0, iterations=20)
    return data, base, data.thinned(SCREENING_ROWS, standing_out(base))


def _again(h: Hypothesis, data: Data) -> Hypothesis:
    """Fit a hypothesis again under another noise."""
    return replace(h, fit=fit(h.fit.parametrisation, data, h.fit.theta, h.fit.x0, iterations=20))


def merged(first: Sequence[Hypothesis], second: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the better fit of every combination of effects, best first."""
    best: dict[frozenset[str], Hypothesis] = {}
    for h in (*first, *second):
        key = frozenset(h.names)
        if key not in best or score(h) < score(best[key]):
            best[key] = h
    return sorted(best.values(), key=score)


def polished(ranked: Sequence[Hypothesis], count: int, data: Data, base: Fit, pool: Executor) -> list[Hypothesis]:
    """Return the best hypotheses fitted to all data, best first."""
    few = [h for h in ranked[:count] if not _far_behind(h, ranked[0], base)]
    fits = pool.map(lambda h: polish(h, data, base), few)
    done = sorted((h for h in fits if h is not None), key=score)
    if done:
        first = simplest(done, simplicity_lead(base, done[0], data))
        done.remove(first)
        done.insert(0, first)
    return done


def _far_behind(h: Hypothesis, best: Hypothesis, base: Fit) -> bool:
    """Whether a hypothesis is so far behind on the rows screened that all rows will not turn it."""
    share = h.fit.rows / base.rows
    behind, gained = score(h) - score(best), share * base.cost - best.fit.cost
    return behind > max(FAR_BEHIND[0] * gained, FAR_BEHIND[1])


def lattice_starts(base: Hypothesis, data: Data, pool: Executor, names: Collection[str]) -> list[Effect]:
    """Return starts for what moves the command in steps: a long search, whose result hardly depends on the base."""
    starts = quantisation_starts(base.fit, data, pool) if "actuator.quantisation" in names else []
    if "actuator.stiction" in names:
        starts += stiction_starts(base.fit, data, pool, signal_ranges(base.fit, data).w)
    return starts


def grown(
    base: Hypothesis,
    data: Data,
    pool: Executor,
    entries: Sequence[Entry],
    most: int,
    starts_each: int = 4,
    least: float = 3.0,
    lattices: Sequence[Effect] = (),
) -> list[Hypothesis]:
    """Return fits of a base with one more effect, what a direct search starts included; lattices where known."""
    names = {entry.name for entry in entries} - set(base.names)
    extra = list(lattices)
    if "environment.step_load" in names:
        extra += step_load_starts(base.fit, data, pool)
    if "environment.periodic_load" in names:
        extra += periodic_load_starts(base.fit, data, slowest_lag_s(base.fit.parametrisation.model))
    extra += [] if lattices else lattice_starts(base, data, pool, names)
    return extend(base, data, pool, entries, most=most, extra=extra, starts_each=starts_each, least=least)


def _larger(
    bases: Sequence[Hypothesis], beam: int, data: Data, pool: Executor, entries: Sequence[Entry]
) -> list[Hypothesis]:
    """Return fits with one effect more than the best bases have, best first."""
    found: dict[frozenset[str], Hypothesis] = {}
    for base in bases[:beam]:
        for h in grown(base, data, pool, entries, most=4, starts_each=1, least=0.5 * LEAST_DECREASE):
            key = frozenset(h.names)
            if key not in found or score(h) < score(found[key]):
                found[key] = h
    return sorted(found.values(), key=score)
