"""The diagnosis from recordings and a nominal model: what the whole shows, what its parts agree on, what is said."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from autotune.controller import Controller
from autotune.diagnosis.agreement import Part, agreement, likely, parts_of
from autotune.diagnosis.evidence.description import describe
from autotune.diagnosis.evidence.misread import misread_columns
from autotune.diagnosis.evidence.operating_point import unmoved
from autotune.diagnosis.extended import extended_model
from autotune.diagnosis.findings import OFFSET, found_effects, places_of, said_by, sentences_of
from autotune.diagnosis.gathering import evidence_of, keeping
from autotune.diagnosis.result import Diagnosis, FoundEffect
from autotune.diagnosis.safe_extension import safe_extension
from autotune.diagnosis.simulation.chain import build_chain
from autotune.diagnosis.simulation.forecast import forecast
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.diagnosis.verdict import Evidence, judged
from autotune.effects import KINDS, kind_of, require_known
from autotune.errors import InputError
from autotune.models import Model
from autotune.progress import Progress, quiet
from autotune.recording import Recording

#: Rows that a diagnosis needs.
LEAST_ROWS = 100
#: What is said where the extended model is handed out without what was found: with retuned numbers, or as it was.
WITHHELD = tuple(
    f"extended_model.toml {has}: run freely through the whole recordings, what was found is farther off than the "
    "nominal model, or it runs away on commands twice as large."
    for has in ("has retuned numbers alone", "is the model as it was")
)
#: Share of the work that the whole recordings take; parts of them are searched among fewer effects.
WHOLE = 0.6


def diagnose(
    model: Model,
    recordings: Sequence[Recording],
    controller: Controller | None = None,
    without: Sequence[str] = (),
    progress: Progress = quiet,
    thresholds: Thresholds = IN_USE,
) -> Diagnosis:
    """Find where and why recordings differ from the simulation of a model.

    Parameters
    ----------
    model : Model
        The nominal chain. Effects that it has are its structure: their numbers are retuned like its others, and they
        are not found again.
    recordings : sequence of Recording
        At least one; several with different excitation tell more.
    controller : Controller, optional
        The law that u was computed by; the sidecars' ``[controller]`` by default.
    without : sequence of str
        Effects left out of the catalogue.
    progress : callable
        Told what is being done and the share done, 0 to 1.
    thresholds : Thresholds
        What decides between two findings.

    Returns
    -------
    Diagnosis
        Verdict, effects with probabilities, and the extended model. What to record next is planned by
        :func:`autotune.experiment_design.with_next_experiment`.

    Raises
    ------
    InputError
        No recording, fewer than 100 rows, u that is not finite, a time that is nearly all gaps, or an effect of the
        model that no catalogue has.
    """
    require_known(model.effects, model.name)
    _require_rows(recordings)
    without = [*without, *(effect.name for effect in model.effects)]

    def told(what: str, done: float) -> None:
        progress(what, WHOLE * done)

    evidence = evidence_of(model, recordings, controller, without, told, thresholds)
    if columns := misread_columns(model, recordings, evidence.quality, thresholds):
        return _of_columns(model, keeping(evidence, ()), columns)
    evidence = keeping(evidence, likely(said_by(evidence)))
    begins = {e.name: _begins(e, recordings) for e in found_effects(evidence, judged(evidence))}
    parts = parts_of(recordings, LEAST_ROWS) if begins else ()
    said = _on_parts(evidence, model, controller, without, progress, thresholds)
    agreed = agreement(said_by(evidence), begins, parts, said) if begins else {}
    evidence = keeping(evidence, agreed)
    found, verdict = evidence.search, judged(evidence)
    named = [e for e in found_effects(evidence, verdict) if e.name in agreed]
    effects = tuple(replace(e, probability=agreed[e.name]) for e in named)
    plain = replace(found.data, thresholds=thresholds)
    description = describe(found.retuned.fit, plain) if verdict == "unexplained" else None
    places = places_of(evidence, effects, description)
    wanted = extended_model(evidence, verdict, model)
    handed_out = _handed_out(wanted, evidence, model)
    withheld = "" if handed_out is wanted or verdict == "unexplained" else WITHHELD[handed_out is model]
    first, *rest = sentences_of(verdict, effects, evidence, places)
    return Diagnosis(
        verdict=verdict,
        effects=effects,
        candidates=evidence.candidates,
        places=places,
        fit=evidence.quality,
        next_experiment=None,
        extended_model=handed_out,
        sentences=(first, withheld, *rest) if withheld else (first, *rest),
        withheld=withheld,
        residual=evidence.residual,
        description=description,
        search=found,
    )


def _of_columns(model: Model, evidence: Evidence, sentence: str) -> Diagnosis:
    """Return the diagnosis where u or y is not what the model takes it for: then no physics is said to be missing."""
    return Diagnosis(
        verdict="unexplained",
        effects=(),
        candidates=(),
        places=(),
        fit=evidence.quality,
        next_experiment=None,
        extended_model=model,
        sentences=(sentence,),
        residual=evidence.residual,
        description=None,
        search=evidence.search,
    )


def _begins(effect: FoundEffect, recordings: Sequence[Recording]) -> list[tuple[int, float]]:
    """Return recordings and times [s] at which an effect begins to act, if it does not from the first row on."""
    return [(i, start) for i, start, _ in effect.windows if start > float(recordings[i].t[0])]


def _handed_out(extended: Model, evidence: Evidence, nominal: Model) -> Model:
    """Return the model to go on with: what was found, where that is no danger; else retuned numbers, or the nominal."""
    fitted = evidence.search.retuned.fit.model
    if extended is nominal:
        return nominal
    # a model without what happened at a time of these recordings cannot follow them to their end
    lasting = not any(kind_of(name).at_a_time for name in evidence.search.chosen.names)
    comparable = lasting and bool(np.all(np.linalg.eigvals(build_chain(nominal).A).real < 0.0))
    recordings = evidence.search.data.driving
    return safe_extension((extended, fitted), nominal, recordings, forecast, comparable=comparable)


def _on_parts(
    evidence: Evidence,
    model: Model,
    controller: Controller | None,
    without: Sequence[str],
    progress: Progress,
    thresholds: Thresholds,
) -> Callable[[Part], Mapping[str, float]]:
    """Return what a part of the recordings says of what the whole made a candidate."""
    search, begun = evidence.search, None if evidence.found is None else evidence.found.chosen
    known = {name for h in search.all for name in h.names} | {s.name for s in evidence.samples} | {OFFSET}
    others = [*without, *(name for name in KINDS if name not in known)]

    def said(part: Part) -> Mapping[str, float]:
        progress("once more on a part of the rows", WHOLE)
        part_shows = evidence_of(model, part.recordings, controller, others, quiet, thresholds, begun)
        cannot_tell = set(unmoved(model, part.recordings))
        if part_shows.found is not None:
            fitted = search.chosen.fit
            cannot_tell |= part_shows.found.retuned.unfelt(fitted.model.effects[fitted.parametrisation.own :])
        return said_by(part_shows) | dict.fromkeys(cannot_tell, math.nan)

    return said


def _require_rows(recordings: Sequence[Recording]) -> None:
    if not recordings:
        raise InputError("no recording", where="diagnose", remedy="give at least one")
    for r in recordings:
        r.require_finite(("u",))
        r.require_dense()
        if len(r) < LEAST_ROWS or np.isfinite(r.y).sum() < LEAST_ROWS:
            raise InputError(f"{len(r)} rows", where=r.name, remedy="a diagnosis needs at least 100 finite readings")
