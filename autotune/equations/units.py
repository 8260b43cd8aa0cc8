"""Units of equations: checked where they are given, by dimension and, where no number can convert, by size.

A number alone has no unit in a sum (``u + 3``) and is a plain factor in a product. Where a product holds a number
other than a small fraction or whole number, the number may be a conversion (``100*h``), so that only dimensions are
compared. What has no unit in the file matches everything.
"""

from __future__ import annotations

import math

from autotune.equations.expressions import Call, Expression, Name, Number, to_text
from autotune.equations.model import EquationModel
from autotune.errors import InputError
from autotune.units import Unit, read_unit

_ONE = Unit(powers=(), factor=1.0)


def _parse_unit(text: str, where: str) -> Unit:
    """Return what a unit's text means.

    Raises
    ------
    InputError
        A unit that is not known.
    """
    found = read_unit(text)
    if found is None:
        raise InputError(
            f"the unit {text!r} is not known", where=where, remedy="write e.g. N m, kg m^2, V/s, or leave the unit out"
        )
    return found


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
    known: dict[str, Unit | None] = {"pi": _ONE, "t": read_unit("s")}
    for name, text in given.items():
        known[name] = _parse_unit(text, f"{model.name}: {name}") if text else None
    for name, tree in model.defines:
        known[name] = _Walk(known, f"{model.name}: [define] {name}").unit(tree)
    second = read_unit("s")
    assert second is not None
    for state in model.states:
        where = f"{model.name}: derivative of {state.name}"
        own = known[state.name]
        _compare(_Walk(known, where).unit(state.derivative), None if own is None else own.times(second, -1.0), where)
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
        raise InputError(f"gives {found.text} where {wanted.text} is wanted", where=where,
                         remedy="correct the expression or a unit in it")  # fmt: skip
    if not found.is_as_large_as(wanted):
        raise InputError(
            f"gives a unit {found.factor / wanted.factor:g} times the one that is wanted",
            where=where,
            remedy="convert with a number in the expression, or use one set of units",
        )


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
                return None if a is None or b is None or zero else a.times(b, 1.0 if sign == "*" else -1.0)
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
                return None if unit is None else _ONE.times(unit, 0.5)
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
                    f"{first_text!r} is in {first.text}, {to_text(one)!r} in {unit.text}",
                    where=self._where, remedy="only like units can be added or compared",
                )  # fmt: skip
            if not unit.is_as_large_as(first):
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
            return None if unit is None else _ONE.times(unit, value)
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
            raise InputError(f"{name} of {to_text(argument)!r}, which is in {unit.text}", where=self._where,
                             remedy="its argument is a plain number or an angle")  # fmt: skip
        if name in ("sin", "cos", "tan") and not unit.is_as_large_as(_ONE):
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
