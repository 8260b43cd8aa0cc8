"""Equations of a model as formulas: one walk over the tree, and LaTeX and MathML as its notations."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from autotune.equations.expressions import Call, Expression, Name, Number, number_text
from autotune.equations.flatten import flatten
from autotune.equations.model import EquationModel

_GREEK = {
    name: chr(code)
    for first, names in (
        (0x3B1, "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi"),
        (0x3C0, "pi rho"),  # LaTeX has no omicron
        (0x3C3, "sigma tau upsilon phi chi psi omega"),
        (0x393, "Gamma Delta"), (0x398, "Theta"), (0x39B, "Lambda"), (0x39E, "Xi"), (0x3A0, "Pi"), (0x3A3, "Sigma"),
        (0x3A6, "Phi"), (0x3A8, "Psi Omega"),
    )
    for code, name in enumerate(names.split(), first)
}  # fmt: skip
_FUNCTIONS = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "sign": "sgn", "log": "ln"}


@dataclass(frozen=True, kw_only=True)
class _Notation:
    """How a letter, the name of a function, signs and all else (templates) are written; ``dot`` is before numbers."""

    letter: Callable[[str], str]
    operator: Callable[[str], str]
    parts: Mapping[str, str]


_LATEX = _Notation(
    letter=lambda name: rf"\{name}" if name in _GREEK else name if len(name) == 1 else rf"\mathrm{{{name}}}",
    operator=lambda name: rf"\operatorname{{{name}}}" if name in ("atan2", "sgn") else rf"\{name}",
    parts={
        "+": " + ", "-": " - ", "*": r" \, ", "dot": r" \cdot ", ",": ", ",
        "<": " < ", "<=": r" \le ", ">": " > ", ">=": r" \ge ",
        "number": "{}", "word": r"\text{{{}}}", "index": r"{}_{{\text{{{}}}}}", "slope": r"\dot{{{}}}",
        "()": r"\left({}\right)", "sqrt": r"\sqrt{{{}}}", "abs": r"\left|{}\right|",
        "/": r"\frac{{{}}}{{{}}}", "^": "{{{}}}^{{{}}}", "call": r"{}\left({}\right)",
        "if": r"\begin{{cases}} {} & \text{{if }} {} \\ {} & \text{{otherwise}} \end{{cases}}",
    },
)  # fmt: skip
_MATHML = _Notation(
    letter=lambda name: f"<mi>{_GREEK.get(name, name)}</mi>",
    operator=str,
    parts={
        "+": "<mo>+</mo>", "-": "<mo>−</mo>", "*": '<mspace width="0.17em"/>', "dot": "<mo>·</mo>", ",": "<mo>,</mo>",
        "<": "<mo>&lt;</mo>", "<=": "<mo>≤</mo>", ">": "<mo>&gt;</mo>", ">=": "<mo>≥</mo>",
        "number": "<mn>{}</mn>", "word": "<mtext>{}</mtext>", "index": "<msub>{}<mtext>{}</mtext></msub>",
        "slope": "<mfrac><mrow><mi>d</mi>{}</mrow><mrow><mi>d</mi><mi>t</mi></mrow></mfrac>",
        "()": "<mrow><mo>(</mo>{}<mo>)</mo></mrow>",
        "sqrt": "<msqrt>{}</msqrt>", "abs": "<mrow><mo>|</mo>{}<mo>|</mo></mrow>",
        "/": "<mfrac><mrow>{}</mrow><mrow>{}</mrow></mfrac>", "^": "<msup><mrow>{}</mrow><mrow>{}</mrow></msup>",
        "call": "<mrow><mi>{}</mi><mo>(</mo>{}<mo>)</mo></mrow>",
        "if": "<mrow><mo>{{</mo><mtable><mtr><mtd>{}</mtd><mtd><mtext>if </mtext>{}</mtd></mtr>"
              "<mtr><mtd>{}</mtd><mtd><mtext>otherwise</mtext></mtd></mtr></mtable></mrow>",
    },
)  # fmt: skip


def as_latex(model: EquationModel) -> str:
    """Return the equations as a LaTeX ``align`` environment."""
    lines = " \\\\\n  ".join(f"{left} &= {right}" for left, right in _equations(model, _LATEX))
    return f"\\begin{{align}}\n  {lines}\n\\end{{align}}\n"


def as_mathml(model: EquationModel) -> tuple[str, ...]:
    """Return the equations as formulas that browsers set without a script."""
    form = '<math display="block"><mrow>{}<mo>=</mo>{}</mrow></math>'
    return tuple(form.format(*sides) for sides in _equations(model, _MATHML))


def _equations(model: EquationModel, n: _Notation) -> list[tuple[str, str]]:
    """Return both sides of each equation: helpers, states and the output. Effects on samples are refused."""
    flat = flatten(model)
    lines = [(_symbol(name, n), tree) for name, tree in flat.defines]
    lines += [(n.parts["slope"].format(_symbol(one.name, n)), one.derivative) for one in flat.states]
    return [(left, _set(tree, n)[0]) for left, tree in [*lines, (_symbol("y", n), flat.output)]]


def _symbol(name: str, n: _Notation) -> str:
    """Return a name: a letter with its index, or words."""
    head, _, tail = name.partition("_")
    if (match := re.fullmatch(r"([A-Za-z]+)(\d+)", head)) and not tail:
        head, tail = match[1], match[2]
    if len(head) > 2 and head not in _GREEK:
        return n.parts["word"].format(name.replace("_", " "))
    return n.parts["index"].format(n.letter(head), tail.replace("_", " ")) if tail else n.letter(head)


def _set(tree: Expression, n: _Notation) -> tuple[str, int]:
    """Return an expression and how tightly its outermost operator binds."""
    match tree:
        case Number(value):
            mantissa, _, exponent = number_text(value).partition("e")
            if exponent:
                return _set(_with_power_of_ten(float(mantissa), int(exponent)), n)
            return n.parts["number"].format(mantissa), 5
        case Name(name):
            return _symbol(name, n), 5
        case Call("neg" | "*" | "/") if (positive := _without_minus(tree)) is not None:
            return f"{n.parts['-'].strip()}{_inside(positive, 2, n)}", 1
        case Call("*", (left, right)):
            between = n.parts["dot" if _begins_with_number(right) else "*"]
            return f"{_inside(left, 2, n)}{between}{_inside(right, 2, n)}", 2
        case Call("+", (left, right)) if (positive := _without_minus(right)) is not None:
            return _set(Call("-", (left, positive)), n)
        case Call(("+" | "-") as sign, (left, right)):
            return f"{_inside(left, 1, n)}{n.parts[sign]}{_inside(right, 1 if sign == '+' else 2, n)}", 1
        case Call("^", (base, exponent)):
            return n.parts["^"].format(_inside(base, 5, n), _set(exponent, n)[0]), 3
    assert isinstance(tree, Call)
    inner = [_set(one, n)[0] for one in tree.arguments]
    match tree.function:
        case "/" | "sqrt" | "abs" as around:
            return n.parts[around].format(*inner), 4 if around == "/" else 5
        case "if":
            condition, then, otherwise = inner
            return n.parts["if"].format(then, condition, otherwise), 0
        case comparison if comparison in n.parts:
            return n.parts[comparison].join(inner), 0
        case function:
            return n.parts["call"].format(n.operator(_FUNCTIONS.get(function, function)), n.parts[","].join(inner)), 5


def _inside(tree: Expression, at_least: int, n: _Notation) -> str:
    text, binding = _set(tree, n)
    return text if binding >= at_least else n.parts["()"].format(text)


def _with_power_of_ten(mantissa: float, exponent: int) -> Expression:
    size = Number(float(abs(exponent)))
    return Call("*", (Number(mantissa), Call("^", (Number(10.0), size if exponent > 0 else Call("neg", (size,))))))


def _without_minus(tree: Expression) -> Expression | None:
    """Return what a leading minus stands before, None where there is none."""
    match tree:
        case Call("neg", (inner,)):
            return inner
        case Call(("*" | "/") as sign, (first, second)):
            positive = _without_minus(first)
            return None if positive is None else Call(sign, (positive, second))
    return None


def _begins_with_number(tree: Expression) -> bool:
    match tree:
        case Call("*" | "^", (first, _)):
            return _begins_with_number(first)
    return isinstance(tree, Number)
