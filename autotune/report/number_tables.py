"""A model's numbers by the names of its blocks, as given, retuned and with effects, in units that people use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.parameters import Free, gain_block
from autotune.models import Block, Model, Parameter
from autotune.report.effect_words import number, with_spread
from autotune.report.page import Table


@dataclass(frozen=True, kw_only=True)
class _Number:
    """What a free number is called, its value in a model, and whether it is searched as a logarithm."""

    block: str
    name: str
    unit: str


def numbers_table(nominal: Fit, retuned: Fit, chosen: Fit) -> Table:
    """Return the chain's numbers before and after, by block.

    Parameters
    ----------
    nominal, retuned, chosen : Fit
        Given numbers, fitted ones, and those beside the effects; the last two the same object where none were added.
    """
    extended = () if chosen is retuned else (chosen,)
    header = ("block", "number", "unit", "nominal", "retuned", *("extended" for _ in extended))
    given = retuned.parametrisation.model
    rows = []
    for free in retuned.parametrisation.free:
        if free.kind == "effect":
            continue
        known = _number(given, free)
        before = _value(retuned.parametrisation.with_values(retuned.parametrisation.centre), free)
        cells = [number(before)]
        for one in (retuned, *extended):
            j = next((k for k, f in enumerate(one.parametrisation.free) if f.name == free.name), None)
            cells.append("-" if j is None else _fitted(one, j))
        rows.append((known.block, known.name, known.unit or "-", *cells))
    return Table(header=header, rows=tuple(rows), caption="Numbers of the chain, with 95 % intervals.")


def _fitted(one: Fit, i: int) -> str:
    free = one.parametrisation.free[i]
    value = _value(one.model, free)
    sd = float(np.sqrt(max(one.covariance[i, i], 0.0))) * (abs(value) if free.positive else free.size)
    return with_spread(Parameter(value=value, sd=sd))


def _number(model: Model, free: Free) -> _Number:
    """Return what a free number is called."""
    if free.kind == "u_offset":
        return _Number(block="input", name="operating point", unit=model.input.unit)
    if free.kind == "delay":
        return _Number(block="chain", name="dead time", unit="s")
    if free.kind == "gain":
        at = gain_block(model.blocks)
        return _Number(block=model.blocks[at].name, name="gain", unit=_gain_unit(model, at))
    block = model.blocks[free.index[0]]
    power = _power(block, free)
    unit = "s" if power == 1 else f"s^{power}"
    if free.kind == "den":
        name = "time constant" if len(block.dynamics.den) == 2 else f"coefficient of s^{power} below"
        return _Number(block=block.name, name=name.replace("s^1 ", "s "), unit=unit)
    return _Number(block=block.name, name="time constant of the zero" if power == 1 else f"zeros, s^{power}", unit=unit)


def _power(block: Block, free: Free) -> int:
    polynomial = block.dynamics.den if free.kind == "den" else block.dynamics.num
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
        return sum(block.dynamics.delay_s for block in model.blocks)
    block = model.blocks[gain_block(model.blocks) if free.kind == "gain" else free.index[0]]
    num, den = block.dynamics.num, block.dynamics.den
    if free.kind == "gain":
        below = next(c for c in reversed(den) if c != 0.0)
        return next((c for c in reversed(num) if c != 0.0), 0.0) / below
    if free.kind == "den":
        return den[free.index[1]] / den[-1]
    return num[free.index[1]] / num[-1] if num[-1] != 0.0 else num[free.index[1]]
