"""Numbers, units and clauses as a page writes them."""

from __future__ import annotations

import math

from autotune.models import Parameter


def join_clauses(clauses: list[str]) -> str:
    """Return clauses as one: commas, and ``and`` before the last."""
    if len(clauses) < 2:
        return "".join(clauses)
    return f"{', '.join(clauses[:-1])} and {clauses[-1]}"


def sentence(text: str) -> str:
    """Return a clause as a sentence."""
    return f"{text[:1].upper()}{text[1:]}."


def number(value: float, digits: int = 4) -> str:
    """Return a number, without an exponent where a person reads it more easily so.

    Parameters
    ----------
    value : float
        The number.
    digits : int
        Significant ones.
    """
    if not math.isfinite(value) or value == 0.0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits}g}"
    decimals = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def unit_of(unit: str) -> str:
    """Return a unit as it stands after a number: nothing where there is none."""
    unit = unit.replace("-/s", "1/s") if unit.startswith("-/") else unit
    return "" if unit in ("-", "") else f" {typeset_unit(unit)}"


def typeset_unit(unit: str) -> str:
    """Return a unit with its squares and cubes as they are printed."""
    return unit.replace("^2", "²").replace("^3", "³")


def with_spread(p: Parameter, digits: int = 4) -> str:
    """Return a parameter with its 95 % interval, where that is known, and its unit.

    Parameters
    ----------
    p : Parameter
        Value, standard deviation and unit.
    digits : int
        Significant ones of a value without an interval; one with an interval ends where its interval does.
    """
    half = 1.96 * p.sd
    if not math.isfinite(half):
        return f"{number(p.value, digits)}{unit_of(p.unit)}"
    decimals = 1 - math.floor(math.log10(half)) if half > 0.0 else math.inf
    if not 0 <= decimals <= 7:
        return f"{number(p.value, digits)} ± {number(half, 2)}{unit_of(p.unit)}"
    return f"{p.value:.{decimals}f} ± {half:.{decimals}f}{unit_of(p.unit)}"
