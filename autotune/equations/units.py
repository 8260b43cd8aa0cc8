"""Units of equations: checked where they are given, by dimension and, where no number can convert, by size.

A number alone has no unit in a sum (``u + 3``) and is a plain factor in a product. Where a product holds a number
other than a small fraction or whole number, the number may be a conversion (``100*h``), so that only dimensions are
compared. What has no unit in the file matches everything.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from autotune.equations.expressions import Call, Expression, Name, Number, to_text
from autotune.equations.model import EquationModel
from autotune.errors import InputError

#: Units that engineers write and the library of units does not know; they have no dimension.
PLAIN = {"", "1", "-", "%", "count", "counts", "step", "steps", "lsb", "digit", "pu", "p.u.", "duty", "pwm"}
_SPELT = {"°C": "degC", "°F": "degF", "°": "deg", "Ω": "ohm", "µ": "u", "²": "^2", "³": "^3", "·": " ", "⋅": " ",
          "Nm^3": "m^3", "Nm3": "m^3"}  # fmt: skip
#: What engineers mean by names that the library of units knows as something else, or not at all: there Nm is a
#: fineness of yarn, Nms are several of it, and cfm a hundredth of a femtometre.
_MEANT = (
    "newton_metre = newton * metre = Nm", "newton_metre_second = newton * metre * second = Nms",
    "newton_second = newton * second = Ns", "pascal_second = pascal * second = Pas",
    "volt_second = volt * second = Vs", "ampere_second = ampere * second = As", "watt_second = watt * second = Ws",
    "cubic_foot_per_minute = foot ** 3 / minute = cfm", "acidity = 1 = pH", "hundredth = 0.01 = pct",
)  # fmt: skip
#: A power as plain text has it: m/s2, m s-2.
_PLAIN_POWER = re.compile(r"(?<=[A-Za-z])(-?[1-9])\b")


@dataclass(frozen=True, kw_only=True)
class Unit:
    """A unit as powers of base units and a factor to them; factor NaN where a number may have converted it."""

    powers: tuple[tuple[str, float], ...]
    factor: float

    @property
    def is_plain(self) -> bool:
        """Whether it has no dimension."""
        return not self.powers


_ONE = Unit(powers=(), factor=1.0)


def _parse_unit(text: str, where: str) -> Unit:
    """Return what a unit's text means.

    Raises
    ------
    InputError
        A unit that is not known.
    """
    found = _parse(text.strip())
    if found is None:
        raise InputError(
            f"the unit {text!r} is not known", where=where, remedy="write e.g. N m, kg m^2, V/s, or leave the unit out"
        )
    return found


@lru_cache(maxsize=512)
def _parse(text: str) -> Unit | None:
    if text.lower() in PLAIN:
        return Unit(powers=(), factor=0.01 if text == "%" else 1.0)
    for given, known in _SPELT.items():
        text = text.replace(given, known)
    found = _base_units(text) or _base_units(_PLAIN_POWER.sub(r"^\1", text))
    if found is None:
        return None
    factor, base = found
    powers = tuple(sorted((str(n), float(p)) for n, p in base._units.items() if str(n) != "radian"))
    return Unit(powers=tuple((n.removeprefix("delta_"), p) for n, p in powers), factor=factor)


def _base_units(text: str) -> tuple[float, Any] | None:
    registry = _registry()
    try:
        factor, base = registry.get_base_units(registry.parse_units(text, as_delta=True))
    except Exception:  # the library has many ways to say that it does not know
        return None
    return float(factor), base


@lru_cache(maxsize=1)
def _registry() -> Any:
    import pint

    registry = pint.UnitRegistry(on_redefinition="ignore")
    for line in _MEANT:
        registry.define(line)
    return registry


def understood(text: str) -> Unit | None:
    """Return what a unit's text means; None where it is not known."""
    return _parse(text.strip())


def check_units(model: EquationModel) -> None:
    """Refuse a model whose units contradict each other.

    Raises
    ------
    InputError
        The expression, what it gives and what it should give.
    """
    given: dict[str, str] = {one.column: one.unit for one in model.inputs}
    given |= {one.name: one.unit for one in model.states}
    given |= {one.name: one.unit for one in model.parameters} | {one.name: one.unit for one in model.ports}
    _check_effects(model)
    if not any(given.values()) and not model.output_unit:
        return
    known: dict[str, Unit | None] = {"pi": _ONE, "t": _parse("s")}
    for name, text in given.items():
        known[name] = _parse_unit(text, f"{model.name}: {name}") if text else None
    for name, tree in model.defines:
        known[name] = _Walk(known, f"{model.name}: [define] {name}").unit(tree)
    second = _parse("s")
    assert second is not None
    for state in model.states:
        where = f"{model.name}: derivative of {state.name}"
        own = known[state.name]
        _compare(_Walk(known, where).unit(state.derivative), None if own is None else _times(own, second, -1.0), where)
    for port in model.ports:
        if port.across is not None:
            _Walk(known, f"{model.name}: across of port {port.name}").unit(port.across)
    where = f"{model.name}: [output] value"
    wanted = _parse_unit(model.output_unit, where) if model.output_unit else None
    _compare(_Walk(known, where).unit(model.output), wanted, where)


def _check_effects(model: EquationModel) -> None:
    """Refuse a unit of an effect's parameter that is not known; what it should be, the effect's equation says."""
    for effect in model.effects:
        for key, one in effect.parameters.items():
            _parse_unit(one.unit, f"{model.name}: {effect.name} {key}")


def _compare(found: Unit | None, wanted: Unit | None, where: str) -> None:
    if found is None or wanted is None:
        return
    if found.powers != wanted.powers:
        raise InputError(f"gives {unit_text(found)} where {unit_text(wanted)} is wanted", where=where,
                         remedy="correct the expression or a unit in it")  # fmt: skip
    if not _same_size(found, wanted):
        raise InputError(
            f"gives a unit {found.factor / wanted.factor:g} times the one that is wanted",
            where=where,
            remedy="convert with a number in the expression, or use one set of units",
        )


def _same_size(a: Unit, b: Unit) -> bool:
    return not abs(a.factor / b.factor - 1.0) > 1e-6  # NaN: not comparable


def _times(a: Unit, b: Unit, power: float = 1.0) -> Unit:
    powers = dict(a.powers)
    for name, exponent in b.powers:
        powers[name] = powers.get(name, 0.0) + power * exponent
    kept = tuple(sorted((n, round(p, 9)) for n, p in powers.items() if abs(p) > 1e-9))
    return Unit(powers=kept, factor=a.factor * b.factor**power)


def unit_text(unit: Unit) -> str:
    """Return a unit's base units as a person writes them."""
    short = {"meter": "m", "kilogram": "kg", "second": "s", "ampere": "A", "kelvin": "K", "mole": "mol", "gram": "g"}
    parts = [short.get(n, n) + ("" if p == 1.0 else f"^{p:g}") for n, p in unit.powers]
    return " ".join(parts) or "a plain number"


class _Walk:
    """The units of one expression, from its leaves up; None where a unit was not given."""

    def __init__(self, known: dict[str, Unit | None], where: str) -> None:
        self._known, self._where = known, where

    def unit(self, tree: Expression) -> Unit | None:
        match tree:
            case Number(value):
                return None if value == 0.0 else Unit(powers=(), factor=1.0 if _is_count(value) else math.nan)
            case Name(name):
                return self._known.get(name)
            case Call("neg", (inner,)) | Call("abs", (inner,)):
                return self.unit(inner)
            case Call(("*" | "/") as sign, (left, right)):
                a, b = self.unit(left), self.unit(right)
                zero = Number(0.0) in (left, right)
                return None if a is None or b is None or zero else _times(a, b, 1.0 if sign == "*" else -1.0)
            case Call(("+" | "-" | "min" | "max"), arguments):
                return self._alike(tree, arguments)
            case Call("if", (condition, then, otherwise)):
                assert isinstance(condition, Call)
                self._alike(condition, condition.arguments)
                return self._alike(tree, (then, otherwise))
            case Call("^", (base, exponent)):
                return self._power(base, exponent)
            case Call("sqrt", (inner,)):
                unit = self.unit(inner)
                return None if unit is None else _times(_ONE, unit, 0.5)
            case Call("sign", (inner,)):
                self.unit(inner)
                return _ONE
            case Call("atan2", arguments):
                self._alike(tree, arguments)
                return _ONE
        assert isinstance(tree, Call)
        self._plain(tree, tree.arguments[0])
        return _ONE

    def _alike(self, tree: Expression, arguments: tuple[Expression, ...]) -> Unit | None:
        """Return the unit that all arguments share; numbers alone take any."""
        units = [(one, self.unit(one)) for one in arguments if not _is_number(one)]
        given = [(one, unit) for one, unit in units if unit is not None]
        for one, unit in given[1:]:
            first_text, first = to_text(given[0][0]), given[0][1]
            if unit.powers != first.powers:
                raise InputError(
                    f"{first_text!r} is in {unit_text(first)}, {to_text(one)!r} in {unit_text(unit)}",
                    where=self._where, remedy="only like units can be added or compared",
                )  # fmt: skip
            if not _same_size(unit, first):
                raise InputError(
                    f"{first_text!r} and {to_text(one)!r} are in units that differ by a factor of "
                    f"{unit.factor / first.factor:g}",
                    where=self._where, remedy="convert one of them with a number",
                )  # fmt: skip
        if len(given) < len(units):
            return None
        return given[0][1] if given else (None if isinstance(tree, Call) and tree.function == "if" else _ONE)

    def _power(self, base: Expression, exponent: Expression) -> Unit | None:
        unit = self.unit(base)
        value = _value(exponent)
        if value is not None:
            return None if unit is None else _times(_ONE, unit, value)
        self._plain(exponent, exponent)
        if unit is not None and not unit.is_plain:
            return None
        return unit

    def _plain(self, tree: Expression, argument: Expression) -> None:
        unit = self.unit(argument)
        if unit is None:
            return
        name = tree.function if isinstance(tree, Call) else "a power"
        if not unit.is_plain:
            raise InputError(f"{name} of {to_text(argument)!r}, which is in {unit_text(unit)}", where=self._where,
                             remedy="its argument is a plain number or an angle")  # fmt: skip
        if name in ("sin", "cos", "tan") and not _same_size(unit, _ONE):
            raise InputError(f"{name} of {to_text(argument)!r}, which is not in radians", where=self._where,
                             remedy="multiply by pi/180 in the expression")  # fmt: skip


def _is_number(tree: Expression) -> bool:
    return _value(tree) is not None


def _value(tree: Expression) -> float | None:
    match tree:
        case Number(value):
            return value
        case Call("neg", (inner,)):
            number = _value(inner)
            return None if number is None else -number
        case Call("/", (left, right)):
            a, b = _value(left), _value(right)
            return None if a is None or not b else a / b
    return None


def _is_count(value: float) -> bool:
    """Whether a number is a small whole number or a simple fraction, and so no conversion."""
    return any(0 < abs(value * k) < 10 and abs(value * k - round(value * k)) < 1e-12 for k in (1, 2, 3, 4, 6, 8))
