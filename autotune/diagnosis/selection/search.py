"""Which physics is missing: the nominal structure retuned, effects added in ones, twos and threes."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from autotune.arrays import BoolArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit, states_of
from autotune.diagnosis.fitting.noise import Noise, noise_from_differences
from autotune.diagnosis.fitting.restarts import standing_out
from autotune.diagnosis.fitting.retuning import (
    at_nominal,
    at_operating_point,
    far_from_prior,
    floored,
    holds,
    prepare,
    reduced_chi2,
)
from autotune.diagnosis.selection.confirmation import confirmed
from autotune.diagnosis.selection.growth import exchanged, grown, larger, lasting_starts, polished, pruned
from autotune.diagnosis.selection.hypothesis import Hypothesis, merged, penalised
from autotune.diagnosis.selection.parsimony import (
    final_lead,
    may_be_needed,
    needed,
    settled,
    simplest,
    simplicity_lead,
    worth_adding,
)
from autotune.diagnosis.selection.screening import Bench, Width, at_once
from autotune.diagnosis.selection.searched import Search
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.effects import CATALOGUE, STRUCTURES
from autotune.models import Model
from autotune.progress import Progress, quiet
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class _Stage:
    """What a search has at hand: all data, those it screens on, the retuned model, and what it works with."""

    data: Data
    few: Data
    base: Fit
    bench: Bench

    def polished(self, ranked: Sequence[Hypothesis], count: int) -> list[Hypothesis]:
        """Return the best hypotheses fitted to all data, best first."""
        return polished(ranked, count, self.data, self.base, self.bench)


def search(
    model: Model,
    recordings: Sequence[Recording],
    good: Sequence[BoolArray],
    without: Sequence[str] = (),
    progress: Progress = quiet,
    thresholds: Thresholds = IN_USE,
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
    progress : callable
        Told what is being done and the share done, 0 to 1.
    thresholds : Thresholds
        What decides between two findings.

    Returns
    -------
    Search
        All hypotheses with their fits.

    Notes
    -----
    Forward search with a beam: pairs are built on the best four singles, whether or not these help alone, so that
    partners that only help together are found as long as one of them is among the four. What brings the residual to
    noise must do so on longer windows too; else everything is searched again on those. Long recordings are searched in
    some of their windows, and the best hypotheses are fitted to all of them.
    """
    kinds = tuple(kind for name, kind in (CATALOGUE | STRUCTURES).items() if name not in without)
    with threadpool_limits(1), ThreadPoolExecutor(2) as pool:
        bench = Bench(pool=pool, kinds=kinds)
        progress("retuning", 0.0)
        found = _searched(*prepare(model, recordings, good, 1, thresholds), bench, progress, again=False)
        if not holds(found.chosen.fit, found.data):
            progress("once more, on longer windows", 0.0)
            longer = prepare(model, recordings, good, thresholds.longer_windows, thresholds)
            found = _searched(*longer, bench, progress, again=True)
        return confirmed(found, pool)


def _searched(data: Data, base: Fit, bench: Bench, progress: Progress, *, again: bool) -> Search:
    """Search beside a retuned model; what does not hold on longer windows is not built on, but on these ``again``."""
    nominal = at_nominal(base, data)
    try:
        return _extended(data, base, nominal, bench, progress, again)
    except RUNAWAY:
        # what breaks off explains nothing: the retuned model stands, and is judged by its residual
        retuned = Hypothesis(names=(), fit=base)
        return Search(data=data, nominal=nominal, retuned=retuned, chosen=retuned)


def _extended(data: Data, base: Fit, nominal: Fit, bench: Bench, progress: Progress, again: bool) -> Search:
    """Add effects in ones, twos and threes as far as the residual asks for them."""
    progress("single effects", 0.1)
    limits = data.thresholds
    stage = _Stage(data=data, few=_few(data, base), base=base, bench=bench)
    candidates = _screened(stage)
    coarse = reduced_chi2(base, data) > limits.coarse
    singles = (stage.polished(candidates, 1) if coarse else []) or stage.polished(candidates, 3)
    if singles and coarse:  # of these the noise alone is taken
        stage = _finer(singles[0], stage)
        candidates = [_again(h, stage.few) for h in candidates[:3]]
        singles = stage.polished(candidates, 3)
    retuned = chosen = Hypothesis(names=(), fit=stage.base)
    is_worth = bool(singles) and worth_adding(retuned, singles[0], limits)
    if not singles or not (is_worth or reduced_chi2(stage.base, stage.data) > limits.search_on):
        return Search(data=stage.data, nominal=nominal, retuned=retuned, singles=tuple(singles), chosen=retuned)
    if is_worth:
        chosen = singles[0]
        if not again and not holds(chosen.fit, stage.data):
            return Search(data=stage.data, nominal=nominal, retuned=retuned, singles=tuple(singles), chosen=chosen)
    progress("pairs of effects", 0.4)
    pairs, triples = list[Hypothesis](), list[Hypothesis]()
    if not is_worth or may_be_needed(chosen, stage.data, stage.base):
        chosen, pairs, triples = _combined(chosen, singles, candidates, stage, progress)
    if len(chosen.names) > 1:
        progress("dropping what is not needed", 0.85)
        chosen, singles = pruned(chosen, singles, stage.data, stage.base, bench)
    if len(chosen.names) > 1:
        ranked = sorted((chosen, *exchanged(chosen, stage.data, stage.base, bench)), key=penalised)
        pairs = [*pairs, *ranked]
        chosen = simplest(ranked, simplicity_lead(stage.base, ranked[0], stage.data))
    if reduced_chi2(chosen.fit, stage.data) > limits.model_error:
        fewer = [h for h in (*singles, *pairs) if h.parameters < chosen.parameters]
        chosen = simplest([chosen, *fewer], final_lead(stage.base, chosen, stage.data))
    chosen = settled(chosen, (retuned, *singles, *pairs, *triples), stage.data, stage.base)
    return Search(
        data=stage.data,
        nominal=nominal,
        retuned=retuned,
        singles=tuple(singles),
        pairs=tuple(pairs),
        triples=tuple(triples),
        chosen=retuned if STRUCTURES.keys() & set(chosen.names) else chosen,
    )


def _few(data: Data, base: Fit) -> Data:
    """Return the rows on which hypotheses are screened; the best are fitted to all."""
    return data.thinned(data.thresholds.screening_rows, standing_out(base, data.thresholds.stands_out))


def _screened(stage: _Stage) -> list[Hypothesis]:
    """Return single effects fitted to the rows that are screened on, best first.

    Where retuning went far from the prior, effects are looked for beside the chain at its prior as well.
    """
    base, data, few, bench = stage.base, stage.data, stage.few, stage.bench
    p, limits = base.parametrisation, data.thresholds
    wide = Width(effects=limits.screened_effects, starts=4, least=limits.least_predicted)
    start = Hypothesis(names=(), fit=base if few is data else fit(p, few, base.theta, states_of(base, few)))

    def beside(one: tuple[Hypothesis, Width]) -> list[Hypothesis]:
        return grown(one[0], few, bench, one[1], lasting_starts(one[0], few, bench, bench.names))

    if not far_from_prior(base, limits.far_from_prior):
        return beside((start, wide))
    at_prior = Hypothesis(names=(), fit=at_operating_point(p, few))
    return merged(*at_once(beside, [(start, wide), (at_prior, replace(wide, starts=2))]))


def _combined(
    chosen: Hypothesis,
    singles: list[Hypothesis],
    candidates: list[Hypothesis],
    stage: _Stage,
    progress: Progress,
) -> tuple[Hypothesis, list[Hypothesis], list[Hypothesis]]:
    """Return the choice among singles, pairs and triples, and the pairs and triples fitted."""
    data, base, retuned = stage.data, stage.base, Hypothesis(names=(), fit=stage.base)
    wider = _paired(singles, candidates, stage)
    pairs, triples = stage.polished(wider, 2), list[Hypothesis]()
    if not (pairs and worth_adding(retuned, pairs[0], data.thresholds) and needed(singles[0], pairs[0], data, base)):
        return chosen, pairs, triples
    chosen = pairs[0]
    if reduced_chi2(chosen.fit, data) > data.thresholds.three_effects:
        progress("three effects", 0.8)
        triples = stage.polished(larger(wider[:1], stage.few, stage.bench), 1)
    if triples and needed(pairs[0], triples[0], data, base):
        chosen = triples[0]
    return chosen, pairs, triples


def _paired(singles: list[Hypothesis], candidates: list[Hypothesis], stage: _Stage) -> list[Hypothesis]:
    """Return pairs built on the best singles.

    A single effect that leaves noise alone is given one chance to be half of a pair, a bad one three.
    """
    settled = reduced_chi2(singles[0].fit, stage.data) < stage.data.thresholds.settled
    lead = [h for h in candidates if h.names == singles[0].names]
    bases = [*lead, *(h for h in candidates[:3] if h not in lead)]
    wider = larger(bases[: 1 if settled else 3], stage.few, stage.bench)
    return [h for h in wider if penalised(lead[0]) - penalised(h) > stage.data.thresholds.pair_decrease]


def _finer(best: Hypothesis, stage: _Stage) -> _Stage:
    """Return data with the noise that the best hypothesis leaves, and the retuned model under it."""
    data, base = stage.data, stage.base
    noise = noise_from_differences(best.fit.residuals, data.good, data.thresholds.largest_correlation)
    if reduced_chi2(best.fit, data) > data.thresholds.coarse:
        noise = Noise(sd=float(np.sqrt(np.mean(np.concatenate(best.fit.residuals) ** 2))))
    data = replace(data, noise=floored(noise, data.recordings))
    base = fit(base.parametrisation, data, base.theta, base.x0, iterations=20)
    # the same windows: what was screened on them goes on
    return replace(stage, data=data, base=base, few=replace(stage.few, noise=data.noise))


def _again(h: Hypothesis, data: Data) -> Hypothesis:
    """Fit a hypothesis again under another noise."""
    return replace(h, fit=fit(h.fit.parametrisation, data, h.fit.theta, h.fit.x0, iterations=20))
