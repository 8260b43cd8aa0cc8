"""What a diagnosis of equations says: verdict, effects with probabilities, sentences, diagnosis.json.

The steps from what a search found to what is said, and the records of it: the file is a little longer than others.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from autotune.arrays import BoolArray
from autotune.controller import Controller
from autotune.diagnosis.agreement import Part, agreement, parts_of
from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.closed import ClosedBench
from autotune.diagnosis.equations.equation_bench import EquationBench
from autotune.diagnosis.equations.judged import Searched
from autotune.diagnosis.equations.search import search
from autotune.diagnosis.evidence.law import law_effect
from autotune.diagnosis.evidence.readings import converter_step, struck
from autotune.diagnosis.evidence.samples import SampleEffect, inspect, outliers_in, spared, together
from autotune.diagnosis.result import NextExperiment, Verdict
from autotune.diagnosis.selection.judged import of_likely
from autotune.diagnosis.selection.probability import Candidate, probability_of
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.effects import KINDS, kind_of
from autotune.equations.black_box import BlackBox
from autotune.equations.effects import equation_of, where_told
from autotune.equations.identifiability import undetermined
from autotune.equations.model import EquationModel
from autotune.errors import InputError
from autotune.models import Effect
from autotune.progress import Progress, quiet
from autotune.recording import Recording

#: Finite readings that a diagnosis needs.
LEAST_ROWS = 100
#: Held-out error, as a share of the spread of y, from which on a simulation follows nothing: 1 is y's mean.
ASTRAY = 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationDiagnosis:
    """Outcome of a diagnosis of equations.

    Attributes
    ----------
    verdict : str
        ``none``, ``parameters``, ``effect`` or ``unexplained``.
    effects : tuple of Effect
        What was added, the most important first.
    probabilities : tuple of float
        Of each of them.
    samples : tuple of SampleEffect
        What single rows show.
    candidates : tuple of Candidate
        Hypotheses with their probabilities.
    places : tuple of str
        Where the mismatch sits.
    errors : tuple of float
        Held-out errors over the spread of y: nominal, retuned, extended, noise.
    extended_model : EquationModel
        The model to go on with.
    sentences : tuple of str
        The finding in words.
    searched : Searched
        All hypotheses.
    recordings : tuple of Recording
        What was measured.
    next_experiment : NextExperiment, optional
        What would decide between what is left.
    """

    verdict: Literal["none", "parameters", "effect", "unexplained"]
    effects: tuple[Effect, ...]
    probabilities: tuple[float, ...]
    samples: tuple[SampleEffect, ...]
    candidates: tuple[Candidate, ...]
    places: tuple[str, ...]
    errors: tuple[float, float, float, float]
    extended_model: EquationModel | BlackBox
    sentences: tuple[str, ...]
    searched: Searched
    recordings: tuple[Recording, ...]
    next_experiment: NextExperiment | None = None

    @property
    def equations(self) -> EquationModel:
        """The extended model's equations; of a closed model the shell that its effects act in."""
        model = self.extended_model
        return model if isinstance(model, EquationModel) else model.shell()

    def as_json(self) -> dict[str, Any]:
        """Return the content of diagnosis.json."""
        whole = [[i, float(r.t[0]), float(r.t[-1])] for i, r in enumerate(self.recordings)]
        model = self.equations
        return {
            "schema": 1,
            "verdict": self.verdict,
            "effects": [
                _effect_table(e, p, _sits(e, self.searched), model, whole)
                for e, p in zip(self.effects, self.probabilities, strict=True)
            ] + [_sample_table(s, whole) for s in self.samples],
            "candidates": [{"name": c.name, "probability": round(c.probability, 4)} for c in self.candidates],
            "places": list(self.places),
            "fit": {"metric": "nrmse", "held_out": True}
            | dict(zip(("nominal", "retuned", "extended", "noise_floor"), self.errors, strict=True)),
            "parameters": {
                p.name: {"value": float(v), "sd": float(s), "nominal": float(n.value), "unit": p.unit}
                for p, v, s, n in zip(
                    self.searched.chosen.fitted.compiled.parameters, self.searched.chosen.fitted.parameters,
                    self.searched.chosen.fitted.sd, self.searched.nominal.fitted.compiled.parameters, strict=False,
                )
            },
            "undetermined": [one.sentence for one in undetermined(self.searched.retuned.fitted)],
            "next_experiment": None if self.next_experiment is None else asdict(self.next_experiment),
        }  # fmt: skip

    def write(self, path: Path) -> None:
        """Write diagnosis.json."""
        path.write_text(json.dumps(self.as_json(), indent=2) + "\n", encoding="utf-8")


def _effect_table(
    e: Effect, p: float, places: tuple[str, ...], model: EquationModel, whole: list[list[float]]
) -> dict[str, Any]:  # fmt: skip
    shown = {k: q for k, q in e.parameters.items() if np.isfinite(q.sd) and q.sd != 0.0} or dict(e.parameters)
    return {
        "name": e.name, "probability": round(p, 4), "places": list(places),
        "parameters": {
            k: {"value": q.value, "sd": q.sd if np.isfinite(q.sd) else None, "unit": q.unit} for k, q in shown.items()
        },
        "state": e.state or None, "input": e.input or None, "port": e.port or None, "column": e.column or None,
        "equation": equation_of(model, e), "windows": whole,
    }  # fmt: skip


def _sample_table(s: SampleEffect, whole: list[list[float]]) -> dict[str, Any]:
    return {
        "name": s.name, "probability": 0.97, "places": [kind_of(s.name).place],
        "parameters": {k: {"value": q.value, "sd": q.sd if np.isfinite(q.sd) else None, "unit": q.unit}
                       for k, q in s.parameters.items()},
        "state": None, "input": None, "port": None, "column": None, "equation": s.equation,
        "windows": [list(w) for w in s.windows] or whole,
    }  # fmt: skip


def _places(name: str) -> tuple[str, ...]:
    return kind_of(name).may_sit


def _sits(effect: Effect, found: Searched) -> tuple[str, ...]:
    """Return where an effect may sit, and where one does that is the same as it on these recordings."""
    places, same = dict.fromkeys(_places(effect.name)), kind_of(effect.name).same
    rivalling = 2.0 * math.log(found.limits.decided / (1.0 - found.limits.decided))
    for one in found.judged:
        if one.names and one.names[-1] in same and one.behind(found.taken) < rivalling:
            places |= dict.fromkeys(_places(one.names[-1]))
    return tuple(places)


def diagnose_equations(
    model: EquationModel | BlackBox,
    recordings: Sequence[Recording],
    without: Sequence[str] = (),
    progress: Progress = quiet,
    controller: Controller | None = None,
    thresholds: Thresholds = IN_USE,
) -> EquationDiagnosis:
    """Find where and why recordings differ from the simulation of equations.

    Parameters
    ----------
    model : EquationModel
        The nominal model. Effects that it has are its structure: retuned like its other numbers, not found again.
    recordings : sequence of Recording
        At least one; several with different excitation tell more.
    without : sequence of str
        Effects that are left out.
    progress : callable
        Told what is being done and the share done, 0 to 1.
    controller : Controller, optional
        The law that u was computed by; the sidecars' ``[controller]`` by default.
    thresholds : Thresholds
        What decides between two findings.

    Returns
    -------
    EquationDiagnosis
        Verdict, effects with probabilities, and the extended model.

    Raises
    ------
    InputError
        No recording, fewer than 100 readings, a missing column, or a model that runs away.
    """
    if not recordings:
        raise InputError("no recording", where="diagnose", remedy="give at least one")
    for one in recordings:
        if np.isfinite(one.y).sum() < LEAST_ROWS:
            raise InputError(f"{len(one)} rows", where=one.name, remedy="a diagnosis needs at least 100 readings")
        one.require_dense()
    good, seen = inspect(recordings, without, thresholds)
    if converter_step(np.concatenate([r.y for r in recordings])) > 0.0:
        # no simulation is asked here, and behind a converter equal readings are no dropout
        good, seen = spared(recordings, ()), [one for one in seen if not one.rows]
    law = law_effect(recordings, controller, thresholds)
    if law is not None and law.evidence > thresholds.samples_sure:
        seen.append(law)
    own = {*without, *(effect.name for effect in model.effects)}
    seen = [one for one in seen if one.name not in own]
    bench, found, seen = _searched(model, recordings, good, seen, without, progress, thresholds)
    agreed = _agreed(model, bench, found, [*without, *(s.name for s in seen)], progress)
    found = _keeping(found, agreed)
    progress("checking on held-out rows", 0.95)
    errors = _held_out(bench, found)
    return _judged(model, recordings, found, agreed, tuple(seen), errors)


def _bench(model: EquationModel | BlackBox, recordings: Sequence[Recording], good: Sequence[BoolArray]) -> Bench:
    kind = ClosedBench if isinstance(model, BlackBox) else EquationBench
    bench: Bench = kind(model, recordings, good)  # type: ignore[arg-type]  # each kind has its bench
    return bench


def _said_by(found: Searched) -> dict[str, float]:
    """Return the probabilities of all effects that are in a hypothesis."""
    candidates = found.candidates(found.limits.unknown_odds)
    return {name: probability_of(name, candidates) for one in found.judged for name in one.names}


def _agreed(
    model: EquationModel | BlackBox, bench: Bench, found: Searched, without: Sequence[str], progress: Progress
) -> Mapping[str, float]:
    """Return the effects that all rows and the parts that leave some out agree on, with their probabilities."""
    whole = _said_by(found)
    if not found.best.names:
        return {}
    others = [*without, *(name for name in KINDS if name not in whole)]

    def said(part: Part) -> Mapping[str, float]:
        progress("once more on a part of the rows", 0.9)
        small = _bench(model, part.recordings, [np.isfinite(r.y) for r in part.recordings])
        try:
            here = search(small, others, quiet, found.limits, found.best.outcome)
            unfelt = [e.name for e in found.best.outcome.effects[found.best.own :] if not _is_felt(e, small, here)]
        except InputError:  # nothing runs there
            return {}
        return _said_by(here) | dict.fromkeys(unfelt, math.nan)

    return agreement(whole, {}, parts_of(bench.recordings, LEAST_ROWS), said)


def _is_felt(effect: Effect, bench: Bench, found: Searched) -> bool:
    """Whether an effect changes what recordings read by as much as one row's noise: of others they tell nothing."""
    change = bench.with_trial(found.retuned, effect)
    return change is None or float(change @ change) > found.noise.total_sd**2


def _keeping(found: Searched, names: Collection[str]) -> Searched:
    """Return a search with no other effects taken than those named: the hypothesis of them that was fitted."""
    if set(found.best.names) <= set(names):
        return found
    return replace(found, taken=of_likely(found.judged, names))


def _searched(
    model: EquationModel | BlackBox, recordings: Sequence[Recording], good: list[BoolArray], seen: list[SampleEffect],
    without: Sequence[str], progress: Progress, limits: Thresholds,
) -> tuple[Bench, Searched, list[SampleEffect]]:  # fmt: skip
    """Return the search, and what the samples show; searched again without spikes that its residual alone shows.

    Where the reading moves from row to row by as much as its spikes, it shows only the largest of them, or none.
    """

    def searched() -> tuple[Bench, Searched]:
        bench = _bench(model, recordings, good)
        return bench, search(bench, [*without, *(s.name for s in seen)], progress, limits)

    bench, found = searched()
    left = found.chosen.fitted.residuals
    known = [ok & np.isfinite(e) for ok, e in zip(good, left, strict=True)]
    outliers = outliers_in(left, recordings, known, limits)
    if outliers is None or outliers.name in (*without, *(effect.name for effect in model.effects)):
        return bench, found, seen
    beside = [struck(e, ok, limits.spike) for e, ok in zip(left, known, strict=True)]
    outliers = replace(outliers, rows=tuple(a | b for a, b in zip(outliers.rows, beside, strict=True)))
    good = [ok & ~rows for ok, rows in zip(good, outliers.rows, strict=True)]
    before = [one for one in seen if one.name == outliers.name]
    seen = [*(one for one in seen if one.name != outliers.name), together([*before, outliers])]
    return (*searched(), seen)


def _judged(
    model: EquationModel | BlackBox, recordings: Sequence[Recording], found: Searched, agreed: Mapping[str, float],
    seen: tuple[SampleEffect, ...], errors: tuple[float, float, float, float],
) -> EquationDiagnosis:  # fmt: skip
    added, limits, retuned = found.chosen.effects[len(model.effects) :], found.limits, found.judged[0]
    nominal_error, retuned_error, extended_error, _ = errors
    predicts = extended_error <= max(nominal_error, retuned_error) and extended_error < ASTRAY
    verdict: Verdict
    if (added and predicts) or (seen and found.variance_ratio(found.chosen) < limits.equation_astray):
        verdict = "effect"
    elif added or not retuned.leaves_noise:
        verdict = "unexplained"
    elif found.score(found.nominal) - found.score(found.retuned) > limits.numbers_decrease:
        verdict = "parameters"
    else:
        verdict = "none"
    candidates = found.candidates(1.0 if verdict == "unexplained" else limits.unknown_odds)
    named = tuple(added) if verdict == "effect" else ()
    places = dict.fromkeys(p for e in named for p in _sits(e, found)) | dict.fromkeys(
        kind_of(s.name).place for s in seen
    )
    if verdict == "unexplained":
        places = dict.fromkeys(_places(found.tried[0].effects[-1].name) if found.tried else ("plant",))
    use = found.chosen if added and predicts else found.retuned
    extended = model if verdict == "none" else _with_numbers(model, use)
    said = tuple(agreed[e.name] for e in named)
    return EquationDiagnosis(
        verdict=verdict, effects=named, probabilities=said,
        samples=seen if verdict == "effect" else (), candidates=candidates, places=tuple(places), errors=errors,
        extended_model=extended, searched=found, recordings=tuple(recordings),
        sentences=_sentences(verdict, list(zip(named, said, strict=True)), seen, tuple(places), errors, found),
    )  # fmt: skip


def _with_numbers(model: EquationModel | BlackBox, outcome: Outcome) -> EquationModel | BlackBox:
    """Return a model with the numbers and effects of a fit."""
    own = len(model.parameters)
    values = outcome.fitted.parameters[:own]
    if isinstance(model, BlackBox):
        numbers = tuple(replace(p, value=float(v)) for p, v in zip(model.parameters, values, strict=True))
        return replace(model, parameters=numbers, effects=outcome.effects)
    inputs = [one for one in outcome.fitted.compiled.model.inputs if one.column not in model.columns]
    used = tuple(one for one in inputs if any(one.column == e.column for e in outcome.effects))
    return replace(model.with_parameters(values), inputs=(*model.inputs, *used), effects=outcome.effects)


def _sentences(
    verdict: str, named: Sequence[tuple[Effect, float]], seen: Sequence[SampleEffect],
    places: Sequence[str], errors: tuple[float, float, float, float], found: Searched,
) -> tuple[str, ...]:  # fmt: skip
    numbers = ("Held-out error, as a share of the spread of y: nominal {:.3g}, retuned {:.3g}, extended {:.3g}, "
               "noise {:.3g}.").format(*errors)  # fmt: skip
    unknown = tuple(f"{one.sentence[0].upper()}{one.sentence[1:]}." for one in undetermined(found.retuned.fitted))
    match verdict:
        case "none":
            first = "The simulation explains the recordings to within noise."
        case "parameters":
            first = "The structure is right, its numbers are not: retuned, the simulation explains the recordings."
        case "effect":
            told = [f"{e.name} at {where_told(e)} (probability {p:.2f})" for e, p in named]
            first = f"Physics was left out: {' and '.join([*told, *(s.name for s in seen)])}."
        case _:
            first = (
                f"Something is missing that no candidate explains to within noise; it shows at the {', '.join(places)}."
            )
    return (first, *unknown, numbers)


def _held_out(bench: Bench, found: Searched) -> tuple[float, float, float, float]:
    """Return errors on the last third of every recording, the numbers fitted to the rest."""
    spread = float(np.nanstd(np.concatenate([r.y for r in bench.recordings]))) or 1.0
    noise = found.noise.total_sd / spread
    return (*(bench.held_out_error(one, one is not found.nominal) / spread
              for one in (found.nominal, found.retuned, found.chosen)), noise)  # type: ignore[return-value]  # fmt: skip
