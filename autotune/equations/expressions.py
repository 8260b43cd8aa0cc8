"""Expressions of a model file: read into a tree of this module's own, never evaluated as Python.

Grammar (highest binding last)::

    condition   sum (< | <= | > | >=) sum             only as the first argument of if(condition, a, b)
    sum         product ((+ | -) product)*
    product     signed ((* | /) signed)*
    signed      (+ | -) signed | power
    power       atom (^ signed)?                      from the right: a^b^c is a^(b^c), and -a^b is -(a^b)
    atom        number | name | function(sum, ...) | ( sum )
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from typing import TypeAlias

from autotune.errors import InputError

#: Functions and how many arguments they take; ``min`` and ``max`` take two or more.
FUNCTIONS = {
    **dict.fromkeys(("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"), 1),
    **dict.fromkeys(("exp", "log", "sqrt", "abs", "sign"), 1),
    **dict.fromkeys(("atan2", "min", "max"), 2),
    "if": 3,
}
#: Names that always mean the same: the number pi, and seconds since the recording's first row.
RESERVED = ("pi", "t")
#: Longest expression and deepest nesting that are read.
LONGEST, DEEPEST = 20_000, 60

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)|(?P<sign><=|>=|==|!=|\*\*|[-+*/^(),<>]))"
)


@dataclass(frozen=True, slots=True)
class Number:
    """A number as it was written."""

    value: float


@dataclass(frozen=True, slots=True)
class Name:
    """A state, input, parameter, port or defined expression."""

    name: str


@dataclass(frozen=True, slots=True)
class Call:
    """A function or an operator on its arguments.

    Attributes
    ----------
    function : str
        One of ``FUNCTIONS``, an operator ``+ - * / ^``, ``neg``, or a comparison ``< <= > >=``.
    arguments : tuple of Expression
        What it acts on.
    """

    function: str
    arguments: tuple[Expression, ...]


Expression: TypeAlias = Number | Name | Call

_COMPARISONS = ("<", "<=", ">", ">=")


def parse(text: str, where: str = "expression") -> Expression:
    """Read an expression.

    Parameters
    ----------
    text : str
        What was written.
    where : str
        Where it was written, for the message.

    Returns
    -------
    Expression
        Its tree.

    Raises
    ------
    InputError
        What is no expression; names the place in the text.
    """
    if len(text) > LONGEST:
        raise InputError(f"an expression of {len(text)} characters", where=where, remedy="split it by [define]")
    return _Parser(text, where).whole()


class _Parser:
    """One pass over the tokens of one text."""

    def __init__(self, text: str, where: str) -> None:
        self._text, self._where = text, where
        self._tokens = list(self._split())
        self._at = self._depth = 0

    def _split(self) -> Iterator[tuple[str, str, int]]:
        at = 0
        while self._text[at:].strip():
            found = _TOKEN.match(self._text, at)
            if not found:
                at += len(self._text[at:]) - len(self._text[at:].lstrip())
                raise self._refusal(f"{self._text[at]!r} has no meaning here", at)
            kind = str(found.lastgroup)
            yield kind, found[kind], found.start(kind)
            at = found.end()

    def _refusal(self, what: str, at: int | None = None) -> InputError:
        if at is None:
            at = self._tokens[self._at][2] if self._at < len(self._tokens) else len(self._text)
        shown = self._text if len(self._text) <= 80 else f"{self._text[:77]}..."
        return InputError(
            f"{what} (character {at + 1} of {shown!r})",
            where=self._where,
            remedy="use numbers, names, + - * / ^ ( ), if(condition, a, b) and the known functions",
        )

    def _peek(self) -> str:
        return self._tokens[self._at][1] if self._at < len(self._tokens) else ""

    def _take(self, *wanted: str) -> str | None:
        if self._at < len(self._tokens) and self._tokens[self._at][0] == "sign" and self._peek() in wanted:
            self._at += 1
            return self._tokens[self._at - 1][1]
        return None

    def _close(self) -> None:
        if self._take(")") is None:
            raise self._refusal(f"')' is missing before {self._peek()!r}" if self._peek() else "')' is missing")

    def whole(self) -> Expression:
        if not self._tokens:
            raise self._refusal("nothing is written", 0)
        tree = self._sum()
        if self._at < len(self._tokens):
            sign = self._peek()
            if sign == "**":
                raise self._refusal("powers are written with ^, not **")
            if sign in (*_COMPARISONS, "==", "!="):
                raise self._refusal(f"the comparison {sign!r} stands only in if(condition, a, b)")
            raise self._refusal(f"{sign!r} is one too many")
        return tree

    def _sum(self) -> Expression:
        self._depth += 1
        if self._depth > DEEPEST:
            raise self._refusal("nested too deep")
        tree = self._product()
        while (sign := self._take("+", "-")) is not None:
            tree = Call(sign, (tree, self._product()))
        self._depth -= 1
        return tree

    def _product(self) -> Expression:
        tree = self._read_signed()
        while (sign := self._take("*", "/")) is not None:
            divisor_at, right = self._at, self._read_signed()
            if sign == "/" and right == Number(0.0):
                raise self._refusal("division by zero", self._tokens[divisor_at][2])
            tree = Call(sign, (tree, right))
        return tree

    def _read_signed(self) -> Expression:
        minus, count = False, 0
        while (sign := self._take("+", "-")) is not None:
            minus, count = minus ^ (sign == "-"), count + 1
            if count > DEEPEST:
                raise self._refusal("nested too deep")
        tree = self._power()
        return Call("neg", (tree,)) if minus else tree

    def _power(self) -> Expression:
        base = self._atom()
        if self._take("^") is None:
            return base
        self._depth += 1
        if self._depth > DEEPEST:
            raise self._refusal("nested too deep")
        exponent = self._read_signed()
        self._depth -= 1
        return Call("^", (base, exponent))

    def _atom(self) -> Expression:
        if self._at >= len(self._tokens):
            raise self._refusal("something is missing at the end")
        kind, text, at = self._tokens[self._at]
        self._at += 1
        if kind == "number":
            if not math.isfinite(float(text)):
                raise self._refusal("no number holds this", at)
            return Number(float(text))
        if kind == "name":
            return self._read_call(text, at) if self._take("(") is not None else self._read_name(text, at)
        if text == "(":
            tree = self._sum()
            self._close()
            return tree
        self._at -= 1
        raise self._refusal("powers are written with ^, not **" if text == "**" else f"{text!r} has nothing before it")

    def _read_name(self, name: str, at: int) -> Expression:
        if name in FUNCTIONS:
            raise self._refusal(f"{name} is a function: {name}(...)", at)
        return Name(name)

    def _read_call(self, name: str, at: int) -> Expression:
        if name not in FUNCTIONS:
            near = get_close_matches(name, FUNCTIONS, 1)
            hint = f", did you mean {near[0]}?" if near else ""
            raise self._refusal(f"unknown function {name!r}{hint}", at)
        arguments = [self._condition() if name == "if" else self._sum()]
        while self._take(",") is not None:
            arguments.append(self._sum())
        self._close()
        wanted = FUNCTIONS[name]
        more = name in ("min", "max") and len(arguments) > wanted
        if len(arguments) != wanted and not more:
            raise self._refusal(f"{name} takes {wanted} argument(s), not {len(arguments)}", at)
        return Call(name, tuple(arguments))

    def _condition(self) -> Expression:
        left = self._sum()
        sign = self._take(*_COMPARISONS)
        if sign is None:
            raise self._refusal("if needs a comparison with < <= > or >= first: if(a > b, then, else)")
        return Call(sign, (left, self._sum()))


def names_in(tree: Expression) -> set[str]:
    """Return every name that an expression uses."""
    match tree:
        case Name(name):
            return {name}
        case Call(_, arguments):
            return set().union(*(names_in(one) for one in arguments))
    return set()


def substitute(tree: Expression, replace: Callable[[str], Expression | None]) -> Expression:
    """Return an expression with names replaced by expressions.

    Parameters
    ----------
    tree : Expression
        The expression; stays as it is.
    replace : callable
        From a name to what takes its place; None leaves it.
    """
    match tree:
        case Name(name):
            new = replace(name)
            return tree if new is None else new
        case Call(function, arguments):
            return Call(function, tuple(substitute(one, replace) for one in arguments))
    return tree


_BINDING = {"+": 1, "-": 1, "*": 2, "/": 2, "neg": 3, "^": 4}


def to_text(tree: Expression) -> str:
    """Return an expression as it is written in a model file; :func:`parse` reads it back to an equal tree."""
    return _text(tree)[0]


def _text(tree: Expression) -> tuple[str, int]:
    """Return the text and how tightly its outermost operator binds."""
    match tree:
        case Number(value):
            return (number_text(value), 5) if value >= 0.0 else (f"-{number_text(-value)}", 3)
        case Name(name):
            return name, 5
        case Call("neg", (inner,)):
            return f"-{_within(inner, 4)}", 3
        case Call("^", (base, exponent)):
            return f"{_within(base, 5)}^{_within(exponent, 3)}", 4
        case Call(("+" | "-" | "*" | "/") as sign, (left, right)):
            own = _BINDING[sign]
            space = " " if own == 1 else ""
            return f"{_within(left, own)}{space}{sign}{space}{_within(right, own + 1)}", own
        case Call(sign, (left, right)) if sign in _COMPARISONS:
            return f"{to_text(left)} {sign} {to_text(right)}", 0
    assert isinstance(tree, Call)
    return f"{tree.function}({', '.join(to_text(one) for one in tree.arguments)})", 5


def _within(tree: Expression, at_least: int) -> str:
    text, binding = _text(tree)
    return text if binding >= at_least else f"({text})"


def number_text(value: float) -> str:
    """Return the shortest text of a number that reads back the same, whole numbers without a point."""
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    return repr(value)
