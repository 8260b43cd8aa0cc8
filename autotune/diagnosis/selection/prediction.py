"""First order: what adding an effect to a fit would gain, without fitting it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.fitting.bases import basis
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.descent import Iterate, Problem, bounded
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit
from autotune.diagnosis.fitting.parameters import Parametrisation, effect_with, parametrise
from autotune.effects import kind_of
from autotune.effects.base import EffectKind, SignalSizes
from autotune.errors import IdentificationError
from autotune.models import Effect, Model

#: Most simulations of one effect while it is shrunk, and the share of chi2 that a simulation counts that ran away.
SHRINKINGS, RAN_AWAY = 4, 1e6
#: One turn in units of an angle.
TURNS = {"rad": 2.0 * np.pi, "deg": 360.0, "°": 360.0}
#: Share of the forces inside a plant below which the command does not drive it.
UNDRIVEN = 0.03
#: Factors of an effect that are tried: of a signed one, of one that acts one way.
SIGNED, ONE_WAY = (-20.0, 20.0), (0.0, 4.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """A starting point, the decrease of chi2 that the first order predicts from it, and the size it predicts it at."""

    effect: Effect
    decrease: float
    scaled: Effect


def signal_sizes(base: Fit, data: Data) -> SignalSizes:
    """Return the sizes of the signals in the recordings under a fitted model."""
    sim = base.sim
    w = np.concatenate([r.u for r in data.driving]) - sim.u_offset
    y = np.concatenate([r.y[g] for r, g in zip(data.recordings, data.good, strict=True)])
    signals = np.concatenate(base.signals)
    rates = np.abs(np.linalg.eigvals(sim.chain.A))
    rates = rates[rates > 1e-9 * float(rates.max(initial=0.0))]
    duration = max(r.duration_s for r in data.driving)
    # an integrator alone has no time constant: half way, in logarithms, between a sample and a recording
    lag = 1.0 / float(rates.min()) if rates.size else float(np.sqrt(data.sample_times[0] * duration))
    tiny = 1e-100  # of what never moves; its cube is a number still

    def largest(values: FloatArray) -> float:
        # the spikes that a differentiating controller puts into u say nothing of the sizes at work
        return max(float(np.nanquantile(np.abs(values), 0.98)), tiny)

    inner = 0.0
    if sim.chain.is_mechanical:  # forces show in what they move as well, where the command is constant in it alone
        inner = largest(signals[:, 2 if sim.chain.has_spring else 1]) / abs(float(sim.chain.gains[0]))
    return SignalSizes(
        w=largest(w),
        f=max(largest(signals[:, 3]), inner if largest(signals[:, 3]) < UNDRIVEN * inner else 0.0),
        v=largest(signals[:, 1]),
        x=largest(signals[:, 2]),
        y=largest(y - sim.y_offset),
        w_low=float(w.min() + sim.u_offset),
        w_high=float(w.max() + sim.u_offset),
        y_low=float(np.quantile(y, 0.001)),
        y_high=float(np.quantile(y, 0.999)),
        x_offset=sim.y_offset,
        f_peak=max(float(np.nanmax(np.abs(s[:, 3]))) for s in base.signals),
        gain=float(sim.chain.gains[0]),
        lag_s=lag,
        dt_s=data.sample_times[0],
        duration_s=duration,
        levels=sim.chain.levels,
        turn=TURNS.get(base.parametrisation.model.output.unit, 0.0) if sim.chain.has_spring else 0.0,
        static=sim.chain.is_static,
    )


def units_of(kind: EffectKind, model: Model) -> list[str]:
    """Return the units of an effect's parameters in a model."""
    units = {"u": model.input.unit, "y": model.output.unit, "f": model.force_unit, "v": model.speed_unit}
    return [q.unit.format(**units) for q in kind.parameters]


def starting_effects(kind: EffectKind, base: Fit, sizes: SignalSizes) -> list[Effect]:
    """Return the starting points of an effect for a fit on top of a base."""
    units = units_of(kind, base.parametrisation.model)
    return [effect_with(kind.name, values, units) for values in kind.starts(sizes)]


def extend(base: Fit, effect: Effect, data: Data) -> tuple[Parametrisation, FloatArray, tuple[FloatArray, ...]]:
    """Return parametrisation, starting point and start states of a fit with one more effect."""
    old = base.parametrisation
    effects = (*base.model.effects, effect)
    nominal = replace(old.model, effects=effects[: old.own])
    spread = data.thresholds.prior_spread
    p = parametrise(nominal, effects[old.own :], data.command_spread, data.sample_times[0], spread)
    theta = p.centre.copy()
    theta[: base.theta.size] = base.theta
    # an effect's own centre is its starting value; those fitted already keep the scale of their search
    free = (*old.free, *p.free[len(old.free) :])
    p = replace(p, free=free, centre=np.concatenate([old.centre, p.centre[len(old.free) :]]))
    part = kind_of(effect.name).linear
    if part is None or part.start is None or p.simulator(theta).order <= base.sim.order:
        return p, theta, base.x0  # a lag may be one that the chain has already
    return p, theta, carried_states(base, effect, data)


def carried_states(base: Fit, effect: Effect, data: Data) -> tuple[FloatArray, ...]:
    """Return a fit's start states with those of a block that the effect adds, at rest with its neighbour."""
    part = kind_of(effect.name).linear
    if part is None or part.start is None or (part.unless_lagged and base.sim.chain.has_actuator_lag):
        return base.x0
    values, states = effect.values, []
    for r, starts, x in zip(data.driving, data.first_rows, base.x0, strict=True):
        u, y = r.u[np.maximum(starts - 1, 0)] - base.sim.u_offset, x @ base.sim.chain.taps[3]
        added = part.start(u, y, values)
        states.append(np.column_stack([added, x] if part.at == "front" else [x, added]))
    return tuple(states)


def predictions(base: Fit, effect: Effect, data: Data) -> list[Prediction]:
    """Return what the first order predicts when an effect is added to a fit: near zero, and at the size given.

    An effect that moves the reading by more than a share of chi2 is shrunk: what far too large an effect does
    tells nothing of its direction near zero. Dry friction that is as large as that is found from its own size alone.
    """
    tried, linear = [], data.thresholds.linear
    for _ in range(SHRINKINGS):
        found, share = _predicted(base, effect, data)
        tried.append(found)
        if share <= linear or not kind_of(effect.name).amplitudes:
            break
        effect = _scaled(effect, float(np.sqrt(0.3 * linear / share)), least=1e-9)
    return [tried[-1], *tried[:1]] if len(tried) > 1 else tried


def direction(base: Fit, effect: Effect, data: Data) -> FloatArray:
    """Return how an effect moves the whitened residual, freed of what the start states could explain.

    Raises
    ------
    AutotuneError, OverflowError, LinAlgError
        The simulation runs away with the effect.
    """
    return _moved(base, effect, data)[0]


def _moved(base: Fit, effect: Effect, data: Data) -> tuple[FloatArray, Problem, Iterate]:
    """Return that direction (N,), with the extended fit's problem and where it stands with the effect."""
    p, theta, states = extend(base, effect, data)
    problem = Problem(p, data)
    there = problem.iterate(theta, list(states))
    if not bounded(there.e - base.e):
        raise IdentificationError("the simulation runs away", where=effect.name)
    return base.without_states(there.e - base.e), problem, there


def _added_states(base: Fit, effect: Effect, problem: Problem, there: Iterate) -> FloatArray:
    """Return how the start states that an effect adds move the whitened residual, (N, s), freed of the others."""
    order, added = there.sim.order, there.sim.order - base.sim.order
    part = kind_of(effect.name).linear
    if part is None or added <= 0:
        return np.empty((there.e.size, 0))
    problem.scales = problem.data.state_sizes(there.sim)
    columns = problem.state_columns(there, range(added) if part.at == "front" else range(order - added, order))
    return np.column_stack([base.without_states(column) for column in columns.T])


def distinct_starts(group: Sequence[Prediction]) -> list[Effect]:
    """Return the starting points of one effect that differ once they have the size that is predicted."""
    kept: list[Effect] = []
    for p in group:
        values = np.array([q.value for q in p.scaled.parameters.values()])
        known = ([q.value for q in e.parameters.values()] for e in kept)
        if p.decrease > 0.0 and not any(np.allclose(values, other, rtol=0.2, atol=0.0) for other in known):
            kept.append(p.scaled)
    return kept


def _predicted(base: Fit, effect: Effect, data: Data) -> tuple[Prediction, float]:
    """Return what is predicted, and how far the effect moves the reading as a share of chi2.

    The direction d = e(with effect) - e(without) is freed of what the numbers already free could explain; the decrease
    of |e + a d|^2 over 0 <= a <= 4 is predicted, over -20 <= a <= 20 for an effect of either sign. After an impact
    everything goes another way, which no first order tells: a stop that is touched predicts a little always.
    The start states that an effect adds move with it: a lag under a command that is held acts through them alone.
    """
    kind = kind_of(effect.name)
    nothing = Prediction(effect=effect, decrease=0.0, scaled=effect)
    try:
        d, problem, there = _moved(base, effect, data)
        added = _added_states(base, effect, problem, there)
    except RUNAWAY:
        return nothing, RAN_AWAY
    # the fit is at rest: its numbers have nothing to gain by themselves, and their priors are weighed with chi2
    e, d = _without(base, added, np.stack([base.e, d]))
    slope, curvature = -float(d @ e), float(d @ base.without_numbers(d))
    if curvature == 0.0:
        return nothing, 0.0
    low, high = SIGNED if kind.is_signed else ONE_WAY
    if not kind.amplitudes:
        low, high = 0.0, 1.0  # a limit or a step is not made larger by a factor
    a = float(np.clip(slope / curvature, low, high))
    scaled = _scaled(effect, a, 20.0 if kind.is_signed else 2.0)
    least = min(data.thresholds.beyond_chance, curvature) if kind.impacts else 0.0
    # what each start state explains by chance does not count; 0 to the bit of an effect that adds none
    taken, chance = base.e - e, len(base.windows) * added.shape[1] * max(1.0, base.chi2 / base.rows)
    by_states = float(taken @ taken) - chance
    decrease = max(2.0 * a * slope - a * a * curvature + max(by_states, 0.0), least)
    return Prediction(effect=effect, decrease=decrease, scaled=scaled), curvature / base.chi2


def _without(base: Fit, added: FloatArray, directions: FloatArray) -> FloatArray:
    """Return what is left of directions (k, N) when the start states that an effect adds may move as well."""
    if added.shape[1] == 0:
        return directions
    left = directions.copy()
    for a, b in base.windows:
        Q = basis(added[a:b])
        left[:, a:b] -= (left[:, a:b] @ Q) @ Q.T
    return left


def _scaled(effect: Effect, a: float, most: float = np.inf, least: float = 0.05) -> Effect:
    """Return the effect with its amplitudes multiplied, where that is a step one can trust."""
    if a == 0.0:
        return effect
    factor = float(np.sign(a) * np.clip(abs(a), least, most))
    amplitudes = kind_of(effect.name).amplitudes
    return effect.with_values({key: value * factor for key, value in effect.values.items() if key in amplitudes})
