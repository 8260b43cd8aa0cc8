"""All that recordings show: samples, search near the noise, what is beside the chain, search where models err."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from autotune.controller import Controller
from autotune.diagnosis.evidence.adequacy import residual_tests
from autotune.diagnosis.evidence.beside_chain import beside_chain
from autotune.diagnosis.evidence.held_out import held_out
from autotune.diagnosis.evidence.late_rows import JITTER, late_rows
from autotune.diagnosis.evidence.operating_point import offset_of, unmoved
from autotune.diagnosis.evidence.own_noise import OwnNoise, own_noise
from autotune.diagnosis.evidence.sample_gain import is_material, supported
from autotune.diagnosis.evidence.samples import SampleEffect, inspect, outliers_in, spared
from autotune.diagnosis.evidence.stamps import evened
from autotune.diagnosis.evidence.stretches import rms
from autotune.diagnosis.findings import OFFSET
from autotune.diagnosis.fitting.data import as_white
from autotune.diagnosis.fitting.fit import RUNAWAY, fit
from autotune.diagnosis.fitting.long_windows import cut, lengths_of
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.selection.judged import Judged
from autotune.diagnosis.selection.rig_bench import STEPS
from autotune.diagnosis.selection.rig_search import search_rig
from autotune.diagnosis.selection.search import search
from autotune.diagnosis.selection.searched import Search
from autotune.diagnosis.thresholds import Thresholds
from autotune.diagnosis.verdict import Evidence
from autotune.effects import kind_of
from autotune.models import Model
from autotune.progress import Progress
from autotune.recording import Recording


def evidence_of(
    model: Model,
    recordings: Sequence[Recording],
    controller: Controller | None,
    without: Sequence[str],
    progress: Progress,
    thresholds: Thresholds,
    begun: Judged | None = None,
) -> Evidence:
    """Return all that recordings show, near the noise or far from it.

    Parameters
    ----------
    model : Model
        The nominal chain.
    recordings : sequence of Recording
        What was measured.
    controller : Controller, optional
        The law that u was computed by; the sidecars' by default.
    without : sequence of str
        Effects that are not looked for.
    progress : callable
        Told what is being done and the share done, 0 to 1.
    thresholds : Thresholds
        What decides between two findings.
    begun : Judged, optional
        What predicted best on more rows: it is judged as well, with its odds, from the numbers that it had there.
    """
    without = [*without, *unmoved(model, recordings)]
    evidence = _gathered(model, recordings, controller, without, progress, thresholds)
    return _of_rig(evidence, model, without, progress, begun)


def _gathered(
    model: Model,
    recordings: Sequence[Recording],
    controller: Controller | None,
    without: Sequence[str],
    progress: Progress,
    thresholds: Thresholds,
) -> Evidence:
    """Return all that the verdict rests on: samples, search, what is beside the chain, the residual, held-out rows."""
    progress("looking at the samples", 0.0)
    if any(kind_of(effect.name).late_stamps for effect in model.effects):
        recordings, late = [r.at_even_times() for r in recordings], None
    else:
        recordings, late = evened(model, recordings, thresholds)
    own = {effect.name for effect in model.effects}
    seen = _seen(model, recordings, [name for name in without if name not in own], thresholds)
    found, seen = _searched(model, recordings, seen, without, progress, thresholds)
    seen = [s for s in seen if s.name not in own]
    beside = beside_chain(found.retuned.fit, found.data, found.gained, recordings, controller, seen)
    others = [s for s in beside if s.name not in without]
    others = others if late is None else [late, *(s for s in others if s.name != late.name)]
    # where single rows are disturbed, what is left beside them must explain more to be named; beside jitter nothing is
    if any(kind_of(s.name).sought == "residual" for s in others if s is not late):
        found = found.asking(math.inf)
    elif seen:
        found = found.asking(thresholds.samples_sure)
    progress("checking on held-out rows", 0.9)
    chosen = found.chosen.fit
    samples = (*supported(seen, chosen, found.data), *others)
    uneven = any(kind_of(s.name).uneven for s in samples)
    return Evidence(
        search=found,
        samples=samples,
        residual=residual_tests(chosen, found.data, found.gained, uneven=uneven),
        quality=held_out(found.retuned.fit, chosen, found.data),
        offset=None if unmoved(model, recordings) else offset_of(chosen, thresholds.offset_sigmas),
        evened=late is not None,
    )


def _seen(
    model: Model, recordings: Sequence[Recording], without: Sequence[str], limits: Thresholds
) -> list[SampleEffect]:
    """Return what the samples show where the retuned model speaks for it clearly.

    Rows at rest and turning points at one level are readings like any other: what spoils none leaves them to the fits.
    """
    good, seen = inspect(recordings, without, limits)
    if not any(s.rows for s in seen):
        return seen
    try:
        data, retuned = prepare(model, recordings, good, 1, limits)
    except RUNAWAY:
        return seen
    return [s for s in supported(seen, retuned, data) if s.speaks > limits.samples_clear]


def _searched(
    model: Model,
    recordings: Sequence[Recording],
    seen: list[SampleEffect],
    without: Sequence[str],
    progress: Progress,
    limits: Thresholds,
) -> tuple[Search, list[SampleEffect]]:
    """Return the search, and what the samples show; searched again without spikes that its residual alone shows."""

    def searched() -> Search:
        names = [*without, *(effect.name for effect in seen)]
        return search(model, recordings, spared(recordings, seen), names, progress, limits)

    found = searched()
    if "sensor.outliers" in without or any(s.name == "sensor.outliers" for s in seen):
        return found, seen
    data, chosen = found.data, found.chosen.fit
    left = [r.y - signals[:, 0] for r, signals in zip(data.recordings, chosen.signals, strict=True)]
    good = [g & np.isfinite(e) for g, e in zip(data.good, left, strict=True)]
    outliers = outliers_in(left, recordings, good, limits)
    confirmed = [] if outliers is None else supported([outliers], chosen, data)
    if not confirmed:
        return found, seen
    seen = [*seen, *confirmed]
    return searched(), seen


def _of_rig(
    evidence: Evidence, model: Model, without: Sequence[str], progress: Progress, begun: Judged | None
) -> Evidence:
    """Return the evidence of left-out stretches where the model's own error and not noise is what remains."""
    limits, recordings, found = evidence.limits, evidence.search.data.recordings, evidence.search
    barely = bool(found.chosen.names) and evidence.unknown_odds > limits.barely_noise
    refuted = evidence.residual.is_noise and not _runs_free(evidence, model)
    if evidence.residual.is_noise and not barely and not refuted:
        return evidence
    late = _late_rows(evidence, without)
    if late is not None:
        return late
    own = own_noise(found.retuned.fit, found.data)
    good = spared(recordings, evidence.samples)
    seen = [s.name for s in evidence.samples]
    try:
        # a likelihood of noise that is nearly white says nothing beside a disturbance
        stands = bool(found.chosen.names) and evidence.explains_most and not refuted
        known = found.chosen.fit if own is None and stands else None
        rig = search_rig(model, recordings, good, [*without, *seen], progress, limits, known, begun)
    except RUNAWAY:
        return evidence
    if not rig.chosen.names and own is not None:
        return _disturbed(evidence, own)
    if not rig.chosen.names and evidence.residual.has_no_slow_part:
        return _without_effects(evidence)
    fit, data = rig.chosen.fit, rig.chosen.data
    samples = tuple(s for s in supported(evidence.samples, fit, data) if is_material(s, fit, data))
    quality = rig.quality(evidence.quality.noise_floor)
    return replace(evidence, search=rig.as_search(), samples=samples, quality=quality, offset=None, rig=rig)


def _runs_free(evidence: Evidence, model: Model) -> bool:
    """Whether what the chosen effects leave of free runs, as long as the plant allows, is noise too.

    Start states that are free at the beginning of every window soak up what is slow or static: an effect that needs
    them does not explain the recordings. A fit without effects is left to the tests of its residual.
    """
    found, limits = evidence.search, evidence.limits
    if not found.chosen.names:
        return True
    recordings, p, theta = found.data.driving, found.chosen.fit.parametrisation, found.chosen.fit.theta
    length = lengths_of(model, recordings, limits).long
    data = as_white(cut(recordings, spared(recordings, evidence.samples), length, limits), found.data.noise.total_sd)
    try:
        begun = fit(p, data, theta, free=np.zeros(theta.size, dtype=bool), iterations=STEPS)
        free = fit(p, data, begun.theta, begun.x0, iterations=STEPS)
    except RUNAWAY:
        return False
    return (1.0 - limits.material) * rms(free.residuals, data.good) < data.noise.sd


def keeping(evidence: Evidence, names: Collection[str]) -> Evidence:
    """Return the evidence with no other effects than those named: the largest hypothesis of them that was fitted."""
    samples = tuple(s for s in evidence.samples if s.name in names)
    offset = evidence.offset if OFFSET in names else None
    evidence = replace(evidence, samples=samples, offset=offset)
    found, rig = evidence.search, evidence.rig
    if set(found.chosen.names) <= set(names):
        return evidence
    if rig is not None:
        best = max((j for j in rig.judged if set(j.names) <= set(names)), key=lambda j: (len(j.names), -j.fit.cost))
        rig = replace(rig, chosen=best.spread_out())
        return replace(evidence, search=rig.as_search(), quality=rig.quality(evidence.quality.noise_floor), rig=rig)
    left = max((h for h in found.all if set(h.names) <= set(names)), key=lambda h: (len(h.names), -h.penalised_chi2))
    if not left.names:
        return replace(_without_effects(evidence), offset=offset)
    found = replace(found, chosen=left)
    return replace(
        evidence,
        search=found,
        residual=residual_tests(left.fit, found.data, found.gained, uneven=evidence.residual.uneven),
        quality=held_out(found.retuned.fit, left.fit, found.data),
    )


def _without_effects(evidence: Evidence) -> Evidence:
    """Return the evidence where stretches that were left out speak for no effect beside a line in the residual."""
    found, limits = evidence.search.asking(math.inf), evidence.limits
    retuned, uneven = found.retuned.fit, evidence.residual.uneven
    return replace(
        evidence,
        search=found,
        residual=residual_tests(retuned, found.data, 0.0, uneven=uneven),
        quality=held_out(retuned, retuned, found.data),
        offset=None if evidence.offset is None else offset_of(retuned, limits.offset_sigmas),
    )


def _late_rows(evidence: Evidence, without: Sequence[str]) -> Evidence | None:
    """Return the evidence where rows that are late, and their commands with them, leave noise alone."""
    found, excluded = evidence.search, {name for s in evidence.samples for name in kind_of(s.name).excludes}
    if evidence.evened or JITTER in (*without, *excluded):
        return None
    late = late_rows(found.retuned.fit, found.data)
    if late is None or late.evidence < found.gained:
        return None
    plain = _without_effects(evidence)
    samples = (*(s for s in evidence.samples if s.name != JITTER), late)
    return replace(plain, samples=samples, residual=replace(plain.residual, accounted=True), offset=None)


def _disturbed(evidence: Evidence, own: OwnNoise) -> Evidence:
    """Return the evidence where what is left is noise of its own, and stretches that were left out show no effect.

    Such a disturbance has a mean of its own in every recording: it is no offset.
    """
    return replace(_without_effects(evidence), residual=own.residual, offset=None, own=own)
