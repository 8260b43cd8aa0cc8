"""All that recordings show of a chain: samples, what a search finds, and what is beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial

from autotune.arrays import BoolArray
from autotune.controller import Controller
from autotune.diagnosis.chain_evidence import ChainEvidence
from autotune.diagnosis.evidence.adequacy import residual_tests
from autotune.diagnosis.evidence.held_out import held_out, noise_floor
from autotune.diagnosis.evidence.jitter import jitter_effect
from autotune.diagnosis.evidence.late_rows import late_rows
from autotune.diagnosis.evidence.law import law_effect
from autotune.diagnosis.evidence.operating_point import offset_of, unmoved
from autotune.diagnosis.evidence.own_noise import own_noise
from autotune.diagnosis.evidence.sample_gain import SimulatedRows, is_material, rows_of, select_supported
from autotune.diagnosis.evidence.samples import JITTER, SampleEffect, unspoiled_rows
from autotune.diagnosis.evidence.spoiled_rows import clear_samples, search_beside
from autotune.diagnosis.evidence.stamps import even_stamps
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit
from autotune.diagnosis.fitting.retuning import at_nominal, prepare, under_noise
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.selection.hypothesis import Hypothesis
from autotune.diagnosis.selection.judged_chain import JudgedChain, as_search, gained, quality
from autotune.diagnosis.selection.search import Found
from autotune.diagnosis.selection.searched import Search
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of
from autotune.models import Model
from autotune.progress import Progress, quiet
from autotune.recording import Recording


def evidence_of(
    model: Model,
    recordings: Sequence[Recording],
    controller: Controller | None,
    without: Sequence[str],
    progress: Progress,
    thresholds: Thresholds,
    known: Sequence[JudgedChain] | None = None,
) -> ChainEvidence:
    """Return all that the verdict rests on: samples, search, what is beside the chain, the residual, held-out rows.

    Parameters
    ----------
    model, recordings, controller, without, progress, thresholds
        As in :func:`autotune.diagnosis.diagnose.diagnose`.
    known : sequence of JudgedChain, optional
        Hypotheses of more rows: they are judged, each from the numbers that it had there, and nothing is searched.
    """
    given, without = without, [*without, *unmoved(model, recordings)]

    progress("looking at the samples", 0.0)
    if any(kind_of(effect.name).late_stamps for effect in model.effects):
        recordings, late = [r.at_even_times() for r in recordings], None
    else:
        recordings, late = even_stamps(model, recordings, thresholds)
    own = {effect.name for effect in model.effects}

    retuned_rows = partial(_retuned_rows, model, recordings, thresholds)
    searched = partial(_searched, model, recordings, without, progress, thresholds, known)
    seen = clear_samples(recordings, [name for name in without if name not in own], thresholds, retuned_rows)
    (near, found), seen = search_beside(searched, seen, without)
    seen = [s for s in seen if s.name not in own]
    progress("checking on held-out rows", 0.9)

    def beside(result: Fit, data: Data) -> list[SampleEffect]:
        jitter, law = late, law_effect(recordings, controller, thresholds)
        if jitter is None and JITTER not in (*without, *_excluded(seen)):
            jitter = jitter_effect(result, data)
        return [s for s in (jitter, law) if s is not None and (s is late or s.name not in without)]

    retuned, data = near.retuned.fit, near.data
    samples = (*select_supported(seen, rows_of(retuned, data)), *beside(retuned, data))
    evidence = ChainEvidence(
        model=model,
        again=lambda part, more, known: evidence_of(model, part, controller, [*given, *more], quiet, thresholds, known),
        search=near,
        samples=samples,
        residual=residual_tests(retuned, data, uneven=any(kind_of(s.name).uneven for s in samples)),
        quality_of=cache(lambda: held_out(retuned, data)),
        offset=None if unmoved(model, recordings) else offset_of(retuned, thresholds.beyond_chance),
        evened=late is not None,
    )
    if found is None or (evidence.residual.uneven and evidence.residual.is_noise):
        return evidence  # noise of some rows explains all: it disturbs commands too, and beside it nothing is named
    if found.chosen.names:
        chosen = found.chosen.fit, found.chosen.data
        rows = rows_of(*chosen)
        samples = (*select_supported(seen, rows), *beside(chosen[0], under_noise(*chosen)))
        evidence = replace(evidence, samples=tuple(s for s in samples if is_material(s, rows)))
    return _with_found(evidence, found, without)


def _retuned_rows(
    model: Model, recordings: Sequence[Recording], limits: Thresholds, good: Sequence[BoolArray]
) -> SimulatedRows | None:
    """Return the rows that the retuned model simulates; nothing where it runs away."""
    try:
        data, retuned = prepare(model, recordings, good, limits)
    except RUNAWAY:
        return None
    return rows_of(retuned, data)


def _searched(
    model: Model,
    recordings: Sequence[Recording],
    without: Sequence[str],
    progress: Progress,
    limits: Thresholds,
    known: Sequence[JudgedChain] | None,
    seen: list[SampleEffect],
) -> tuple[tuple[Search, Found[JudgedChain] | None], SimulatedRows]:
    """Return the retuned model near the noise, what was found beside it, and the rows that the best one simulates.

    Nothing is found where every simulation runs away.
    """
    good, names = unspoiled_rows(recordings, seen), [*without, *(effect.name for effect in seen)]
    progress("retuning", 0.0)
    data, retuned = prepare(model, recordings, good, limits)
    alone = Hypothesis(names=(), fit=retuned)
    near = Search(data=data, nominal=at_nominal(retuned, data), retuned=alone, chosen=alone)
    try:
        found = search_chain(model, recordings, good, names, progress, limits, known)
    except RUNAWAY:
        return (near, None), rows_of(retuned, data)
    return (near, found), rows_of(found.chosen.fit, found.chosen.data)


def _with_found(evidence: ChainEvidence, found: Found[JudgedChain], without: Sequence[str]) -> ChainEvidence:
    """Return the evidence with what a search found; as it was where what is left needs no effect."""
    chosen, near = found.chosen, evidence.search
    if not chosen.leaves_noise and (late := _late_rows(evidence, gained(found), without)) is not None:
        return late
    if not chosen.names and evidence.residual.is_noise:
        return replace(evidence, search=as_search(found), found=found)
    if not chosen.names and (own := own_noise(near.retuned.fit, near.data)) is not None:
        # such a disturbance has a mean of its own in every recording: it is no offset
        return replace(evidence, residual=own.residual, offset=None, own=own, found=found)
    limits, residual = evidence.limits, evidence.residual
    offset = None
    if chosen.names and chosen.leaves_noise:
        residual = residual_tests(chosen.fit, under_noise(chosen.fit, chosen.data), uneven=residual.uneven)
        offset = offset_of(chosen.fit, limits.beyond_chance)
    floor = noise_floor(near.retuned.fit, near.data)
    return replace(
        evidence, search=as_search(found), residual=residual, quality_of=lambda: quality(found, floor), offset=offset,
        found=found,
    )  # fmt: skip


def _late_rows(evidence: ChainEvidence, gained: float, without: Sequence[str]) -> ChainEvidence | None:
    """Return the evidence where rows that are late, and their commands with them, explain more than effects gained."""
    if evidence.evened or evidence.residual.is_noise or JITTER in (*without, *_excluded(evidence.samples)):
        return None
    late = late_rows(evidence.search.retuned.fit, evidence.search.data)
    if late is None or late.evidence < gained:
        return None
    samples = (*(s for s in evidence.samples if s.name != JITTER), late)
    return replace(evidence, samples=samples, residual=replace(evidence.residual, accounted=True), offset=None)


def _excluded(seen: Sequence[SampleEffect]) -> set[str]:
    """Return the effects that those seen in the samples exclude."""
    return {name for s in seen for name in kind_of(s.name).excludes}
