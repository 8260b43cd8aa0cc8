"""The diagnosis of recordings with a model of any kind: what all rows show, what parts agree on, what is said."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from autotune.controller import Controller
from autotune.diagnosis.agreement import Part, agreement, likely, parts_of
from autotune.diagnosis.equations.gathering_equations import evidence_of_equations
from autotune.diagnosis.findings import alike, consistent, found_effects, places_of, said_by, sentences_of
from autotune.diagnosis.gathering import evidence_of
from autotune.diagnosis.result import Diagnosis, FoundEffect
from autotune.diagnosis.selection.probability import share_of
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.diagnosis.verdict import Evidence, judged
from autotune.effects import require_known
from autotune.equations.files import AnyModel
from autotune.errors import InputError
from autotune.identification.answer import require_two_signals
from autotune.models import Model
from autotune.one_thread import on_one_thread
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
#: Share of the work that the whole recordings take; on parts of them nothing is searched.
WHOLE = 0.6


@on_one_thread
def diagnose(
    model: AnyModel,
    recordings: Sequence[Recording],
    controller: Controller | None = None,
    without: Sequence[str] = (),
    progress: Progress = quiet,
    thresholds: Thresholds = IN_USE,
) -> Diagnosis:
    """Find where and why recordings differ from the simulation of a model.

    Parameters
    ----------
    model : Model, EquationModel or BlackBox
        The nominal chain, equations (with one input or several), or a closed model such as an FMU. Effects that it has
        are its structure: their numbers are retuned like its others, and they are not found again.
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
        No recording, fewer than 100 rows, u that is not finite, a time that is nearly all gaps, a column that is
        missing, an effect of the model that no catalogue has, or a model that runs away.
    IdentificationError
        A y that is a copy of u.
    """
    require_known(model.effects, model.name, in_chain=isinstance(model, Model))
    _require_rows(recordings)
    without = [*without, *(effect.name for effect in model.effects)]
    order = _most_telling_first(recordings)
    found = _in_order(model, [recordings[i] for i in order], controller, without, progress, thresholds)
    effects = (
        replace(e, windows=tuple((order[i], first, last) for i, first, last in e.windows)) for e in found.effects
    )
    return replace(found, effects=tuple(effects), order=order)


def _most_telling_first(recordings: Sequence[Recording]) -> tuple[int, ...]:
    """Return the recordings' numbers, longer ones first, then those whose y goes to and fro more.

    In whatever order and units they are given the diagnosis is the same, to the last digit of its sums.
    """

    def tells(i: int) -> tuple[int, float]:
        y = recordings[i].y[np.isfinite(recordings[i].y)]
        return y.size, float(np.sum(np.abs(np.diff(y))) / max(np.ptp(y), np.finfo(float).tiny))

    return tuple(sorted(range(len(recordings)), key=tells, reverse=True))


def _in_order(
    model: AnyModel,
    recordings: Sequence[Recording],
    controller: Controller | None,
    without: Sequence[str],
    progress: Progress,
    thresholds: Thresholds,
) -> Diagnosis:
    """Return the diagnosis of recordings in the order that it takes them in."""

    def told(what: str, done: float) -> None:
        progress(what, WHOLE * done)

    evidence: Evidence
    if isinstance(model, Model):
        evidence = evidence_of(model, recordings, controller, without, told, thresholds)
    else:
        evidence = evidence_of_equations(model, recordings, controller, without, told, thresholds)
    if columns := evidence.misread_columns():
        return _diagnosis(evidence.keeping(()), columns)
    alone = evidence.keeping(likely(said_by(evidence)))
    said_alone, found = said_by(alone), found_effects(alone, judged(alone))
    if not found:
        return _diagnosis(alone.keeping(()), said=said_alone)
    parts = parts_of(recordings, LEAST_ROWS)
    progress("once more on parts of the rows", WHOLE)
    there = [_told_by(part, alone) for part in parts]
    begins = {e.name: _begins(e, recordings) for e in found}
    said = agreement(said_alone, begins, parts, [told_there for told_there, _ in there], 0.0, thresholds)
    agreed = evidence.keeping(likely(said))
    # what no part agrees on was found all the same, and may be what follows y whatever the command does
    explains = agreed if judged(agreed) == "effect" else alone
    if unheeded := explains.unheeded_commands():
        return _diagnosis(agreed.keeping(()), unheeded)
    named = _names(agreed, said)
    nearer = agreed.predicting([errors for _, errors in there]) if named else agreed
    if nearer is not agreed and _names(nearer, said) == named:
        found_nearer = _diagnosis(nearer, said=said, kept=likely(said))
        if not found_nearer.withheld:
            return found_nearer
    return _diagnosis(agreed, said=said, kept=likely(said))


def _names(evidence: Evidence, said: Mapping[str, float]) -> frozenset[str]:
    """Return the effects that are named; none where the verdict is another."""
    verdict = judged(evidence)
    found = found_effects(evidence, verdict) if verdict == "effect" else ()
    return likely(said) & {e.name for e in found}


def _diagnosis(
    evidence: Evidence, instead: str = "", said: Mapping[str, float] = MappingProxyType({}), kept: Collection[str] = ()
) -> Diagnosis:
    """Return what evidence says; where a sentence is said instead no physics is said to be missing."""
    verdict = "unexplained" if instead else judged(evidence)
    named = [e for e in found_effects(evidence, verdict) if e.name in kept]
    own = {name: p * share_of(name, evidence.candidates) for name, p in said.items()}
    others = {name: p for name, p in own.items() if name not in {e.name for e in named}}
    ruled_out = 1.0 - evidence.limits.decided
    stated = (
        replace(e, probability=own[e.name], alike=alike(e.name, others, ruled_out), together=said[e.name])
        for e in named
    )
    # the surest first by what all sets of rows say; about as sure ones stay by how much they explain
    effects = tuple(sorted(stated, key=lambda e: -round(e.probability, 1)))
    description = evidence.description() if verdict == "unexplained" and not instead else None
    places = () if instead else places_of(evidence, effects, description)
    handed_out, wanted = evidence.handed_out("none" if instead else verdict)
    withheld = ""
    if handed_out is not wanted and verdict != "unexplained":
        withheld = WITHHELD[handed_out is evidence.model]
    first, *rest = (instead,) if instead else sentences_of(verdict, effects, evidence, places, own)
    unsaid = evidence.unsaid if verdict in ("effect", "unexplained") and not instead else ""
    return Diagnosis(
        verdict=verdict,
        effects=effects,
        candidates=() if instead else consistent(evidence.candidates, said, evidence.names),
        places=places,
        fit=evidence.quality,
        extended_model=handed_out,
        sentences=(first, *(one for one in (unsaid, withheld) if one), *rest),
        is_clean=evidence.is_clean,
        residual=evidence.residual,
        search=evidence.result,
        description=description,
        withheld=withheld,
    )


def _begins(effect: FoundEffect, recordings: Sequence[Recording]) -> list[tuple[int, float]]:
    """Return recordings and times [s] at which an effect begins to act, if it does not from the first row on."""
    return [(i, start) for i, start, _ in effect.windows if start > float(recordings[i].t[0])]


def _told_by(part: Part, whole: Evidence) -> tuple[Mapping[str, float], Mapping[frozenset[object], float]]:
    """Return what a part says, NaN of what it cannot tell, and errors there; nothing where no simulation runs."""
    there, untold = whole.on(part)
    return ({}, {}) if there is None else (said_by(there) | dict.fromkeys(untold, math.nan), there.errors)


def _require_rows(recordings: Sequence[Recording]) -> None:
    if not recordings:
        raise InputError("no recording", where="diagnose", remedy="give at least one")
    for r in recordings:
        r.require_finite(("u",))
        r.require_dense()
        if len(r) < LEAST_ROWS or np.isfinite(r.y).sum() < LEAST_ROWS:
            raise InputError(f"{len(r)} rows", where=r.name, remedy="a diagnosis needs at least 100 finite readings")
        require_two_signals(r)
