"""Search over hypotheses: a cheap first-order look at every effect, then fits of those that promise most."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.catalogue import CATALOGUE, Entry, Range
from autotune.diagnosis.data import Data
from autotune.diagnosis.descent import bounded
from autotune.diagnosis.fitting import RUNAWAY, Fit, fit, residual_at
from autotune.diagnosis.kernel import I_LEVELS
from autotune.diagnosis.parameters import COUNTED, FOUND_DIRECTLY, Parametrisation, effect_with, parametrise
from autotune.diagnosis.restarts import CONVERTER, realigned, restarted
from autotune.diagnosis.simulation import Simulator, entry_of
from autotune.errors import IdentificationError
from autotune.models import Effect, Model


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """Effects with the fit that has them; none for the retuned nominal structure."""

    names: tuple[str, ...]
    fit: Fit

    @property
    def parameters(self) -> int:
        """Free numbers beyond those of the nominal structure, those that a direct search sets included."""
        p = self.fit.parametrisation
        direct = sum(key in COUNTED for e in p.model.effects for key in e.parameters)
        return direct + sum(f.kind == "effect" for f in p.free)


def score(h: Hypothesis) -> float:
    """Return the cost with what free numbers have to pay: ln N each of the effects', 1 each start state.

    A block that an effect adds brings start states to every window, each of which takes 1 of chi2 from noise alone.
    """
    states = sum(Q.shape[1] for Q in h.fit.states_explain)
    return float(h.fit.cost + h.parameters * np.log(h.fit.rows) + states)


@dataclass(frozen=True, kw_only=True, eq=False)
class Promise:
    """A starting point, the decrease of chi2 that the first order promises from it, and the size it promises it at."""

    effect: Effect
    decrease: float
    scaled: Effect


def signal_ranges(base: Fit, data: Data) -> Range:
    """Return the sizes of the signals in the recordings under a fitted model."""
    sim = base.sim
    w = np.concatenate([r.u for r in data.recordings]) - sim.u_offset
    y = np.concatenate([r.y[g] for r, g in zip(data.recordings, data.good, strict=True)])
    signals = np.concatenate(base.signals)
    rates = np.abs(np.linalg.eigvals(sim.chain.A))
    rates = rates[rates > 1e-9 * max(float(rates.max()), 1e-12)]
    tiny = 1e-12

    def largest(values: FloatArray) -> float:
        # the spikes that a differentiating controller puts into u say nothing of the sizes at work
        return max(float(np.nanquantile(np.abs(values), 0.98)), tiny)

    return Range(
        w=largest(w),
        f=largest(signals[:, 3]),
        v=largest(signals[:, 1]),
        x=largest(signals[:, 2]),
        y=largest(y - sim.y_offset),
        w_low=float(w.min() + sim.u_offset),
        w_high=float(w.max() + sim.u_offset),
        y_low=float(np.quantile(y, 0.001)),
        y_high=float(np.quantile(y, 0.999)),
        x_offset=sim.y_offset,
        gain=float(sim.chain.gains[0]),
        lag_s=1.0 / float(rates.min()),
        dt_s=data.recordings[0].sample_time_s,
        duration_s=max(r.duration_s for r in data.recordings),
    )


def applies(entry: Entry, sim: Simulator) -> bool:
    """Whether an effect makes sense in a chain."""
    chain = sim.chain
    match entry.needs:
        case "mechanical":
            return chain.is_mechanical
        case "level":
            return not chain.is_mechanical and not chain.is_integrating
        case "integrating":
            return chain.is_integrating
        case _:
            return True


def extended(base: Fit, effect: Effect, data: Data) -> tuple[Parametrisation, FloatArray, tuple[FloatArray, ...]]:
    """Return parametrisation, starting point and start states of a fit with one more effect."""
    old = base.parametrisation
    fitted = base.model
    effects = (*fitted.effects, effect)
    size = float(np.std(np.concatenate([r.u for r in data.recordings]))) or 1.0
    p = parametrise(replace(old.model, effects=()), effects, size, data.recordings[0].sample_time_s)
    theta = p.centre.copy()
    theta[: base.theta.size] = base.theta
    # an effect's own centre is its starting value; those fitted already keep the scale of their search
    free = (*old.free, *p.free[len(old.free) :])
    p = replace(p, free=free, centre=np.concatenate([old.centre, p.centre[len(old.free) :]]))
    return p, theta, carried_states(base, effect, p.with_values(theta), data)


def carried_states(base: Fit, effect: Effect, model: Model, data: Data) -> tuple[FloatArray, ...]:
    """Return a fit's start states with those of a block that the effect adds, at rest with its neighbour."""
    lagged = effect.name == "actuator.asymmetric_lag" and base.sim.chain.where[0] < 0
    if effect.name == "actuator.lag" or lagged:
        pairs = zip(data.recordings, data.starts, strict=True)
        first = [r.u[np.maximum(s - 1, 0)] - base.sim.u_offset for r, s in pairs]
        return tuple(np.column_stack([u, x]) for u, x in zip(first, base.x0, strict=True))
    if effect.name in ("sensor.lag", "plant.resonance", "plant.slow_mode"):
        out = [x @ base.sim.chain.taps[3] for x in base.x0]
        if effect.name == "sensor.lag":
            return tuple(np.column_stack([x, y]) for x, y in zip(base.x0, out, strict=True))
        if effect.name == "plant.slow_mode":
            share = effect.parameters["share"].value
            return tuple(np.column_stack([x, share * y]) for x, y in zip(base.x0, out, strict=True))
        omega = 2.0 * np.pi * effect.parameters["frequency"].value
        return tuple(np.column_stack([x, y / omega**2, 0.0 * y]) for x, y in zip(base.x0, out, strict=True))
    return base.x0


def kept_states(name: str, order: int) -> slice:
    """Return the states that stay when an effect is taken out of a chain of an order: all but those of its block."""
    match name:
        case "actuator.lag":
            return slice(1, order)
        case "sensor.lag" | "plant.slow_mode":
            return slice(0, order - 1)
        case "plant.resonance":
            return slice(0, order - 2)
        case _:
            return slice(0, order)


def promises(base: Fit, effect: Effect, data: Data) -> list[Promise]:
    """Return what the first order promises when an effect is added to a fit: near zero, and at the size given.

    An effect that moves the reading by more than a share of the misfit is shrunk: what far too large an effect does
    tells nothing of its direction near zero. Dry friction that is as large as that is found from its own size alone.
    """
    tried = []
    for _ in range(SHRINKINGS):
        found, share = _promise(base, effect, data)
        tried.append(found)
        if share <= LINEAR_SHARE or not _amplitudes(effect):
            break
        effect = _scaled(effect, float(np.sqrt(0.3 * LINEAR_SHARE / share)), least=1e-9)
    return [tried[-1], *tried[:1]] if len(tried) > 1 else tried


def promise(base: Fit, effect: Effect, data: Data) -> Promise:
    """Return what the first order promises when an effect is added to a fit, near zero where it is too large."""
    return promises(base, effect, data)[0]


def direction(base: Fit, effect: Effect, data: Data) -> FloatArray:
    """Return how an effect moves the whitened residual, freed of what the start states could explain.

    Raises
    ------
    AutotuneError, OverflowError, LinAlgError
        The simulation runs away with the effect.
    """
    p, theta, states = extended(base, effect, data)
    moved = residual_at(p, data, theta, states) - base.e
    if not bounded(moved):
        raise IdentificationError("the simulation runs away", where=effect.name)
    return base.without_states(moved)


def _promise(base: Fit, effect: Effect, data: Data) -> tuple[Promise, float]:
    """Return what is promised, and how far the effect moves the reading as a share of chi2.

    The direction d = e(with effect) - e(without) is freed of what the numbers already free could explain; the decrease
    of |e + a d|^2 over 0 <= a <= 4 is promised, over -20 <= a <= 20 for an effect of either sign. After a blow
    everything goes another way, which no first order tells: a hard stop that is touched promises a little always.
    """
    nothing = Promise(effect=effect, decrease=0.0, scaled=effect)
    try:
        d = direction(base, effect, data)
    except RUNAWAY:
        return nothing, RAN_AWAY
    # the fit is at rest: its numbers have nothing to gain by themselves, and what they believe is weighed with chi2
    slope, curvature = -float(d @ base.e), float(d @ base.without_numbers(d))
    if curvature == 0.0:
        return nothing, 0.0
    signed = any(q.scale == "real" for q in entry_of(effect.name).parameters if q.name not in FOUND_DIRECTLY)
    low, high = (-20.0, 20.0) if signed else (0.0, 4.0)
    if not _amplitudes(effect):
        low, high = 0.0, 1.0  # a limit or a step is not made larger by a factor
    a = float(np.clip(slope / curvature, low, high))
    scaled = _scaled(effect, a, 20.0 if signed else 2.0)
    least = min(TOUCHED, curvature) if effect.name == HARD_STOP else 0.0
    decrease = max(2.0 * a * slope - a * a * curvature, least)
    return Promise(effect=effect, decrease=decrease, scaled=scaled), curvature / base.chi2


#: Decrease that an effect's direction may have, as a share of chi2, before it is taken for too large to be linear.
LINEAR_SHARE = 0.3
#: Decrease that a hard stop promises that is touched.
HARD_STOP, TOUCHED = "plant.hard_stop", 20.0
#: Steps of a fit after which it is decided whether it goes on.
FIRST_STEPS = 3
#: Effects whose fits are finished, and fits of one effect.
FINISHED, MOST_EACH = 4, 2
#: Share of the best fit's decrease from which on any other is finished too, and of the best of the same effect.
NEAR, SECOND = 0.8, 0.5
#: Most simulations of one effect while it is shrunk, and the share of chi2 that a simulation counts that ran away.
SHRINKINGS, RAN_AWAY = 4, 1e6

#: Parameters that an effect is about proportional to: the first order tells their size.
AMPLITUDES = frozenset(
    ("level", "breakaway", "half_width", "width", "band", "time_constant", "delay", "second_order", "third_order",
     "coefficient", "slope", "share", "amplitude", "in_phase", "quadrature", "error", "rate")
)  # fmt: skip
#: Parameters of those names that are something else.
NO_AMPLITUDES = frozenset(
    (
        ("plant.hysteresis", "width"), ("actuator.rate_limit", "rate"), ("actuator.stiction", "band"),
        ("plant.slow_mode", "time_constant"),
    )
)  # fmt: skip


def _amplitudes(effect: Effect) -> list[str]:
    return [key for key in effect.parameters if key in AMPLITUDES and (effect.name, key) not in NO_AMPLITUDES]


def _scaled(effect: Effect, a: float, most: float = np.inf, least: float = 0.05) -> Effect:
    """Return the effect with its amplitudes multiplied, where that is a step one can trust."""
    if a == 0.0:
        return effect
    factor = float(np.sign(a) * np.clip(abs(a), least, most))
    amplitudes = _amplitudes(effect)
    parameters = {
        key: replace(q, value=q.value * factor) if key in amplitudes else q for key, q in effect.parameters.items()
    }
    return replace(effect, parameters=MappingProxyType(parameters))


def starting_effects(entry: Entry, base: Fit, sizes: Range, data: Data) -> list[Effect]:
    """Return the starting points of an entry for a fit on top of a base."""
    units = {"u": base.parametrisation.model.input.unit, "y": base.parametrisation.model.output.unit}
    plant_in = next((b.unit for b in base.parametrisation.model.blocks if b.place == "actuator" and b.unit), units["u"])
    units |= {"f": plant_in, "v": f"{units['y']}/s"}
    named = [q.unit.format(**units) for q in entry.parameters]
    effects = [effect_with(entry.name, values, named) for values in entry.starts(sizes)]
    if entry.name == "plant.sqrt_outflow" and base.sim.chain.where[I_LEVELS] == 2:
        # two tanks above each other: both outflows go with the root of their level
        return [
            replace(
                e, parameters=MappingProxyType({**e.parameters, "operating_level_2": e.parameters["operating_level"]})
            )
            for e in effects
        ]
    return effects


def best_promises(
    base: Fit, data: Data, entries: Iterable[Entry], pool: Executor, extra: Sequence[Effect] = ()
) -> dict[str, list[Promise]]:
    """Return each entry's promises on top of a base, best first."""
    sizes = signal_ranges(base, data)
    present = {e.name for e in base.model.effects}
    effects = [
        effect
        for entry in entries
        if entry.name not in present and applies(entry, base.sim)
        for effect in starting_effects(entry, base, sizes, data)
    ]
    effects += [e for e in extra if e.name not in present]
    found: dict[str, list[Promise]] = {}
    for group in pool.map(lambda effect: promises(base, effect, data), effects):
        found.setdefault(group[0].effect.name, []).extend(group)
    return {name: sorted(group, key=lambda g: -g.decrease) for name, group in found.items()}


def _begun(base: Fit, effect: Effect, data: Data) -> Hypothesis | None:
    """Fit a base with one more effect for a few steps; nothing where the simulation runs away."""
    try:
        p, theta, states = extended(base, effect, data)
        result = fit(p, data, theta, states, iterations=FIRST_STEPS, rounds=1, inherit=base)
        if result.cost > base.cost:  # start states that dry friction holds need more steps to come free
            result = fit(p, data, result.theta, result.x0, iterations=4 * FIRST_STEPS, rounds=1)
    except RUNAWAY:
        return None
    return Hypothesis(names=tuple(e.name for e in p.model.effects), fit=result)


def _finished(h: Hypothesis, data: Data) -> Hypothesis:
    """Go on with a fit that has begun; where it began to run away, what it had reached stands."""
    try:
        f = h.fit
        result = fit(f.parametrisation, data, f.theta, f.x0, iterations=30, inherit=f)
    except RUNAWAY:
        return h
    return replace(h, fit=freed(result, data) if {HARD_STOP, CONVERTER} & set(h.names) else result)


def is_stand_in(h: Hypothesis, data: Data) -> bool:
    """Whether an effect came to where it is another one by its own name.

    A servo's hysteresis that turns within less than the noise is Coulomb friction, one that never turns is a spring; a
    load periodic in position of which not one period was travelled is a slope.
    """
    sizes = {(e.name, key): q.value for e in h.fit.model.effects for key, q in e.parameters.items()}
    turn = sizes.get(("plant.hysteresis", "width"), 0.0)
    longest = max(turn, sizes.get(("plant.sine_torque", "period"), 0.0))
    if not longest:
        return False
    positions = np.concatenate([signals[:, 2] for signals in h.fit.signals])
    travelled = float(np.nanmax(positions) - np.nanmin(positions))
    return longest > travelled or (h.fit.sim.chain.is_mechanical and 0.0 < turn < data.noise.total_sd)


def freed(result: Fit, data: Data) -> Fit:
    """Return a fit brought out of where no descent leads; itself where a simulation runs away on that way."""
    try:
        return realigned(restarted(result, data), data)
    except RUNAWAY:
        return result


def _distinct(group: Sequence[Promise]) -> list[Effect]:
    """Return the starting points of one entry that differ once they have the size that is promised."""
    kept: list[Effect] = []
    for p in group:
        values = np.array([q.value for q in p.scaled.parameters.values()])
        known = ([q.value for q in e.parameters.values()] for e in kept)
        if p.decrease > 0.0 and not any(np.allclose(values, other, rtol=0.2, atol=0.0) for other in known):
            kept.append(p.scaled)
    return kept


def extend(
    base: Hypothesis, data: Data, pool: Executor, entries: Iterable[Entry] | None = None, most: int = 10,
    extra: Sequence[Effect] = (),
    starts_each: int = 4,
    least: float = 3.0,
) -> list[Hypothesis]:  # fmt: skip
    """Fit the most promising effects on top of a base, best first."""
    promises = best_promises(base.fit, data, CATALOGUE.values() if entries is None else entries, pool, extra)
    ranked = sorted(promises.values(), key=lambda group: -group[0].decrease)
    tried = [*ranked[:most], *(group for group in ranked[most:] if group[0].effect.name == HARD_STOP)]
    starts = [effect for group in tried if group[0].decrease > least for effect in _distinct(group)[:starts_each]]
    begun = [h for h in pool.map(lambda effect: _begun(base.fit, effect, data), starts) if h is not None]
    begun.sort(key=score)
    finished = [h for k, h in enumerate(begun) if _goes_on(h, begun[:k], base)]
    fits: dict[str, Hypothesis] = {}
    for h in pool.map(lambda h: _finished(h, data), finished):
        if is_stand_in(h, data):
            continue
        known = fits.get(h.names[-1])
        if known is None or score(h) < score(known):
            fits[h.names[-1]] = h
    return sorted(fits.values(), key=score)


def _goes_on(h: Hypothesis, better: Sequence[Hypothesis], base: Hypothesis) -> bool:
    """Whether a fit that has begun is worth finishing: among the best few, or near them, and not one name too often."""
    same = [other for other in better if other.names == h.names]
    gained = base.fit.cost - h.fit.cost
    if len(same) >= MOST_EACH or (same and gained < SECOND * (base.fit.cost - same[0].fit.cost)):
        return False
    lead = base.fit.cost - better[0].fit.cost if better else 0.0
    names = {other.names for other in better} | {h.names}
    return len(names) <= FINISHED or gained > NEAR * lead
