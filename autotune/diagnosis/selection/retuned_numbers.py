"""A chain's numbers by the names of its blocks, as given and as fitted, in units that people use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.parameters import Free, gain_block
from autotune.models import Block, Model


@dataclass(frozen=True, kw_only=True)
class RetunedNumber:
    """A number of a model: as given, retuned alone, and beside what was found, each fit with its 1-sigma.

    Attributes
    ----------
    name, block, unit : str
        What it is, the block that it belongs to ("" in equations), and its unit.
    nominal : float
        As the model file states it.
    retuned, value : (float, float)
        Value and 1-sigma (0 where it was held) with the nominal structure, and in the hypothesis to go on with.
    """

    name: str
    block: str = ""
    unit: str = ""
    nominal: float
    retuned: tuple[float, float]
    value: tuple[float, float]


def retuned_numbers(retuned: Fit, chosen: Fit) -> tuple[RetunedNumber, ...]:
    """Return the chain's numbers before and after, by block.

    Parameters
    ----------
    retuned, chosen : Fit
        Fitted numbers, and those beside the effects; the same object where none were added.
    """
    p, found = retuned.parametrisation, []
    given = p.with_values(p.centre)
    for i, free in enumerate(p.free):
        if free.kind == "effect":
            continue
        beside = next((k for k, f in enumerate(chosen.parametrisation.free) if f.name == free.name), None)
        before = _fitted(retuned, i)
        block, name, unit = _called(p.model, free)
        after = before if beside is None else _fitted(chosen, beside)
        found.append(
            RetunedNumber(name=name, block=block, unit=unit, nominal=_value(given, free), retuned=before, value=after)
        )
    return tuple(found)


def _fitted(one: Fit, i: int) -> tuple[float, float]:
    free = one.parametrisation.free[i]
    value = _value(one.model, free)
    return value, float(np.sqrt(max(one.covariance[i, i], 0.0))) * (abs(value) if free.positive else free.size)


def _called(model: Model, free: Free) -> tuple[str, str, str]:
    """Return a free number's block, name and unit."""
    if free.kind == "u_offset":
        return "input", "operating point", model.input.unit
    if free.kind == "delay":
        return "chain", "dead time", "s"
    if free.kind == "gain":
        at = gain_block(model.blocks)
        return model.blocks[at].name, "gain", _gain_unit(model, at)
    block = model.blocks[free.index[0]]
    power = _power(block, free)
    unit = "s" if power == 1 else f"s^{power}"
    if free.kind == "den":
        name = "time constant" if len(block.dynamics.settling_den) == 2 else f"coefficient of s^{power} below"
        return block.name, name.replace("s^1 ", "s "), unit
    return block.name, "time constant of the zero" if power == 1 else f"zeros, s^{power}", unit


def _power(block: Block, free: Free) -> int:
    polynomial = block.dynamics.settling_den if free.kind == "den" else block.dynamics.num
    return len(polynomial) - 1 - free.index[1]


def _gain_unit(model: Model, at: int) -> str:
    """Return output over input unit of a block, where both are known; an integrator's per second."""
    before = next((b.unit for b in reversed(model.blocks[:at]) if b.unit), model.input.unit)
    after = model.blocks[at].unit or (model.output.unit if at == len(model.blocks) - 1 else "")
    if not (before and after):
        return ""
    rate = "/s" if model.blocks[at].dynamics.den[-1] == 0.0 else ""
    unit = f"{after}{rate}"
    if before == "-":
        return unit
    return "1" if unit == before else f"({unit})/{before}" if "/" in unit else f"{unit}/{before}"


def _value(model: Model, free: Free) -> float:
    """Return a free number's value in a model."""
    if free.kind == "u_offset":
        return model.input.offset
    if free.kind == "delay":
        return model.delay_s
    block = model.blocks[gain_block(model.blocks) if free.kind == "gain" else free.index[0]]
    num, den = block.dynamics.num, block.dynamics.settling_den
    if free.kind == "gain":
        return next((c for c in reversed(num) if c != 0.0), 0.0) / den[-1]
    if free.kind == "den":
        return den[free.index[1]] / den[-1]
    return num[free.index[1]] / num[-1] if num[-1] != 0.0 else num[free.index[1]]
