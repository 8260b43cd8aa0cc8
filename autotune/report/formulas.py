"""Equations of a model as MathML, which browsers set as formulas without a script."""

from __future__ import annotations

import html
import re

from autotune.equations.expressions import Call, Expression, Name, Number, number_text
from autotune.equations.flatten import flattened
from autotune.equations.model import EquationModel

_GREEK = {
    name: chr(code)
    for first, names in (
        (0x3B1, "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi omicron pi rho"),
        (0x3C3, "sigma tau upsilon phi chi psi omega"),
        (0x393, "Gamma Delta"), (0x398, "Theta"), (0x39B, "Lambda"), (0x39E, "Xi"), (0x3A0, "Pi"), (0x3A3, "Sigma"),
        (0x3A6, "Phi"), (0x3A8, "Psi Omega"),
    )
    for code, name in enumerate(names.split(), first)
}  # fmt: skip
_SIGNS = {"<": "&lt;", "<=": "≤", ">": "&gt;", ">=": "≥"}
_FUNCTIONS = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "sign": "sgn", "log": "ln"}


def model_formulas(model: EquationModel) -> tuple[str, ...]:
    """Return the equations of a model as MathML, one for each helper, state and the output.

    Parameters
    ----------
    model : EquationModel
        Effects that act on samples it must not have.

    Raises
    ------
    InputError
        It has effects that no equation holds.
    """
    flat = flattened(model)
    lines = [(_symbol(name), tree) for name, tree in flat.defines]
    slope = "<mfrac><mrow><mi>d</mi>{}</mrow><mrow><mi>d</mi><mi>t</mi></mrow></mfrac>"
    lines += [(slope.format(_symbol(one.name)), one.derivative) for one in flat.states]
    lines.append((_symbol("y"), flat.output))
    return tuple(f'<math display="block"><mrow>{left}<mo>=</mo>{_set(tree)[0]}</mrow></math>' for left, tree in lines)


def _symbol(name: str) -> str:
    """Return a name: a letter with its index, or words."""
    head, _, tail = name.partition("_")
    if (match := re.fullmatch(r"([A-Za-z]+)(\d+)", head)) and not tail:
        head, tail = match[1], match[2]
    if len(head) > 2 and head not in _GREEK:
        return f"<mtext>{html.escape(name.replace('_', ' '))}</mtext>"
    shown = f"<mi>{html.escape(_GREEK.get(head, head))}</mi>"
    return f"<msub>{shown}<mtext>{html.escape(tail.replace('_', ' '))}</mtext></msub>" if tail else shown


def _set(tree: Expression) -> tuple[str, int]:
    """Return MathML and how tightly the outermost operator binds."""
    match tree:
        case Number(value):
            mantissa, _, exponent = number_text(value).partition("e")
            if not exponent:
                return f"<mn>{mantissa}</mn>", 5
            return f"<mn>{mantissa}</mn><mo>·</mo>{_power_of_ten(int(exponent))}", 2
        case Name(name):
            return _symbol(name), 5
        case Call("neg" | "*" | "/") if (positive := _without_minus(tree)) is not None:
            return f"<mo>−</mo>{_inside(positive, 2)}", 1
        case Call("/", (above, below)):
            return f"<mfrac><mrow>{_set(above)[0]}</mrow><mrow>{_set(below)[0]}</mrow></mfrac>", 4
        case Call("*", (left, right)):
            second = _inside(right, 2)
            is_number = re.match(r"(<msup><mrow>)?<mn>", second)
            between = "<mo>·</mo>" if is_number else '<mspace width="0.17em"/>'
            return f"{_inside(left, 2)}{between}{second}", 2
        case Call(("+" | "-") as sign, (left, right)):
            return _sum(left, sign, right), 1
        case Call("^", (base, exponent)):
            return f"<msup><mrow>{_inside(base, 5)}</mrow><mrow>{_set(exponent)[0]}</mrow></msup>", 3
        case Call("sqrt", (inner,)):
            return f"<msqrt>{_set(inner)[0]}</msqrt>", 5
        case Call("abs", (inner,)):
            return f"<mrow><mo>|</mo>{_set(inner)[0]}<mo>|</mo></mrow>", 5
        case Call("if", (condition, then, otherwise)):
            return _cases(condition, then, otherwise), 0
        case Call(sign, (left, right)) if sign in _SIGNS:
            return f"{_set(left)[0]}<mo>{_SIGNS[sign]}</mo>{_set(right)[0]}", 0
    assert isinstance(tree, Call)
    among = "<mo>,</mo>".join(_set(one)[0] for one in tree.arguments)
    name = _FUNCTIONS.get(tree.function, tree.function)
    return f"<mrow><mi>{name}</mi><mo>(</mo>{among}<mo>)</mo></mrow>", 5


def _power_of_ten(exponent: int) -> str:
    sign = "<mo>−</mo>" if exponent < 0 else ""
    return f"<msup><mn>10</mn><mrow>{sign}<mn>{abs(exponent)}</mn></mrow></msup>"


def _sum(left: Expression, sign: str, right: Expression) -> str:
    """Return a sum or a difference: what is added with a minus of its own is subtracted."""
    positive = _without_minus(right) if sign == "+" else None
    if positive is not None:
        sign, right = "-", positive
    return f"{_inside(left, 1)}<mo>{'−' if sign == '-' else '+'}</mo>{_inside(right, 1 if sign == '+' else 2)}"


def _without_minus(tree: Expression) -> Expression | None:
    """Return what a leading minus stands before, None where there is none."""
    match tree:
        case Call("neg", (inner,)):
            return inner
        case Call(("*" | "/") as sign, (first, second)):
            positive = _without_minus(first)
            return None if positive is None else Call(sign, (positive, second))
    return None


def _cases(condition: Expression, then: Expression, otherwise: Expression) -> str:
    rows = (
        (_set(then)[0], f"<mtext>if </mtext>{_set(condition)[0]}"),
        (_set(otherwise)[0], "<mtext>otherwise</mtext>"),
    )
    body = "".join(f"<mtr><mtd>{value}</mtd><mtd>{when}</mtd></mtr>" for value, when in rows)
    return f"<mrow><mo>{{</mo><mtable>{body}</mtable></mrow>"


def _inside(tree: Expression, at_least: int) -> str:
    text, binding = _set(tree)
    return text if binding >= at_least else f"<mrow><mo>(</mo>{text}<mo>)</mo></mrow>"
