"""Which physics is missing: the nominal structure retuned, effects added in ones, twos and threes, then judged."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from threadpoolctl import threadpool_limits

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.catalogue import CATALOGUE, STRUCTURES, Entry
from autotune.diagnosis.data import Data
from autotune.diagnosis.direct import periodic_load_starts, quantisation_starts, step_load_starts, stiction_starts
from autotune.diagnosis.fitting import Fit, fit, start_states
from autotune.diagnosis.noise import Noise, noise_from_differences
from autotune.diagnosis.retuning import COARSE, floored, misfit, prepare
from autotune.diagnosis.search import HARD_STOP, RUNAWAY, Hypothesis, extend, freed, kept_states, score, signal_ranges
from autotune.diagnosis.simulation import entry_of
from autotune.diagnosis.windows import slowest_lag_s
from autotune.models import Effect, Model
from autotune.recording import Recording

#: Decrease of the score that an effect must bring: what chance brings among some two hundred starts, with a margin (on
#: clean recordings nothing brought more than 15); weak effects that can be told bring a hundred and more, some 40.
LEAST_DECREASE = 30.0
#: The same where a number of the nominal structure lies beyond belief without the effect, by that many of its prior's
#: standard deviations: a lag that has to be tripled is no wrong number.
LEAST_BEYOND_BELIEF, BEYOND_BELIEF = 16.0, 4.0
#: Shift of an effect's size, as a logarithm, that gets a fit out of a crease; stiction's creases are narrow.
NUDGE, NARROW = 0.06, 0.02
#: Effects whose thresholds make the criterion rough.
ROUGH = frozenset(
    ("actuator.dead_zone", "actuator.backlash", "actuator.stiction", "actuator.quantisation", "plant.coulomb_friction",
     "plant.stribeck_friction")
)  # fmt: skip
#: A screened hypothesis this share of the best one's decrease behind, and this much, is not fitted to all rows.
FAR_BEHIND = (0.3, 60.0)
#: Score that a hypothesis with more free numbers must be ahead of one with fewer; a hundredth of what it explains where
#: that is more and the misfit of the best is more than noise has.
SIMPLER, NOISE_ALONE = 6.0, 1.02
#: The same where the best leaves noise alone, and what a further effect has to bring, as a share of what is explained:
#: no simulation of blows and thresholds is more exact.
SIMULATED = 2e-3
#: Misfit from which on what is wrong with all of them rules, and not noise; the lead is then this share of what the
#: best explains: a real rig's every imperfection is more than its noise, and little of it is worth a name.
MODEL_ERROR, MODEL_ERROR_SHARE = 2.0, 0.12
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


def polish(h: Hypothesis, data: Data, base: Fit, rounds: int = 4) -> Hypothesis | None:
    """Fit a hypothesis of the screening to all data; nothing where its simulation runs away on rows not screened."""
    try:
        fitted = _polish(h, data, base, rounds)
    except RUNAWAY:
        return None
    return None if _is_dry_friction(fitted, data) else fitted


def _is_dry_friction(h: Hypothesis, data: Data) -> bool:
    """Whether a servo's hysteresis turns within less than the noise: then it is Coulomb friction by another name."""
    turns = [e.parameters["width"].value for e in h.fit.model.effects if e.name == "plant.hysteresis"]
    return h.fit.sim.chain.is_mechanical and any(width < data.noise.total_sd for width in turns)


def _polish(h: Hypothesis, data: Data, base: Fit, rounds: int) -> Hypothesis:
    """Fit the start states that the screening has not seen first, then everything."""
    p = h.fit.parametrisation
    if h.fit.rows == data.rows:
        best = fit(p, data, h.fit.theta, h.fit.x0, iterations=30, rounds=rounds, inherit=h.fit)
    else:
        none = np.zeros(h.fit.theta.size, dtype=bool)
        settled = fit(p, data, h.fit.theta, states_for(h.fit, data, base), free=none)
        best = fit(p, data, h.fit.theta, settled.x0, iterations=30, rounds=rounds)
    if (ROUGH | {HARD_STOP}) & set(h.names):
        best = freed(best, data)
    positive = np.array([f.kind == "effect" and f.positive for f in p.free])
    rough = ROUGH & set(h.names)
    nudge = NARROW if "actuator.stiction" in rough else NUDGE
    for shift in (-nudge, nudge) if rough and positive.any() else ():
        # thresholds make the criterion rough: a nudge gets a fit out of a crease
        again = fit(p, data, best.theta + shift * positive, best.x0, iterations=8, rounds=1, inherit=best)
        best = again if again.cost < best.cost else best
    return replace(h, fit=_timed(best, data))


def _timed(result: Fit, data: Data) -> Fit:
    """Move a step load's time where a fit of everything else is better; a first-order look may take one far from it."""
    effects = result.parametrisation.model.effects
    number = next((i for i, e in enumerate(effects) if e.name == "environment.step_load"), None)
    if number is None:
        return result
    step, least = max(r.duration_s for r in data.recordings) / 16.0, 2.0 * max(data.sample_times)
    while step > least:
        tried = [_moved(result, number, step * side, data) for side in (-1.0, 1.0)]
        best = min((t for t in tried if t is not None), key=lambda t: t.cost, default=result)
        if best.cost < result.cost - 1.0:
            result = best
        else:
            step /= 2.5
    return result


def _moved(result: Fit, number: int, shift: float, data: Data) -> Fit | None:
    """Fit again for a few steps with a step load's time moved; nothing where the simulation runs away."""
    p = result.parametrisation
    effects = list(p.model.effects)
    time = effects[number].parameters["time"]
    moved = {**effects[number].parameters, "time": replace(time, value=time.value + shift)}
    effects[number] = replace(effects[number], parameters=MappingProxyType(moved))
    try:
        there = replace(p, model=replace(p.model, effects=tuple(effects)))
        return fit(there, data, result.theta, result.x0, iterations=4, rounds=1, inherit=result)
    except RUNAWAY:
        return None


def own(result: Fit, data: Data) -> list[FloatArray]:
    """Return a fit's start states of the windows that thinned data have."""
    pairs = zip(result.x0, result.starts, data.starts, strict=True)
    return [x0[np.searchsorted(known, starts)] for x0, known, starts in pairs]


def states_for(result: Fit, data: Data, base: Fit) -> tuple[FloatArray, ...]:
    """Return start states for all windows: a fit's own where it has the window, else the base's or rest."""
    states = start_states(result.sim, data)
    if states[0].shape == base.x0[0].shape:
        states = [x.copy() for x in base.x0]
    for full, starts, x0, known in zip(states, data.starts, result.x0, result.starts, strict=True):
        full[np.searchsorted(starts, known)] = x0
    return tuple(states)


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
    partners that only help together are found as long as one of them is among the four.
    """
    entries = [entry for name, entry in (CATALOGUE | STRUCTURES).items() if name not in without]
    with threadpool_limits(1), ThreadPoolExecutor(2) as pool:
        report("retuning", 0.0)
        data, base = prepare(model, recordings, good)
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
    few = data.thinned(SCREENING_ROWS)
    screen = (
        retuned if few is data else Hypothesis(names=(), fit=fit(base.parametrisation, few, base.theta, own(base, few)))
    )
    lattices = lattice_starts(screen, few, pool, [entry.name for entry in entries])
    candidates = grown(screen, few, pool, entries, most=7, lattices=lattices)
    if bent(base):
        unbent = grown(_unbent(base, few), few, pool, entries, most=7, starts_each=2, lattices=lattices)
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
        ranked = sorted((chosen, *_exchanged(chosen, data, pool, entries)), key=score)
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


def _exchanged(chosen: Hypothesis, data: Data, pool: Executor, entries: Sequence[Entry]) -> list[Hypothesis]:
    """Return fits with one effect exchanged for what it can be taken for.

    Effects are added one by one: what stood in for another while its partner was missing would stay.
    """
    found: list[Hypothesis] = []
    for index, name in enumerate(chosen.names):
        smaller = _without(chosen, index, data)
        confusable = {*entry_of(name).confusable} - {*chosen.names, *entry_of(name).same}
        rivals = [entry for entry in entries if entry.name in confusable]
        if smaller is not None and rivals:
            found += grown(smaller, data, pool, rivals, most=len(rivals), starts_each=2)
    return found


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
    return Hypothesis(names=tuple(e.name for e in effects), fit=result)


def _finer(best: Hypothesis, base: Fit, data: Data) -> tuple[Data, Fit, Data]:
    """Return data with the noise that the best hypothesis leaves, the retuned model under it, and the thinned data."""
    noise = noise_from_differences(best.fit.residuals, data.good)
    if misfit(best.fit, data) > COARSE:
        noise = Noise(sd=float(np.sqrt(np.mean(np.concatenate(best.fit.residuals) ** 2))))
    data = replace(data, noise=floored(noise, data.recordings))
    return data, fit(base.parametrisation, data, base.theta, base.x0, iterations=20), data.thinned(SCREENING_ROWS)


def _again(h: Hypothesis, data: Data) -> Hypothesis:
    """Fit a hypothesis again under another noise."""
    return replace(h, fit=fit(h.fit.parametrisation, data, h.fit.theta, h.fit.x0, iterations=20))


def bent(result: Fit, far: float = 2.0) -> bool:
    """Whether retuning moved a gain or lag so far that it must stand for something else."""
    away = np.abs(result.theta - result.parametrisation.centre) / result.parametrisation.spreads
    return bool(np.max(away, initial=0.0) > far)


def _unbent(base: Fit, data: Data) -> Hypothesis:
    """Return the nominal structure with nominal numbers, the operating point alone fitted."""
    free = np.array([f.kind == "u_offset" for f in base.parametrisation.free])
    return Hypothesis(names=(), fit=fit(base.parametrisation, data, free=free))


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


def simplest(ranked: Sequence[Hypothesis], lead: float) -> Hypothesis:
    """Return the hypothesis of the fewest numbers that is less than a lead behind the first one."""
    near = [h for h in ranked if score(h) - score(ranked[0]) < lead]
    return min(near, key=lambda h: (h.parameters, score(h)))


def _far_behind(h: Hypothesis, best: Hypothesis, base: Fit) -> bool:
    """Whether a hypothesis is so far behind on the rows screened that all rows will not turn it."""
    share = h.fit.rows / base.rows
    behind, gained = score(h) - score(best), share * base.cost - best.fit.cost
    return behind > max(FAR_BEHIND[0] * gained, FAR_BEHIND[1])


def simplicity_lead(base: Fit, best: Hypothesis, data: Data) -> float:
    """Return by how much a richer hypothesis must beat a simpler one to be preferred, in units of the score.

    Where even the best leaves more than noise, its score counts what is wrong with all of them, and more is asked.
    """
    if misfit(best.fit, data) < NOISE_ALONE:
        return max(SIMPLER, SIMULATED * (base.cost - best.fit.cost))
    return max(SIMPLER, 0.01 * (base.cost - best.fit.cost))


def final_lead(base: Fit, best: Hypothesis, data: Data) -> float:
    """Return the same for the choice among all that were found, where the model's error may be what is left."""
    lead = simplicity_lead(base, best, data)
    if misfit(best.fit, data) < MODEL_ERROR:
        return lead
    return max(lead, MODEL_ERROR_SHARE * (base.cost - best.fit.cost))


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


def worth(smaller: Hypothesis, larger: Hypothesis) -> bool:
    """Whether a larger hypothesis explains enough more to be believed."""
    excess = max(1.0, larger.fit.chi2 / larger.fit.rows)
    least = LEAST_BEYOND_BELIEF if bent(smaller.fit, BEYOND_BELIEF) else LEAST_DECREASE
    return bool(score(smaller) - score(larger) > least * excess)


def needed(smaller: Hypothesis, larger: Hypothesis, data: Data, base: Fit) -> bool:
    """Whether one more effect is worth it and brings the residual to noise, or most of the way there.

    On a rig with disturbances of its own every further effect explains a little; that little is not physics.
    """
    before, after = misfit(smaller.fit, data) - 1.0, misfit(larger.fit, data) - 1.0
    more = score(smaller) - score(larger) > SIMULATED * (base.cost - larger.fit.cost)
    return more and worth(smaller, larger) and (after < 0.08 or after < 0.5 * before)
