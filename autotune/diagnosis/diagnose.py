"""The diagnosis: samples, retuning, search, judgement, and the extended model, from recordings and a nominal model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import Controller
from autotune.diagnosis.data import Data
from autotune.diagnosis.description import describe
from autotune.diagnosis.discriminate import next_experiment
from autotune.diagnosis.fitting import Fit, fit
from autotune.diagnosis.law import law_effect
from autotune.diagnosis.noise import noise_from_differences
from autotune.diagnosis.result import Candidate, Diagnosis, FitQuality, FoundEffect, OperatingRange, Verdict
from autotune.diagnosis.retuning import BLOCKS, COARSE, misfit, whiteness
from autotune.diagnosis.samples import SampleEffect, inspect, jitter_effect
from autotune.diagnosis.search import RUNAWAY, Hypothesis
from autotune.diagnosis.selection import Report, Search, score, search, simplicity_lead, worth
from autotune.diagnosis.simulation import entry_of
from autotune.errors import InputError
from autotune.models import Effect, Model, Parameter
from autotune.recording import Recording

#: Residual variance over the noise's (see :func:`autotune.diagnosis.retuning.misfit`) up to which a model is adequate,
#: beside one standard deviation of that ratio.
ADEQUATE = 1.04
#: The same for the slow part of the residual, after its own AR(2) has been taken out, beside two standard deviations.
WHITE = 1.15
#: Misfit of a model without effects from which on something must be missing, although no effect is worth it.
MISSING = 1.1
#: Decrease of chi2 that wrong numbers must bring before the verdict is "parameters".
NUMBERS_DECREASE = 25.0
#: An operating point that lies this many standard deviations from the nominal one is an offset.
OFFSET_SIGMAS = 6.0
#: Share of the retuned model's excess misfit that an effect must explain where nothing explains all of it, and how
#: many times the noise's variance the retuned model's error must have: nearer to the noise adequacy is asked for.
DOMINANT, FAR_FROM_NOISE = 0.35, 6.0
#: Correlation of the noise from which on it is a disturbance of the plant's, not of single samples.
SLOW_NOISE = 0.8
#: Weight of a cause outside the catalogue, beside the best hypothesis's 1, where that explains the recordings or most
#: of what retuning leaves; elsewhere it weighs as much as the best.
UNKNOWN = 0.03
#: Evidence from which on what single rows show is sure, and its share of what an effect of the chain gains.
SURE, SAMPLE_SHARE = 60.0, 0.2
#: Scale of the log-odds: one unit of chi2 counts this much less than for ideal noise.
TEMPERATURE = 3.0


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
        raise InputError("no recording", where="diagnose", mend="give at least one")
    for r in recordings:
        r.require_finite(("u",))
        if len(r) < 100 or np.isfinite(r.y).sum() < 100:
            raise InputError(f"{len(r)} rows", where=r.name, mend="a diagnosis needs at least 100 finite readings")
    report("looking at the samples", 0.0)
    good, seen = inspect(recordings)
    left_out = [*without, *(effect.name for effect in seen)]
    found = search(model, recordings, good, left_out, report)
    also = (jitter_effect(found.retuned.fit, recordings), law_effect(recordings, controller))
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
    if any(s.name == "timing.jitter" for s in strong):
        found = replace(found, chosen=found.retuned)
    report("checking on held-out rows", 0.9)
    return _judge(found, [s for s in (*seen, *strong) if s.name not in without], model)


def _judge(found: Search, samples: list[SampleEffect], model: Model) -> Diagnosis:
    chosen = found.chosen
    adequate = is_adequate(chosen.fit, found.data)
    offset = _offset(chosen.fit)
    quality, extended_is_better = held_out(found)
    adequate |= dominates(quality)
    verdict = _verdict(found, samples, adequate, offset is not None)
    effects = _effects(found, samples, offset, adequate) if verdict == "effect" else ()
    candidates = rivals(found, adequate)
    places = _places(effects) if verdict == "effect" else (_suspected(found) if verdict == "unexplained" else ())
    use = chosen if extended_is_better and verdict in ("effect", "unexplained") else found.retuned
    extended = model if verdict == "none" else use.fit.model
    clips = [Effect(name=s.name, parameters=s.parameters) for s in samples if s.name == "sensor.saturation"]
    extended = replace(extended, effects=(*_with_uncertainty(use, extended.effects), *clips))
    return Diagnosis(
        verdict=verdict,
        effects=effects,
        candidates=candidates,
        places=places,
        fit=quality,
        next_experiment=next_experiment(found, effects, verdict),
        extended_model=extended,
        sentences=_sentences(verdict, effects, quality, places),
        description=describe(found.retuned.fit, found.data) if verdict == "unexplained" else None,
        search=found,
    )


def is_adequate(result: Fit, data: Data) -> bool:
    """Whether a residual is noise: no more variance than its jitter shows, and no slow part."""
    return misfit(result, data) < ADEQUATE + math.sqrt(2.0 / result.rows) and is_white(result, data)


def is_white(result: Fit, data: Data) -> bool:
    """Whether a residual has no slow part beyond what chance brings."""
    return whiteness(result, data) < WHITE + 2.0 * math.sqrt(2.0 / (BLOCKS * len(result.windows)))


def _verdict(found: Search, samples: list[SampleEffect], adequate: bool, offset: bool) -> Verdict:
    if found.chosen.names and not samples:
        return "effect" if adequate else "unexplained"
    if samples or (offset and adequate):
        return "effect"
    if not adequate:
        return "unexplained" if misfit(found.chosen.fit, found.data) > MISSING else _numbers(found)
    return _numbers(found)


def _numbers(found: Search) -> Verdict:
    gained = found.nominal.chi2 - found.retuned.fit.chi2 - found.retuned.fit.penalty
    return "parameters" if gained > NUMBERS_DECREASE else "none"


def dominates(quality: FitQuality) -> bool:
    """Whether the chosen effects explain most of a misfit that nothing explains whole.

    On real rigs something always remains; an effect is named all the same when on rows that were not fitted it takes
    away most of the variance that retuning leaves above the noise.
    """
    left = quality.retuned**2 - quality.noise_floor**2
    far = quality.retuned**2 > FAR_FROM_NOISE * quality.noise_floor**2
    return far and quality.retuned**2 - quality.extended**2 > DOMINANT * left


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


def rivals(found: Search, adequate: bool) -> tuple[Candidate, ...]:
    """Return every hypothesis's name with its probability among those searched, best first.

    A richer hypothesis that beats the chosen one by less than the lead that simplicity was given pays that lead here
    too: the probabilities weigh what the choice weighed.
    """
    pool = [found.retuned, *found.singles, *found.pairs, *found.triples]
    chosen = found.chosen
    scale = TEMPERATURE * max(1.0, chosen.fit.chi2 / chosen.fit.rows)
    lead = simplicity_lead(found.retuned.fit, min(pool, key=score))

    def weighed(h: Hypothesis) -> float:
        refused = h.parameters > chosen.parameters and 0.0 < score(chosen) - score(h) < lead
        return score(h) + (lead if refused else 0.0)

    best = min(weighed(h) for h in pool)
    weights: dict[str, float] = {}
    for h in pool:
        name = "+".join(h.names) if h.names else "none"
        weights[name] = max(weights.get(name, 0.0), math.exp(-(weighed(h) - best) / (2.0 * scale)))
    weights["unknown"] = UNKNOWN if adequate else 1.0
    total = sum(weights.values())
    ranked = sorted(weights.items(), key=lambda item: -item[1])
    return tuple(Candidate(name=name, probability=w / total) for name, w in ranked if w / total > 1e-4)[:12]


def _same(name: str) -> set[str]:
    return {name, *entry_of(name).same}


def probability_of(name: str, found: Search, adequate: bool) -> float:
    """Return the probability that an effect, or one that cannot be told from it, is part of the truth."""
    group = _same(name)
    total = sum(c.probability for c in rivals(found, adequate) if group & set(c.name.split("+")))
    return min(max(total, 0.0), 0.99)


def _effects(
    found: Search, samples: list[SampleEffect], offset: _Offset | None, adequate: bool
) -> tuple[FoundEffect, ...]:
    chosen = found.chosen
    everywhere = tuple((i, float(r.t[0]), float(r.t[-1])) for i, r in enumerate(found.data.recordings))
    effects: list[tuple[float, FoundEffect]] = []
    for effect in _with_uncertainty(chosen, chosen.fit.model.effects):
        weight = _weight(found, effect.name)
        effects.append((weight, _found_effect(effect, found, adequate, everywhere)))
    for s in samples:
        confident = 0.97 if s.evidence > 60.0 else 0.85
        effects.append((s.evidence, FoundEffect(
            name=s.name, probability=confident, places=(s.name.partition(".")[0],),
            parameters=MappingProxyType(s.parameters), equation=s.equation, windows=s.windows or everywhere,
        )))  # fmt: skip
    ranked = [e for _, e in sorted(effects, key=lambda pair: -pair[0])]
    if offset is not None and not any(e.name == "environment.step_load" for e in ranked):
        entry = entry_of("actuator.offset")
        unit = found.chosen.fit.parametrisation.model.input.unit
        parameter = {"offset": Parameter(value=offset.value, sd=offset.sd, unit=unit)}
        ranked.append(FoundEffect(
            name="actuator.offset", probability=0.9, places=entry.places, parameters=MappingProxyType(parameter),
            equation=entry.equation, windows=everywhere,
        ))  # fmt: skip
    return tuple(ranked)


def _weight(found: Search, name: str) -> float:
    """Return what a chosen effect is worth: the chi2 that is lost without it, as far as it was fitted."""
    rest = frozenset(found.chosen.names) - {name}
    known = {frozenset(h.names): score(h) for h in (found.retuned, *found.singles, *found.pairs)}
    return known.get(rest, score(found.retuned)) - score(found.chosen)


def _found_effect(
    effect: Effect, found: Search, adequate: bool, everywhere: tuple[tuple[int, float, float], ...]
) -> FoundEffect:
    entry = entry_of(effect.name)
    windows = everywhere
    if effect.name == "environment.step_load":
        number, after = int(effect.parameters["recording"].value), effect.parameters["time"].value
        pairs = [(i, r) for i, r in enumerate(found.data.recordings) if number in (-1, i)]
        windows = tuple((i, float(r.t[0] + after), float(r.t[-1])) for i, r in pairs)
    return FoundEffect(
        name=effect.name,
        probability=probability_of(effect.name, found, adequate),
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
    """Return the effects with the standard deviations of their fit; NaN for a number that the data did not feel."""
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
        result.append(replace(effect, parameters=MappingProxyType(parameters)))
    return tuple(result)


def _range(found: Search, place: str) -> OperatingRange:
    column, name = {"plant": (2, "position"), "sensor": (0, "y")}.get(place, (3, "plant input"))
    values = np.concatenate([s[:, column] for s in found.chosen.fit.signals])
    return OperatingRange(signal=name, low=float(np.nanmin(values)), high=float(np.nanmax(values)))


def _places(effects: Sequence[FoundEffect]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(place for e in effects for place in e.places))


def _suspected(found: Search) -> tuple[str, ...]:
    """Return the places of the candidates that come nearest to an explanation."""
    ranked = sorted((*found.singles, *found.pairs), key=score)
    places: dict[str, None] = {}
    for h in ranked[:2]:
        for name in h.names:
            entry = entry_of(name)
            places |= dict.fromkeys(entry.places or (entry.place,))
    return tuple(places) or ("plant",)


def held_out(found: Search) -> tuple[FitQuality, bool]:
    """Return errors on every second window, with numbers fitted to the others, and whether the extended model wins."""
    data = found.data
    odd, even = _half(data, 1), _half(data, 0)
    y = np.concatenate([r.y[g] for r, g in zip(odd.recordings, odd.good, strict=True)])
    spread = float(np.std(y)) or 1.0

    def error(h: Hypothesis, tune: bool) -> float:
        p, none = h.fit.parametrisation, np.zeros(h.fit.theta.size, dtype=bool)
        theta = h.fit.theta if tune else p.centre
        try:
            if tune:
                theta = fit(p, even, theta, _states_of(h.fit, even), iterations=6, rounds=1).theta
            tested = fit(p, odd, theta, _states_of(h.fit, odd), free=none, iterations=8)
        except RUNAWAY:
            # numbers from half the windows can run away on the other half: then those of all windows count
            tested = h.fit
        squares = sum(float(e @ e) for e in tested.residuals)
        return math.sqrt(squares / max(tested.rows - sum(Q.shape[1] for Q in tested.states_explain), 1)) / spread

    nominal, retuned = error(found.retuned, tune=False), error(found.retuned, tune=True)
    extended = error(found.chosen, tune=True) if found.chosen.names else retuned
    noise = noise_from_differences(found.chosen.fit.residuals, data.good).total_sd / spread
    quality = FitQuality(nominal=nominal, retuned=retuned, extended=extended, noise_floor=noise)
    return quality, extended <= retuned


def _states_of(result: Fit, data: Data) -> list[FloatArray]:
    """Return a fit's start states of the windows that the data have."""
    pairs = zip(result.x0, result.starts, data.starts, strict=True)
    return [x0[np.searchsorted(known, starts)] for x0, known, starts in pairs]


def _half(data: Data, which: int) -> Data:
    """Return every second window of the data, or block of windows where there are few."""
    starts, stops, good = [], [], []
    number = which
    for a, b, ok in zip(data.starts, data.stops, data.good, strict=True):
        # few windows may go by direction one and one: then blocks of them are taken
        block = 1 if len(a) >= 8 else max(1, len(a) // 2)
        keep = (np.arange(len(a)) // block) % 2 == number % 2
        if not keep.any():
            keep[:] = True
        inside = np.zeros(ok.size, dtype=bool)
        for first, last in zip(a[keep], b[keep], strict=True):
            inside[first:last] = True
        starts.append(a[keep])
        stops.append(b[keep])
        good.append(ok & inside)
    return replace(data, starts=tuple(starts), stops=tuple(stops), good=tuple(good))


def _sentences(
    verdict: Verdict, effects: Sequence[FoundEffect], quality: FitQuality, places: Sequence[str]
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
            first = f"Physics was left out: {names}."
        case _:
            first = f"Something is missing that no candidate explains to within noise; it shows at {', '.join(places)}."
    return first, errors


__all__ = ["diagnose", "held_out", "is_adequate", "probability_of", "rivals", "worth"]
