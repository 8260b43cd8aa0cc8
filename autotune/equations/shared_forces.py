"""Forces that act on several states at once: a spring between two bodies, friction of a cart that a load hangs on.

A force that is missing from a model acts where the model's own forces do. A product of a parameter with a speed or a
difference of speeds (or of positions) that is in the derivatives of several states is one of them, and how the states
share it stands in the equations: the derivatives are linear in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from types import MappingProxyType

from autotune.equations.expressions import Call, Expression, Name, Number, names_in, substitute
from autotune.equations.model import EquationModel


@dataclass(frozen=True, kw_only=True)
class Joint:
    """What a force on a state goes with.

    Attributes
    ----------
    speed, position : Expression
        Of the state, or the difference that a force of the model which it shares with others lies across.
    shares : mapping of state to Expression
        What the derivatives of other states take of the force, in units of what the state's own takes.
    """

    speed: Expression
    position: Expression
    shares: MappingProxyType[str, Expression] = field(default_factory=lambda: MappingProxyType({}))


def joint_at(model: EquationModel, name: str) -> Joint:
    """Return what a force on a state goes with: the state alone, unless a force of the model there acts elsewhere too.

    Parameters
    ----------
    model : EquationModel
        The equations.
    name : str
        A state. A force across a difference belongs to the state that is first in it.
    """
    state = next(one for one in model.states if one.name == name)
    alone = Joint(speed=Name(name), position=Name(state.of) if state.of else Name(name))
    if not state.of:
        return alone
    defines: dict[str, Expression] = {}
    for key, tree in model.defines:
        defines[key] = substitute(tree, defines.get)
    slopes = {one.name: substitute(one.derivative, defines.get) for one in model.states}
    for parameter, across in _products(slopes[name], frozenset(model.parameter_names)):
        speed, position = _across(model, across)
        if speed is None or position is None or _first(speed) != name:
            continue
        slope = {key: _slope(tree, parameter, across) for key, tree in slopes.items()}
        own, shares = slope.pop(name), {key: one for key, one in slope.items() if one != _NONE}
        if shares and None not in (own, *shares.values()) and own != _NONE:
            each = {key: _ratio(one, own) for key, one in shares.items() if one is not None and own is not None}
            return Joint(speed=speed, position=position, shares=MappingProxyType(each))
    return alone


_NONE = Number(0.0)


def _ratio(one: Expression, other: Expression) -> Expression:
    """Return a quotient without the factors that both have."""
    number, above, below = _factors(one)
    divisor, under, over = _factors(other)
    above, below = [*above, *over], [*below, *under]
    for factor in list(above):
        if factor in below:
            above.remove(factor)
            below.remove(factor)
    tree: Expression = Number(number / divisor)
    for factor in above:
        signed: dict[Expression, Expression] = {Number(1.0): factor, Number(-1.0): Call("neg", (factor,))}
        tree = signed.get(tree, Call("*", (tree, factor)))
    for factor in below:
        tree = Call("/", (tree, factor))
    return tree


def _factors(tree: Expression) -> tuple[float, list[Expression], list[Expression]]:
    """Return a product's number, and the other factors above and below the line."""
    match tree:
        case Number(value):
            return value, [], []
        case Call("neg", (inner,)):
            number, above, below = _factors(inner)
            return -number, above, below
        case Call(("*" | "/") as sign, (left, right)):
            first, second = _factors(left), _factors(right)
            if sign == "/":
                second = 1.0 / second[0], second[2], second[1]
            return first[0] * second[0], [*first[1], *second[1]], [*first[2], *second[2]]
    return 1.0, [tree], []


def _products(tree: Expression, parameters: frozenset[str]) -> Iterator[tuple[str, Expression]]:
    """Yield the products of a parameter and something else that a tree has in it, from its left to its right."""
    if not isinstance(tree, Call):
        return
    for one in tree.arguments:
        yield from _products(one, parameters)
    if tree.function == "*":
        for factor, other in (tree.arguments, tree.arguments[::-1]):
            bare = factor.arguments[0] if isinstance(factor, Call) and factor.function == "neg" else factor
            if isinstance(bare, Name) and bare.name in parameters:
                yield bare.name, other


def _across(model: EquationModel, tree: Expression) -> tuple[Expression | None, Expression | None]:
    """Return the speed and the position of a speed, a position, or a difference of two of a kind; else nothing."""
    at = {one.name: one.of for one in model.states if one.of}
    speeds = {position: name for name, position in at.items()}
    parts = tree.arguments if isinstance(tree, Call) and tree.function == "-" else (tree,)
    names = [one.name for one in parts if isinstance(one, Name)]
    if len(names) == len(parts) and all(name in at for name in names):
        return tree, substitute(tree, lambda name: Name(at[name]))
    if len(names) == len(parts) and all(name in speeds for name in names):
        return substitute(tree, lambda name: Name(speeds[name])), tree
    return None, None


def _first(tree: Expression) -> str:
    first = tree.arguments[0] if isinstance(tree, Call) else tree
    assert isinstance(first, Name)
    return first.name


def _slope(tree: Expression, parameter: str, across: Expression) -> Expression | None:
    """Return the derivative of a tree to the product of a parameter and what it lies across.

    Nothing is returned where the tree is not linear in the product, or the parameter stands without it.
    """
    if parameter not in names_in(tree):
        return _NONE
    if not isinstance(tree, Call):
        return None
    function, arguments = tree.function, tree.arguments
    if function == "*":
        for factor, other in (arguments, arguments[::-1]):
            if other == across and factor == Name(parameter):
                return Number(1.0)
            if other == across and factor == Call("neg", (Name(parameter),)):
                return Number(-1.0)
    parts = [_slope(one, parameter, across) for one in arguments]
    if None in parts:
        return None
    slopes = [one for one in parts if one is not None]
    if function == "neg":
        return Call("neg", (slopes[0],))
    if function in ("+", "-"):
        left, right = slopes
        if right == _NONE:
            return left
        if left == _NONE:
            return right if function == "+" else Call("neg", (right,))
        return Call(function, (left, right))
    if function == "*" and _NONE in slopes:
        left, right = arguments
        return Call("*", (slopes[0], right)) if slopes[1] == _NONE else Call("*", (left, slopes[1]))
    if function == "/" and slopes[1] == _NONE:
        return Call("/", (slopes[0], arguments[1]))
    return None
