"""The diagnosis: samples, retuning, search, judgement, and the extended model, from recordings and a nominal model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from autotune.controller import Controller
from autotune.diagnosis.adequacy import Left, is_white, left_by
from autotune.diagnosis.catalogue import STRUCTURES
from autotune.diagnosis.constancy import largest_variation
from autotune.diagnosis.description import Description, describe
from autotune.diagnosis.discriminate import next_experiment
from autotune.diagnosis.fitting import Fit
from autotune.diagnosis.judgement import (
    MISSING,
    UNKNOWN,
    dominates,
    doubt_of,
    held_out,
    rivals,
)
from autotune.diagnosis.law import law_effect
from autotune.diagnosis.parsimony import worth
from autotune.diagnosis.result import Candidate, Diagnosis, FitQuality, FoundEffect, OperatingRange, Verdict
from autotune.diagnosis.retuning import COARSE, misfit
from autotune.diagnosis.samples import SampleEffect, inspect, jitter_effect
from autotune.diagnosis.search import Hypothesis, score
from autotune.diagnosis.selection import Report, Search, search
from autotune.diagnosis.simulation import entry_of
from autotune.errors import InputError
from autotune.models import Effect, Model, Parameter
from autotune.recording import Recording

#: Decrease of chi2 that wrong numbers must bring before the verdict is "parameters".
NUMBERS_DECREASE = 25.0
#: An operating point that lies this many standard deviations from the nominal one is an offset.
OFFSET_SIGMAS = 6.0
#: Correlation of the noise from which on it is a disturbance of the plant's, not of single samples.
SLOW_NOISE = 0.8
#: Held-out share of the misfit from which on a description tells where it adds its terms.
TELLING = 0.5
#: Share of the squared error that a simulation with a converter's rounding may leave to be the better one.
ROUNDING = 0.9
#: Limit that nothing reaches.
NEVER = 1e18
#: Evidence from which on what single rows show is sure, and its share of what an effect of the chain gains.
SURE, SAMPLE_SHARE = 60.0, 0.2
#: Probabilities stated of what single rows show, with that evidence and with less.
SURELY, PROBABLY = 1.0 / (1.0 + UNKNOWN), 0.85


def diagnose(
    model: Model,
    recordings: Sequence[Recording],
    controller: Controller | None = None,
    without: Sequence[str] = (),
    report: Report = lambda what, share: None,
) -> Diagnosis:
    """Find where and why recordings differ from the simulation of a model.

    Parameters
    ----------
    model : Model
        The nominal chain; effects that it already has are kept as they are.
    recordings : sequence of Recording
        At least one; several with different excitation tell more.
    controller : Controller, optional
        The law that u was computed by; the sidecars' ``[controller]`` by default.
    without : sequence of str
        Effects left out of the catalogue.
    report : callable
        Told what is being done and the share done, 0 to 1.

    Returns
    -------
    Diagnosis
        Verdict, effects with probabilities, extended model, and what would decide what is left open.

    Raises
    ------
    InputError
        No recording, fewer than 100 rows, or u that is not finite.
    """
    if not recordings:
        raise InputError("no recording", where="diagnose", remedy="give at least one")
    for r in recordings:
        r.require_finite(("u",))
        if len(r) < 100 or np.isfinite(r.y).sum() < 100:
            raise InputError(f"{len(r)} rows", where=r.name, remedy="a diagnosis needs at least 100 finite readings")
    report("looking at the samples", 0.0)
    good, seen = inspect(recordings, without)
    left_out = [*without, *(effect.name for effect in seen)]
    found = search(model, recordings, good, left_out, report)
    # a reading that was rounded is off by less where it stands still: that is no jitter
    rounded = any(s.name == "sensor.quantisation" for s in seen)
    jitter = None if rounded else jitter_effect(found.retuned.fit, recordings)
    if jitter is not None and largest_variation(found.retuned.fit, found.data).gain > jitter.evidence:
        jitter = None  # what is left goes with a signal, and that grows with the slope too
    also = (jitter, law_effect(recordings, controller))
    strong = [s for s in also if s is not None and s.name not in without]
    # what the samples show explains the residual better than an effect of the chain does, or not at all
    gained = score(found.retuned) - score(found.chosen)
    quick = not found.data.noise.ar or found.data.noise.ar[0] < SLOW_NOISE
    near = misfit(found.retuned.fit, found.data) < COARSE
    # a stamp that is wrong disturbs single rows: effects of the chain would leave something slow as well
    fast = is_white(found.retuned.fit, found.data) and quick and near
    strong = [
        s
        for s in strong
        if (s.evidence > max(SAMPLE_SHARE * gained, SURE) and fast)
        or (s.evidence > gained and (s.name != "timing.jitter" or (quick and near)))
    ]
    # where single rows are disturbed, what is left beside them takes more to be believed
    if any(s.name == "timing.jitter" for s in strong) or (seen and gained < SURE):
        found = replace(found, chosen=found.retuned)
    report("checking on held-out rows", 0.9)
    return _judge(found, [*seen, *strong], model)


def _judge(found: Search, samples: list[SampleEffect], model: Model) -> Diagnosis:
    chosen = found.chosen
    left = left_by(found)
    offset = _offset(chosen.fit)
    quality, extended_is_better = held_out(found)
    # a load that comes when it is wanted explains a part of everything: that part is not enough
    loads = all(entry_of(name).place == "environment" for name in chosen.names)
    most = dominates(quality) and left.is_lesser and not loads
    doubt = doubt_of(left, most)
    verdict = _verdict(found, samples, left, left.is_noise or most, offset is not None)
    candidates = rivals(found, doubt)
    effects = _effects(found, samples, offset, candidates, 1.0 / (1.0 + doubt)) if verdict == "effect" else ()
    description = describe(found.retuned.fit, found.data) if verdict == "unexplained" else None
    places = _places(effects) if description is None else _suspected(found, description, left)
    use = chosen if extended_is_better and verdict in ("effect", "unexplained") else found.retuned
    extended = model if verdict == "none" else use.fit.model
    ends = [Effect(name=s.name, parameters=s.parameters) for s in samples if _simulated(s, use.fit)]
    extended = replace(extended, effects=(*_with_uncertainty(use, extended.effects), *ends))
    said = Diagnosis(
        verdict=verdict,
        effects=effects,
        candidates=candidates,
        places=places,
        fit=quality,
        next_experiment=None,
        extended_model=extended,
        sentences=_sentences(verdict, effects, quality, places, left, bool(samples)),
        left=left,
        description=description,
        search=found,
    )
    return replace(said, next_experiment=next_experiment(said))


def _verdict(found: Search, samples: list[SampleEffect], left: Left, adequate: bool, offset: bool) -> Verdict:
    if found.chosen.names and not samples:
        return "effect" if adequate else "unexplained"
    if not samples and (_is_of_another_structure(found) or not left.is_constant):
        return "unexplained"
    if samples or (offset and adequate):
        return "effect"
    if not adequate:
        return "unexplained" if left.misfit > MISSING else _numbers(found)
    return _numbers(found)


def _is_of_another_structure(found: Search) -> bool:
    """Whether a structure that is no effect explains more than any effect does, and enough to be believed."""
    best = min((found.retuned, *found.singles, *found.pairs, *found.triples), key=score)
    return bool(STRUCTURES.keys() & set(best.names)) and worth(found.retuned, best)


def _numbers(found: Search) -> Verdict:
    gained = found.nominal.chi2 - found.retuned.fit.chi2 - found.retuned.fit.penalty
    return "parameters" if gained > NUMBERS_DECREASE else "none"


@dataclass(frozen=True, kw_only=True)
class _Offset:
    value: float
    sd: float


def _offset(result: Fit) -> _Offset | None:
    """Return the operating point's shift where it is far outside its uncertainty."""
    for i, free in enumerate(result.parametrisation.free):
        if free.kind == "u_offset":
            sd = math.sqrt(max(float(result.covariance[i, i]), 0.0)) * free.size
            shift = result.theta[i] * free.size
            if sd > 0.0 and abs(shift) > OFFSET_SIGMAS * sd and abs(shift) > 1e-3 * free.size:
                return _Offset(value=-shift, sd=sd)
    return None


def probability_of(name: str, candidates: Sequence[Candidate]) -> float:
    """Return the probability that an effect, or one that cannot be told from it, is part of the truth."""
    group = {name, *entry_of(name).same}
    total = sum(c.probability for c in candidates if group & set(c.name.split("+")))
    return min(max(total, 0.0), 0.99)


def _effects(
    found: Search,
    samples: list[SampleEffect],
    offset: _Offset | None,
    candidates: Sequence[Candidate],
    known: float,
) -> tuple[FoundEffect, ...]:
    chosen = found.chosen
    everywhere = tuple((i, float(r.t[0]), float(r.t[-1])) for i, r in enumerate(found.data.recordings))
    effects: list[tuple[float, FoundEffect]] = []
    for effect in _with_uncertainty(chosen, chosen.fit.model.effects):
        weight = _weight(found, effect.name)
        effects.append((weight, _found_effect(effect, found, candidates, everywhere)))
    for s in samples:
        effects.append((s.evidence, FoundEffect(
            name=s.name, probability=SURELY if s.evidence > SURE else PROBABLY, places=(s.name.partition(".")[0],),
            parameters=MappingProxyType(s.parameters), equation=s.equation, windows=s.windows or everywhere,
        )))  # fmt: skip
    ranked = [e for _, e in sorted(effects, key=lambda pair: -pair[0])]
    if offset is not None and not any(e.name == "environment.step_load" for e in ranked):
        entry = entry_of("actuator.offset")
        unit = found.chosen.fit.parametrisation.model.input.unit
        parameter = {"offset": Parameter(value=offset.value, sd=offset.sd, unit=unit)}
        ranked.append(FoundEffect(
            name="actuator.offset", probability=known, places=entry.places, parameters=MappingProxyType(parameter),
            equation=entry.equation, windows=everywhere,
        ))  # fmt: skip
    return tuple(ranked)


def _weight(found: Search, name: str) -> float:
    """Return what a chosen effect is worth: the chi2 that is lost without it, as far as it was fitted."""
    rest = frozenset(found.chosen.names) - {name}
    known = {frozenset(h.names): score(h) for h in (found.retuned, *found.singles, *found.pairs)}
    return known.get(rest, score(found.retuned)) - score(found.chosen)


def _found_effect(
    effect: Effect, found: Search, candidates: Sequence[Candidate], everywhere: tuple[tuple[int, float, float], ...]
) -> FoundEffect:
    entry = entry_of(effect.name)
    windows = everywhere
    if effect.name == "environment.step_load":
        number, after = int(effect.parameters["recording"].value), effect.parameters["time"].value
        pairs = [(i, r) for i, r in enumerate(found.data.recordings) if number in (-1, i)]
        windows = tuple((i, float(r.t[0] + after), float(r.t[-1])) for i, r in pairs)
    return FoundEffect(
        name=effect.name,
        probability=probability_of(effect.name, candidates),
        places=entry.places or (entry.place,),
        parameters=MappingProxyType(_readable(effect)),
        equation=entry.equation,
        windows=windows,
        operating_range=_range(found, entry.place),
    )


def _readable(effect: Effect) -> Mapping[str, Parameter]:
    """Return an effect's parameters as people name them: limits that do not act are left out, phases as angles."""
    parameters = dict(effect.parameters)
    if effect.name == "environment.periodic_load":
        a, b = parameters.pop("in_phase"), parameters.pop("quadrature")
        size = math.hypot(a.value, b.value)
        sd = math.hypot(a.value * a.sd, b.value * b.sd) / size if size else math.nan
        parameters["amplitude"] = Parameter(value=size, sd=sd, unit=a.unit)
        parameters["phase"] = Parameter(value=math.atan2(b.value, a.value), unit="rad")
    for key in ("end", "recording"):
        parameters.pop(key, None)
    for key in ("low", "high"):
        if key in parameters and not math.isfinite(parameters[key].sd):
            parameters.pop(key)
    return parameters


def _with_uncertainty(h: Hypothesis, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Return the effects with the standard deviations of their fit; NaN for a number that the data did not feel.

    A limit that was not felt is none: where it came to rest, further excitation would meet it.
    """
    result, p = [], h.fit.parametrisation
    sd = np.sqrt(np.maximum(np.diag(h.fit.covariance), 0.0))
    spans: dict[tuple[int, int], float] = {}
    for i, f in enumerate(p.free):
        if f.kind == "effect":
            spans[f.index] = float(sd[i]) * (p.value(i, h.fit.theta) if f.positive else f.size)
    for number, effect in enumerate(effects):
        parameters = {
            key: replace(q, sd=spans.get((number, j), math.nan) or math.nan)
            for j, (key, q) in enumerate(effect.parameters.items())
        }
        for key, none in (("low", -NEVER), ("high", NEVER)):
            if key in parameters and not math.isfinite(parameters[key].sd):
                parameters[key] = replace(parameters[key], value=none)
        result.append(replace(effect, parameters=MappingProxyType(parameters)))
    return tuple(result)


def _range(found: Search, place: str) -> OperatingRange:
    column, name = {"plant": (2, "position"), "sensor": (0, "y")}.get(place, (3, "plant input"))
    values = np.concatenate([s[:, column] for s in found.chosen.fit.signals])
    return OperatingRange(signal=name, low=float(np.nanmin(values)), high=float(np.nanmax(values)))


def _simulated(effect: SampleEffect, result: Fit) -> bool:
    """Whether a simulation is nearer to the readings with what their samples show; beside much noise no rounding is."""
    if effect.name != "sensor.quantisation":
        return effect.name == "sensor.saturation"
    step = effect.parameters["step"].value
    y = [s[:, 0] + e for s, e in zip(result.signals, result.residuals, strict=True)]
    rounded = [r - step * np.round(s[:, 0] / step) for r, s in zip(y, result.signals, strict=True)]
    squares = [float(np.nansum(np.concatenate(e) ** 2)) for e in (rounded, result.residuals)]
    return squares[0] < ROUNDING * squares[1]


def _places(effects: Sequence[FoundEffect]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(place for e in effects for place in e.places))


def _suspected(found: Search, description: Description, left: Left) -> tuple[str, ...]:
    """Return where what varies may enter and a description that tells much adds its terms; else where both might be."""
    known: dict[str, None] = {description.place: None} if description.terms else {}
    if not left.is_constant:
        telling = known if description.explained > TELLING else {}
        return tuple(dict.fromkeys(left.varies.places) | telling)
    places: dict[str, None] = dict(known)
    for h in sorted((*found.singles, *found.pairs), key=score)[:3]:
        for name in h.names:
            entry = entry_of(name)
            places |= dict.fromkeys(entry.places or (entry.place,))
    return tuple(places) or ("plant",)


def _sentences(
    verdict: Verdict,
    effects: Sequence[FoundEffect],
    quality: FitQuality,
    places: Sequence[str],
    left: Left,
    samples: bool,
) -> tuple[str, ...]:
    errors = (
        f"Held-out error, as a share of the spread of y: nominal {quality.nominal:.3g}, retuned {quality.retuned:.3g}, "
        f"extended {quality.extended:.3g}, noise {quality.noise_floor:.3g}."
    )
    match verdict:
        case "none":
            first = "The simulation explains the recordings to within noise."
        case "parameters":
            first = "The structure is right, its numbers are not: retuned, the simulation explains the recordings."
        case "effect":
            names = " and ".join(f"{e.name} (probability {e.probability:.2f})" for e in effects)
            rest = (
                "" if left.is_noise or samples else " What is left is not noise: something smaller is missing as well."
            )
            first = f"Physics was left out: {names}.{rest}"
        case _:
            first = f"Something is missing that no candidate explains to within noise; it shows at {', '.join(places)}."
    return (first, errors) if left.is_constant else (first, left.varies.sentence, errors)
