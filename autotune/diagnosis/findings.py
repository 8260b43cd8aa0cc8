"""What is found, for people: effects with parameters, probabilities and windows, and the model that has them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.effects import kind_of
from autotune.diagnosis.evidence.operating_point import Offset
from autotune.diagnosis.evidence.sample_gain import is_nearer
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.result import FoundEffect, OperatingRange, Verdict
from autotune.diagnosis.selection.hypothesis import Hypothesis
from autotune.diagnosis.selection.probability import Candidate
from autotune.diagnosis.selection.searched import Search
from autotune.diagnosis.thresholds import Thresholds
from autotune.diagnosis.verdict import Evidence
from autotune.models import Effect, Model, Parameter

#: The effect that every fit has as a free number.
OFFSET = "actuator.offset"
Window = tuple[int, float, float]
#: Places beyond a recorded range at which a law is looked at.
_LOOKED = 51


def probability_of(name: str, candidates: Sequence[Candidate], most: float = Thresholds.most_probable) -> float:
    """Return the probability that an effect, or one that cannot be told from it, is part of the truth."""
    group = {name, *kind_of(name).same}
    total = sum(c.probability for c in candidates if group & set(c.name.split("+")))
    return min(max(total, 0.0), most)


def found_effects(evidence: Evidence, verdict: Verdict) -> tuple[FoundEffect, ...]:
    """Return the effects that are named, the most important first; where none explains all, what samples show alone."""
    search, chosen = evidence.search, evidence.search.chosen
    everywhere = tuple((i, float(r.t[0]), float(r.t[-1])) for i, r in enumerate(search.data.recordings))
    if verdict != "effect":
        return tuple(_of_samples(s, everywhere, evidence.limits) for s in evidence.samples)
    effects: list[tuple[float, FoundEffect]] = []
    for effect in _with_uncertainty(chosen, chosen.fit.model.effects)[chosen.fit.parametrisation.own :]:
        effects.append((_lost_without(search, effect.name), _found_effect(effect, evidence, everywhere)))
    effects += [(s.evidence, _of_samples(s, everywhere, evidence.limits)) for s in evidence.samples]
    # what is surer comes first; about as sure ones by how much they explain
    ranked = [e for _, e in sorted(effects, key=lambda pair: (-round(pair[1].probability, 1), -pair[0]))]
    surest = max((e.probability for e in ranked), default=0.0)
    ranked = [e for e in ranked if e.probability >= min(evidence.limits.least_named, surest)]
    if evidence.offset is not None and not any(e.name in kind_of(OFFSET).same for e in ranked):
        ranked.append(_of_offset(evidence.offset, evidence, everywhere))
    return tuple(ranked)


def _of_samples(s: SampleEffect, everywhere: tuple[Window, ...], limits: Thresholds) -> FoundEffect:
    surely = 1.0 / (1.0 + limits.unknown_odds + math.exp(-0.5 * s.speaks))
    return FoundEffect(
        name=s.name,
        probability=surely if s.evidence > limits.samples_sure else min(surely, limits.samples_probable),
        places=(kind_of(s.name).place,),
        parameters=MappingProxyType(s.parameters),
        equation=s.equation,
        windows=s.windows or everywhere,
    )


def _of_offset(offset: Offset, evidence: Evidence, everywhere: tuple[Window, ...]) -> FoundEffect:
    kind, unit = kind_of(OFFSET), evidence.search.chosen.fit.parametrisation.model.input.unit
    return FoundEffect(
        name=OFFSET,
        probability=1.0 / (1.0 + evidence.unknown_odds),
        places=kind.places,
        parameters=MappingProxyType({"offset": Parameter(value=offset.value, sd=offset.sd, unit=unit)}),
        equation=kind.equation,
        windows=everywhere,
    )


def _lost_without(found: Search, name: str) -> float:
    """Return the penalised chi-square that is lost without a chosen effect, as far as that was fitted."""
    rest = frozenset(found.chosen.names) - {name}
    known = {frozenset(h.names): h.penalised_chi2 for h in (found.retuned, *found.singles, *found.pairs)}
    return known.get(rest, found.retuned.penalised_chi2) - found.chosen.penalised_chi2


def _found_effect(effect: Effect, evidence: Evidence, everywhere: tuple[Window, ...]) -> FoundEffect:
    kind, search, windows = kind_of(effect.name), evidence.search, everywhere
    if kind.acts_in is not None:
        number, after = kind.acts_in({key: q.value for key, q in effect.parameters.items()})
        pairs = [(i, r) for i, r in enumerate(search.data.recordings) if number in (-1, i)]
        windows = tuple((i, float(r.t[0] + after), float(r.t[-1])) for i, r in pairs)
    return FoundEffect(
        name=effect.name,
        probability=probability_of(effect.name, evidence.candidates, evidence.limits.most_probable),
        places=kind.may_sit,
        parameters=MappingProxyType(_readable(effect)),
        equation=kind.equation,
        windows=windows,
        operating_range=_range(search, kind.place),
    )


def _readable(effect: Effect) -> Mapping[str, Parameter]:
    """Return an effect's parameters as people name them: limits that do not act are left out."""
    kind = kind_of(effect.name)
    parameters = dict(effect.parameters) if kind.readable is None else kind.readable(effect.parameters)
    values = {name: p.value for name, p in effect.parameters.items()}
    for q in kind.parameters:
        if q.role == "amplitude" and q.held is not None and q.held(values):
            parameters.pop(q.name, None)  # its size is another number's, as gravity's is the spring's
        unfelt = q.role == "limit" and q.name in parameters and not math.isfinite(parameters[q.name].sd)
        if q.role == "mark" or unfelt:
            parameters.pop(q.name, None)
    return parameters


def _with_uncertainty(h: Hypothesis, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Return the effects with the standard deviations of their fit; NaN for a number that the data did not feel.

    A limit that was not felt is none: where it came to rest, further excitation would meet it. One that the nominal
    model has stays: it was not found here.
    """
    result, p = [], h.fit.parametrisation
    sd = np.sqrt(np.maximum(np.diag(h.fit.covariance), 0.0))
    spans: dict[tuple[int, int], float] = {}
    for i, f in enumerate(p.free):
        if f.kind == "effect":
            spans[f.index] = float(sd[i]) * (p.value(i, h.fit.theta) if f.positive else f.size)
    numbers = {e.name: i for i, e in enumerate(p.model.effects)}
    for effect in effects:
        number = numbers.get(effect.name, -1)
        parameters = {
            key: replace(q, sd=spans.get((number, j), math.nan) or math.nan)
            for j, (key, q) in enumerate(effect.parameters.items())
        }
        for q in kind_of(effect.name).parameters:
            given = parameters.get(q.name)
            if number < p.own or q.role != "limit" or q.neutral is None or given is None:
                continue
            if not math.isfinite(given.sd):
                parameters[q.name] = replace(given, value=q.neutral)
        result.append(replace(effect, parameters=MappingProxyType(parameters)))
    return tuple(result)


def _range(found: Search, place: str) -> OperatingRange:
    column, name = {"plant": (2, "position"), "sensor": (0, "y")}.get(place, (3, "plant input"))
    values = np.concatenate([s[:, column] for s in found.chosen.fit.signals])
    return OperatingRange(signal=name, low=float(np.nanmin(values)), high=float(np.nanmax(values)))


def extended_model(evidence: Evidence, verdict: Verdict, nominal: Model) -> Model:
    """Return the model to go on with: the nominal one where nothing is missing, else what explains more."""
    found = evidence.search
    named = evidence.quality.is_better and verdict in ("effect", "unexplained")
    use = found.chosen if named else found.retuned
    stands = evidence.rig is not None and evidence.rig.keeps_nominal(evidence.limits.material_numbers)
    extended = nominal if verdict == "none" or stands else use.fit.model
    own = {e.name for e in nominal.effects}
    if evidence.rig is not None and len(found.data.recordings) == 1:
        # what came at a time of one recording is no property of the rig
        lasting = tuple(e for e in extended.effects if e.name in own or not kind_of(e.name).at_a_time)
        extended = replace(extended, effects=lasting)
    ends = [
        Effect(name=s.name, parameters=s.parameters)
        for s in evidence.samples
        if kind_of(s.name).late_stamps or is_nearer(s, use.fit, evidence.limits.rounding)
    ]
    if extended is nominal and not ends:
        return nominal
    effects = _with_uncertainty(use, extended.effects)
    return replace(
        extended,
        effects=(*(e if e.name in own else _ended(e, use.fit, found.data) for e in effects), *ends),
        input=replace(extended.input, recorded=_span([r.u for r in found.data.recordings])),
        output=replace(extended.output, recorded=_span([r.y for r in found.data.recordings])),
    )


def _ended(effect: Effect, result: Fit, data: Data) -> Effect:
    """Return an effect with the ends of its law: one span beyond what was recorded, nearer where it would turn there.

    Beyond them it adds what it adds there, so that an extended model is bounded wherever the linear one is.
    """
    kind = kind_of(effect.name)
    if kind.goes_on is None:
        return effect
    values = {q.name: q.neutral for q in kind.parameters if q.neutral is not None}
    values |= {key: q.value for key, q in effect.parameters.items()} | {"gain": float(result.sim.chain.gains[0])}
    signal = _signal_of(kind.place, result, data)
    low, high = float(np.nanmin(signal)), float(np.nanmax(signal))
    beyond = np.linspace(0.0, high - low, _LOOKED)
    unit = kind.parameters[-1].unit.format(u=result.model.input.unit, y=result.model.output.unit)
    ends = {
        "low": low - _reach([kind.goes_on(values, low - b) for b in beyond], beyond),
        "high": high + _reach([kind.goes_on(values, high + b) for b in beyond], beyond),
    }
    given = {key: Parameter(value=value, unit=unit) for key, value in ends.items()}
    return replace(effect, parameters=MappingProxyType({**effect.parameters, **given}))


def _signal_of(place: str, result: Fit, data: Data) -> FloatArray:
    """Return the signal that a law of a place goes with, from the operating point on."""
    if place == "actuator":
        return np.concatenate([r.u for r in data.driving]) - result.sim.u_offset
    column, centre = (2, 0.0) if place == "plant" else (0, result.sim.y_offset)
    return np.concatenate([s[:, column] for s in result.signals]) - centre


def _reach(holds: Sequence[bool], beyond: FloatArray) -> float:
    """Return how far from the end of a recorded range something holds without a break."""
    broken = np.flatnonzero(~np.array(holds))
    return float(beyond[-1] if broken.size == 0 else beyond[max(int(broken[0]) - 1, 0)])


def _span(signals: Sequence[FloatArray]) -> tuple[float, float]:
    values = np.concatenate([v[np.isfinite(v)] for v in signals])
    return float(values.min()), float(values.max())
