"""What is found, for people: effects with parameters, probabilities and windows, places, sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from autotune.diagnosis.evidence.description import Description
from autotune.diagnosis.evidence.operating_point import Offset
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.extended import with_uncertainty
from autotune.diagnosis.result import FoundEffect, OperatingRange, Verdict
from autotune.diagnosis.selection.probability import probability_of
from autotune.diagnosis.selection.searched import Search
from autotune.diagnosis.thresholds import Thresholds
from autotune.diagnosis.verdict import Evidence, judged
from autotune.effects import KINDS, STRUCTURES, counted_as, kind_of
from autotune.models import Effect, Parameter

#: The effect that every fit has as a free number.
OFFSET = "actuator.offset"
Window = tuple[int, float, float]


def found_effects(evidence: Evidence, verdict: Verdict) -> tuple[FoundEffect, ...]:
    """Return the effects that are named, the most important first; where none explains all, what samples show alone."""
    search, chosen = evidence.search, evidence.search.chosen
    everywhere = tuple((i, float(r.t[0]), float(r.t[-1])) for i, r in enumerate(search.data.recordings))
    if verdict != "effect":
        return tuple(_of_samples(s, everywhere, evidence.limits) for s in evidence.samples)
    effects: list[tuple[float, FoundEffect]] = []
    for effect in with_uncertainty(chosen, chosen.fit.model.effects)[chosen.fit.parametrisation.own :]:
        if effect.name in evidence.contradicted or effect.name in STRUCTURES:
            continue
        effects.append((_lost_without(search, effect.name), _found_effect(effect, evidence, everywhere)))
    effects += [(s.evidence, _of_samples(s, everywhere, evidence.limits)) for s in evidence.samples]
    # what is surer comes first; about as sure ones by how much they explain
    ranked = [e for _, e in sorted(effects, key=lambda pair: (-round(pair[1].probability, 1), -pair[0]))]
    if evidence.offset is not None and not any(e.name in kind_of(OFFSET).same for e in ranked):
        ranked.append(_of_offset(evidence.offset, evidence, everywhere))
    return tuple(ranked)


def said_by(evidence: Evidence) -> dict[str, float]:
    """Return the probabilities of all effects that are in a hypothesis, and of those that samples show."""
    most, candidates = evidence.limits.most_probable, evidence.candidates
    names = {name for c in candidates for name in c.name.split("+") if name in KINDS}
    names |= {smaller for name in names for smaller in KINDS[name].includes}
    allowed = names - evidence.contradicted - STRUCTURES.keys()
    shown = {e.name: e.probability for e in found_effects(evidence, judged(evidence))}
    # rows that leave too much open for a verdict still weigh what it may be
    return {name: probability_of(name, candidates, most) for name in allowed} | shown


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
    known = {frozenset(h.names): h.penalised_chi2 for h in reversed(found.all)}
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


def _range(found: Search, place: str) -> OperatingRange:
    column, name = {"plant": (2, "position"), "sensor": (0, "y")}.get(place, (3, "plant input"))
    values = np.concatenate([s[:, column] for s in found.chosen.fit.signals])
    return OperatingRange(signal=name, low=float(np.nanmin(values)), high=float(np.nanmax(values)))


def places_of(evidence: Evidence, effects: Sequence[FoundEffect], description: Description | None) -> tuple[str, ...]:
    """Return where the mismatch sits: where its effects may, else where what is missing shows."""
    if description is None:
        return tuple(dict.fromkeys(place for e in effects for place in e.places))
    known: dict[str, None] = {description.place: None} if description.terms else {}
    if not evidence.residual.is_constant:
        informative = known if description.explained > evidence.limits.informative else {}
        return tuple(dict.fromkeys(evidence.residual.varies.places) | informative)
    places: dict[str, None] = dict(known)
    for h in evidence.search.others[:3]:
        for kind in h.kinds:
            places |= dict.fromkeys(kind.may_sit)
    return tuple(places) or ("plant",)


def beside(effects: Sequence[FoundEffect], evidence: Evidence) -> str:
    """Return what is said of effects that predict, and that readings contradict."""
    unnamed = evidence.contradicted - {e.name for e in effects}
    if not unnamed:
        return ""
    what = "must be something else: readings scatter on where it would hold them still"
    return f" The extended model predicts with {' and '.join(sorted(unnamed))} as well, which {what}."


def left_open(effects: Sequence[FoundEffect], evidence: Evidence) -> tuple[str, ...]:
    """Return what is said of effects that are not named and that the recordings do not rule out."""
    named = {like for e in effects for like in counted_as(e.name)}
    able = {n: p for n, p in said_by(evidence).items() if n not in named and p >= 1.0 - evidence.limits.decided}
    likeliest = sorted(able, key=lambda name: -able[name])[: evidence.limits.most_open]
    told = ", ".join(f"{name} ({able[name]:.2f})" for name in likeliest)
    return (f"Not ruled out, nor agreed on by parts of the recordings: {told}.",) if told else ()


def sentences_of(
    verdict: Verdict, effects: Sequence[FoundEffect], evidence: Evidence, places: Sequence[str]
) -> tuple[str, ...]:
    """Return the finding in words."""
    q, residual = evidence.quality, evidence.residual
    errors = (
        f"Held-out error, as a share of the spread of y: nominal {q.nominal:.3g}, retuned {q.retuned:.3g}, "
        f"extended {q.extended:.3g}, noise {q.noise_floor:.3g}."
    )
    possible = left_open(effects, evidence)
    match verdict:
        case "none" if not evidence.follows:
            first = "Nothing contradicts the simulation, and nothing bears it out: these recordings show noise alone."
        case "none":
            first = "The simulation explains the recordings to within noise."
        case "parameters":
            first = (
                "The numbers are not right: retuned, the simulation is nearer to the recordings, but not down to noise."
            )
            if residual.is_noise or q.comes_down_to_noise:
                structure = "The numbers are not right" if possible else "The structure is right, its numbers are not"
                first = f"{structure}: retuned, the simulation explains the recordings."
        case "effect":
            names = " and ".join(f"{e.name} (probability {e.probability:.2f})" for e in effects)
            clean = residual.is_noise or q.comes_down_to_noise
            rest = "" if clean else " What is left is not noise: something else is missing as well."
            first = f"Physics was left out: {names}.{beside(effects, evidence)}{rest}"
        case _ if not evidence.follows:
            first = (
                "The simulation follows nothing of these recordings: on rows that were left out it errs by as much as "
                "y varies. Look whether the columns are u and y of this model, and whether anything but noise moved y."
            )
        case _:
            first = (
                f"Something is missing that no candidate explains to within noise; it shows at the {', '.join(places)}."
            )
    said = [first, *possible]
    if evidence.own is not None:
        said.append(evidence.own.sentence)
    elif not residual.is_constant:
        said.append(residual.varies.sentence)
    return (*said, errors)
