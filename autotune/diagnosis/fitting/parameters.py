"""What is free in a fit: the chain's own numbers, with their prior, and the parameters of effects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.simulation.assembly import assemble_at, values_of
from autotune.diagnosis.simulation.simulator import Simulator
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of
from autotune.models import LARGEST, Block, Effect, Model, Parameter, TransferFunction

Kind: TypeAlias = Literal["gain", "den", "num", "delay", "u_offset", "effect"]
#: How many times as uncertain as other numbers the damping of a mode that rings is: it is read off a decay that
#: friction shapes as well.
DAMPING = 4.0


@dataclass(frozen=True, kw_only=True)
class Free:
    """One free number.

    Attributes
    ----------
    name : str
        For tables.
    kind : str
        What it changes.
    index : tuple of int
        Block and coefficient, or effect and parameter.
    positive : bool
        Searched as a logarithm.
    size : float
        Its natural size: unit of a step where it is searched linearly.
    spread : float
        Standard deviation of its prior, in units of the search; infinite where there is none.
    turns : bool
        Whether it acts by the angle that it adds up until a recording's end.
    """

    name: str
    kind: Kind
    index: tuple[int, int] = (0, 0)
    positive: bool = True
    size: float = 1.0
    spread: float = math.inf
    turns: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Parametrisation:
    """A model with numbers set free.

    Attributes
    ----------
    model : Model
        Nominal chain with the effects at their starting values.
    free : tuple of Free
        What is free.
    centre : (p,) array
        Nominal values in units of the search; also the prior's mean.
    own : int
        How many of the effects, the first ones, the nominal model has itself: they are its structure, not a finding.
    """

    model: Model
    free: tuple[Free, ...]
    centre: FloatArray
    own: int = 0

    @property
    def added(self) -> tuple[Effect, ...]:
        """The effects that the nominal model does not have."""
        return self.model.effects[self.own :]

    @cached_property
    def spreads(self) -> FloatArray:
        """Prior standard deviations in units of the search."""
        return np.array([f.spread for f in self.free])

    def value(self, i: int, theta: FloatArray) -> float:
        """Return free number i in its own unit."""
        f = self.free[i]
        return math.exp(theta[i]) if f.positive else theta[i] * f.size

    @property
    def effect_numbers(self) -> int:
        """Free numbers beyond those of the nominal structure, those that a direct search sets included."""
        located = sum(
            q.role == "location" and q.name in effect.parameters
            for effect in self.added
            for q in kind_of(effect.name).parameters
        )
        return located + sum(f.kind == "effect" and f.index[0] >= self.own for f in self.free)

    def simulator(self, theta: FloatArray) -> Simulator:
        """Return the model at a point of the search, assembled."""
        blocks, u_offset, effects = self._at(theta)
        each = [dict(known) for known in self._values]
        for (number, key), value in effects.items():
            each[number][key] = value
        return assemble_at(self.model, blocks, u_offset, each)

    def with_values(self, theta: FloatArray) -> Model:
        """Return the model at a point of the search."""
        blocks, u_offset, effects = self._at(theta)
        return replace(
            self.model,
            input=replace(self.model.input, offset=u_offset),
            blocks=blocks,
            effects=tuple(
                effect.with_values({key: value for (number, key), value in effects.items() if number == i})
                for i, effect in enumerate(self.model.effects)
            ),
        )

    def _at(self, theta: FloatArray) -> tuple[tuple[Block, ...], float, dict[tuple[int, str], float]]:
        """Return blocks, the command's operating point, and numbers of effects by effect and name."""
        gain, u_offset, delay = 1.0, self.model.input.offset, None
        factors: list[tuple[tuple[str, int, int], float]] = []
        effects: dict[tuple[int, str], float] = {}
        for i, f in enumerate(self.free):
            value = self.value(i, theta)
            if f.kind == "gain":
                gain = value
            elif f.kind == "u_offset":
                u_offset = self.model.input.offset + value
            elif f.kind == "delay":
                delay = max(value, 0.0)
            elif f.kind == "effect":
                effects[f.index[0], f.name.rpartition(".")[2]] = value
            else:
                factors.append(((f.kind, *f.index), value))
        return _scaled(self.model.blocks, gain, tuple(factors), delay), u_offset, effects

    @cached_property
    def _values(self) -> tuple[dict[str, float], ...]:
        return tuple(values_of(effect, self.model) for effect in self.model.effects)


@lru_cache(maxsize=64)
def _scaled(
    blocks: tuple[Block, ...],
    gain: float,
    multiplied: tuple[tuple[tuple[str, int, int], float], ...],
    delay: float | None,
) -> tuple[Block, ...]:
    """Return the blocks with their coefficients multiplied, the whole gain put on the gain's block.

    Effects are tried on the same chain again and again.
    """
    target, factors = gain_block(blocks), dict(multiplied)
    result = []
    for i, block in enumerate(blocks):
        dynamics = block.dynamics
        num = [c * factors.get(("num", i, j), 1.0) for j, c in enumerate(dynamics.num)]
        den = [c * factors.get(("den", i, j), 1.0) for j, c in enumerate(dynamics.den)]
        if i == target:
            num = [c * gain for c in num]
        wait = dynamics.delay_s if delay is None else (delay if i == 0 else 0.0)
        result.append(replace(block, dynamics=TransferFunction(num=tuple(num), den=tuple(den), delay_s=wait)))
    return tuple(result)


def gain_block(blocks: Sequence[Block]) -> int:
    """Return the number of the block that carries the chain's uncertain gain: the first dynamic one of the plant."""
    dynamic = [i for i, block in enumerate(blocks) if len(block.dynamics.den) > 1]
    plant = [i for i in dynamic if blocks[i].place == "plant"]
    return (plant or dynamic or [0])[0]


@lru_cache(maxsize=16)
def chain_parameters(
    blocks: tuple[Block, ...], input_size: float, sample_time_s: float, prior_spread: float
) -> tuple[tuple[Free, ...], tuple[float, ...]]:
    """Return the chain's free numbers and their centres; a search asks for the same ones with every effect it tries.

    Parameters
    ----------
    blocks : tuple of Block
        Nominal chain.
    input_size : float
        Size of the command's deviations, the step of its offset.
    sample_time_s : float
        Sample time [s], the least uncertainty of a dead time.
    prior_spread : float
        Standard deviation of a nominal number's logarithm.

    Returns
    -------
    free, centre
        Gain, every lag (coefficients of denominators above the last one that is not 0), zeros, dead time where the
        model has one, and the command's operating point.
    """
    free = [Free(name="gain", kind="gain", spread=prior_spread)]
    centre = [0.0]
    for i, block in enumerate(blocks):
        den, num = block.dynamics.den, block.dynamics.num
        # the last coefficient goes with the gain: of what integrates, the last one that is not 0
        for j in range(len(block.dynamics.settling_den) - 1):
            if den[j] != 0.0:
                spread = prior_spread * (DAMPING if _is_damping(den, j) else 1.0)
                free.append(Free(name=f"{block.name} den[{j}]", kind="den", index=(i, j), spread=spread))
                centre.append(0.0)
        for j in range(len(num) - 1):
            if num[j] != 0.0:
                free.append(Free(name=f"{block.name} num[{j}]", kind="num", index=(i, j), spread=prior_spread))
                centre.append(0.0)
    delay = sum(block.dynamics.delay_s for block in blocks)
    if delay > 0.0:
        # searched in units of the dead time itself: a logarithm would never reach zero
        spread = max(prior_spread, 0.5 * sample_time_s / delay)
        free.append(Free(name="dead time", kind="delay", positive=False, size=delay, spread=spread))
        centre.append(1.0)
    free.append(Free(name="input offset", kind="u_offset", positive=False, size=input_size))
    centre.append(0.0)
    return tuple(free), tuple(centre)


def _is_damping(den: Sequence[float], j: int) -> bool:
    """Whether a coefficient is the damping of a mode that rings."""
    return len(den) == 3 and j == 1 and den[1] ** 2 < 4.0 * den[0] * den[2]


def parametrise(
    model: Model,
    effects: Sequence[Effect],
    input_size: float,
    sample_time_s: float,
    prior_spread: float = Thresholds.prior_spread,
) -> Parametrisation:
    """Set a model's numbers and those of effects free.

    Parameters
    ----------
    model : Model
        Nominal model; effects that it has are part of its structure, and their numbers have the prior of its others.
    effects : sequence of Effect
        Further effects at their starting values. Parameters that count or mark stay as they are.
    input_size, sample_time_s, prior_spread : float
        As in :func:`chain_parameters`.

    Returns
    -------
    Parametrisation
        Chain and effects, ready to be fitted.
    """
    numbers = chain_parameters(model.blocks, input_size, sample_time_s, prior_spread)
    free, centre = list(numbers[0]), list(numbers[1])
    own, effects = len(model.effects), (*model.effects, *effects)
    for number, effect in enumerate(effects):
        kind = kind_of(effect.name)
        for j, (key, parameter) in enumerate(effect.parameters.items()):
            q = kind.quantity(key)
            values = {name: given.value for name, given in effect.parameters.items()}
            if q is None or not q.is_fitted or (q.held is not None and q.held(values)):
                continue
            positive = q.sign == "positive"
            if number < own and _is_absent(parameter.value, q.neutral, positive):
                continue
            parts = [effect.parameters[k].value for k in (key, *q.size_with) if k in effect.parameters]
            size = math.hypot(*parts) or 1.0
            name = f"{effect.name}.{key}"
            spread = prior_spread if number < own else math.inf
            free.append(
                Free(name=name, kind="effect", index=(number, j), positive=positive, size=size, spread=spread,
                     turns=q.turns)
            )  # fmt: skip
            centre.append(math.log(parameter.value) if positive else parameter.value / size)
    return Parametrisation(model=replace(model, effects=effects), free=tuple(free), centre=np.array(centre), own=own)


def _is_absent(value: float, neutral: float | None, positive: bool) -> bool:
    """Whether a nominal effect's number is one that cannot be retuned: a limit never reached, or a size of 0."""
    return value == neutral or value == 0.0 or abs(value) >= LARGEST or (positive and value < 0.0)


def effect_with(name: str, values: Sequence[float], units: Sequence[str] = ()) -> Effect:
    """Return an effect of the catalogue with values for its parameters, in their order; the last may be left out."""
    quantities = kind_of(name).parameters[: len(values)]
    given = list(units) or [""] * len(quantities)
    parameters = {
        q.name: Parameter(value=float(v), unit=unit)
        for q, v, unit in zip(quantities, values, given[: len(quantities)], strict=True)
    }
    return Effect(name=name, parameters=MappingProxyType(parameters))
