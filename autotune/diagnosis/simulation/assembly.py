"""A model assembled for simulation: blocks and lines of its effects put in, parameters and structure checked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.simulation.chain import build_chain, chain_of, with_unit
from autotune.diagnosis.simulation.simulator import ICE_K, Simulator, layout
from autotune.effects import KINDS, kind_of
from autotune.effects.base import EffectKind
from autotune.errors import InputError
from autotune.models import Block, Effect, Model
from autotune.recording import Recording


def assemble(model: Model) -> Simulator:
    """Assemble a model with its effects for simulation.

    Parameters
    ----------
    model : Model
        Chain and effects.

    Returns
    -------
    Simulator
        What runs it.

    Raises
    ------
    InputError
        An effect that is not in the catalogue, stands twice, lacks a parameter, or does not fit the chain.
    """
    return assemble_at(model, model.blocks, model.input.offset, [values_of(effect, model) for effect in model.effects])


def assemble_at(
    model: Model, blocks: tuple[Block, ...], u_offset: float, each: Sequence[Mapping[str, float]]
) -> Simulator:
    """Assemble a model for simulation with other numbers; a fit does hundreds of thousands of times.

    Parameters
    ----------
    model : Model
        Its name, ports and effects count, not their values.
    blocks, u_offset
        Its blocks, and its operating point [u unit].
    each : sequence of mapping
        The effects' parameters, all of them, see :func:`values_of`.

    Returns
    -------
    Simulator
        What runs it.

    Raises
    ------
    InputError
        As :func:`assemble`.
    """
    known = layout()
    values, acts = np.zeros(len(known.slots)), np.zeros(len(known.kinds), dtype=np.int64)
    blocks, fall = with_unit(blocks, model.output.unit), None
    kinds: list[EffectKind] = []
    for effect, given in zip(model.effects, each, strict=True):
        kind = kind_of(effect.name, model.name)
        if not kind.is_simulated:
            continue
        if kind in kinds:
            raise InputError(f"{kind.name} stands twice", where=model.name, remedy="leave one of the two out")
        kinds.append(kind)
        _require_possible(effect, given, model)
        if kind.lines:
            acts[known.flag(kind.name)] = 1
            for q in kind.parameters:
                values[known.slots[kind.name, q.name]] = given[q.name]
        if kind.linear is not None:
            part = kind.linear
            if part.falling is not None:
                fall = part.falling(blocks, given)
            elif fall is not None and part.blocks is not None:
                fall = part.blocks(fall, given)
            blocks = part.blocks(blocks, given) if part.blocks is not None else blocks
            u_offset += part.u_offset(given) if part.u_offset is not None else 0.0
    chain = chain_of(blocks, model.name)
    for kind in kinds:
        if not kind.needs.holds(chain):
            raise InputError(kind.needs.otherwise, where=model.name, remedy=f"leave {kind.name} out")
    return Simulator(
        chain=chain,
        falling=chain if fall is None else chain_of(fall, model.name),
        kinds=tuple(kinds),
        values=values,
        acts=acts,
        u_offset=u_offset,
        y_offset=model.output.offset,
        kelvin=model.output.offset + (ICE_K if "c" in model.output.unit.lower() else 0.0),
        linear_hold=model.input.hold == "linear",
    )


def values_of(effect: Effect, model: Model) -> dict[str, float]:
    """Return the parameters of a model's effect, neutral ones where they are not given; none of what is not simulated.

    Raises
    ------
    InputError
        A parameter that it does not have, or lacks.
    """
    kind = kind_of(effect.name, model.name)
    if not kind.is_simulated:
        return {}
    known = ", ".join(q.name for q in kind.parameters)
    for key in effect.parameters:
        if kind.quantity(key) is None:
            raise InputError(f"{effect.name} has no parameter {key!r}", where=model.name, remedy=f"known: {known}")
    if not effect.parameters and all(q.neutral is not None for q in kind.parameters):
        raise InputError(f"{effect.name} has no parameters", where=model.name, remedy=f"known: {known}")
    values: dict[str, float] = {}
    for q in kind.parameters:
        if q.name in effect.parameters:
            values[q.name] = effect.parameters[q.name].value
        elif q.neutral is None:
            raise InputError(
                f"{effect.name} lacks {q.name}", where=model.name, remedy=f"add {q.name} to its parameters"
            )
        else:
            values[q.name] = q.neutral
    return values


def _require_possible(effect: Effect, values: Mapping[str, float], model: Model) -> None:
    """Refuse values that an effect cannot take; what is not given has its neutral one, and may be 0."""
    kind = KINDS[effect.name]
    for q in kind.parameters:
        if q.nonzero and q.name in effect.parameters and not values[q.name] > 0.0:
            what = f"{kind.name} has {q.name} = {values[q.name]:g}"
            raise InputError(what, where=model.name, remedy="give it a value above zero")
    wrong = kind.possible(values, model) if kind.possible is not None else ""
    if wrong:
        raise InputError(wrong, where=model.name, remedy=f"leave {kind.name} out")


def states_that_stay(name: str, order: int, fewer: int) -> slice:
    """Return the states that stay when an effect is taken out of a chain: all but those of its block, if it has one.

    Parameters
    ----------
    name : str
        The effect.
    order, fewer : int
        States of the chain with it, and without it.
    """
    part = KINDS[name].linear
    return slice(order - fewer, order) if part is not None and part.at == "front" else slice(0, fewer)


def input_size(model: Model, recordings: Sequence[Recording]) -> float:
    """Return a step of the command's offset: the command's spread, or what moves a reading by a tenth of its own."""
    spread = float(np.std(np.concatenate([r.u for r in recordings])))
    if spread > 0.0:
        return spread
    chain = build_chain(model)
    readings = max(float(np.nanstd(r.y)) for r in recordings)
    try:
        static = abs(float(chain.gains[3] - chain.taps[3] @ np.linalg.solve(chain.A, chain.B[:, 0])))
    except np.linalg.LinAlgError:
        return 1.0
    return 0.1 * readings / static if 0.0 < static < math.inf and readings > 0.0 else 1.0


def spans_of(commands: Sequence[FloatArray], readings: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the largest standard deviation of a command, and of a reading; 0 where there is no reading.

    Parameters
    ----------
    commands, readings : sequence of (N,) array
        Of all recordings.
    """
    spread = max((float(np.std(y)) for y in readings if y.size), default=0.0)
    return max(float(np.std(u)) for u in commands), spread
