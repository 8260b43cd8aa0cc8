"""The extended model: what a person goes on with, its effects with uncertainties and with ends of their laws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.sample_gain import is_nearer
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.result import Verdict
from autotune.diagnosis.selection.hypothesis import Hypothesis
from autotune.effects import kind_of
from autotune.models import Effect, Model, Parameter

if TYPE_CHECKING:
    from autotune.diagnosis.chain_evidence import ChainEvidence

#: Places beyond a recorded range at which a law is looked at.
_LOOKED = 51


def with_uncertainty(h: Hypothesis, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
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


def extended_model(evidence: ChainEvidence, verdict: Verdict) -> Model:
    """Return the chain to go on with: the nominal one where nothing is missing, else what explains more."""
    found, nominal = evidence.search, evidence.model
    named = evidence.quality.is_better and verdict in ("effect", "unexplained")
    use = found.chosen if named else found.retuned
    extended = nominal if verdict == "none" or evidence.nominal_stands else use.fit.model
    own = {e.name for e in nominal.effects}
    if len(found.data.recordings) == 1:
        # what came at a time of one recording is no property of the rig; a drift goes on while its law holds
        holds = evidence.found is not None and evidence.found.chosen.leaves_noise
        lasting = tuple(
            e
            for e in extended.effects
            if e.name in own or not kind_of(e.name).at_a_time or (holds and not kind_of(e.name).is_event)
        )
        extended = replace(extended, effects=lasting)
    simulated = [signals[:, 0] for signals in use.fit.signals]
    ends = [
        Effect(name=s.name, parameters=s.parameters)
        for s in evidence.samples
        if kind_of(s.name).late_stamps or is_nearer(s, simulated, use.fit.residuals, 1.0 - evidence.limits.material)
    ]
    if extended is nominal and not ends:
        return nominal
    effects = with_uncertainty(use, extended.effects)
    return replace(
        extended,
        effects=(*(e if e.name in own else _ended(e, use.fit, found.data, nominal) for e in effects), *ends),
        input=replace(extended.input, recorded=_span([r.u for r in found.data.recordings])),
        output=replace(extended.output, recorded=_span([r.y for r in found.data.recordings])),
    )


def _ended(effect: Effect, result: Fit, data: Data, nominal: Model) -> Effect:
    """Return an effect with the ends of its law: one span beyond what was recorded, nearer where it would turn there.

    Beyond them it adds what it adds there, so that an extended model is bounded wherever the linear one is. A bend of
    the command goes on with the nominal model's gain there, and ends where the command changes its sign if none of that
    sign was recorded: a bend that suits one sign says nothing of the other.
    """
    kind = kind_of(effect.name)
    if kind.goes_on is None:
        return effect
    values = {q.name: q.neutral for q in kind.parameters if q.neutral is not None}
    values |= effect.values | {"gain": float(result.sim.chain.gains[0])}
    signal = _signal_of(kind.place, result, data)
    low, high = float(np.nanmin(signal)), float(np.nanmax(signal))
    beyond = np.linspace(0.0, high - low, _LOOKED)
    unit = kind.parameters[-1].unit.format(u=result.model.input.unit, y=result.model.output.unit)
    ends = {
        "low": low - _reach([kind.goes_on(values, low - b) for b in beyond], beyond),
        "high": high + _reach([kind.goes_on(values, high + b) for b in beyond], beyond),
    }
    given = {key: Parameter(value=value, unit=unit) for key, value in ends.items()}
    if kind.place == "actuator":
        rest = -result.sim.u_offset
        if low >= rest:
            given["low"] = replace(given["low"], value=max(ends["low"], rest))
        if high <= rest:
            given["high"] = replace(given["high"], value=min(ends["high"], rest))
        given["slope"] = Parameter(value=_gain_ratio(nominal, result.model))
    return replace(effect, parameters=MappingProxyType({**effect.parameters, **given}))


def _gain_ratio(one: Model, other: Model) -> float:
    """Return the ratio of two models' responses to a command that changes slowly; 1 where it says nothing."""
    gains = []
    for model in (one, other):
        g = model.transfer_function()
        gains.append(g.num[-1] / next(c for c in reversed(g.den) if c))
    ratio = gains[0] / gains[1] if gains[1] else 1.0
    return ratio if ratio > 0.0 else 1.0


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
