"""Expressions: read as mathematics is written, refused where they are anything else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.equations import compile_model, derivatives, parse, to_text
from autotune.equations.expressions import Call, Expression, Name, Number
from autotune.errors import InputError
from tests.autotune.equations.models import one_state


def value(text: str, **names: float) -> float:
    model = one_state("x", {**names}, output=text)
    compiled = compile_model(model)
    _, outputs = derivatives(compiled, compiled.parameter_vector, np.array([[2.0]]), np.array([[3.0]]))
    return float(outputs[0, 0])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-2^2", -4.0), ("2^3^2", 512.0), ("2^-1", 0.5), ("8/4/2", 1.0), ("5 - 3 - 1", 1.0), ("-x^2", -4.0),
        ("2*-3", -6.0), ("1e-3*1.5E2", 0.15), (".5 + 1.", 1.5), ("if(u > x, 1, 2)", 1.0), ("if(u <= x, 1, 2)", 2.0),
        ("min(4, u, x)", 2.0), ("max(1, x, u)", 3.0), ("sign(-u)", -1.0), ("sign(x - 2)", 0.0), ("abs(-u)", 3.0),
        ("atan2(1, -1)", 0.75 * math.pi), ("sin(pi/6)", 0.5), ("(-8)^3", -512.0), ("sqrt(x*8)", 4.0),
        ("asin(1) + acos(1) + atan(1)", 0.75 * math.pi), ("log(exp(x))", 2.0), ("cosh(0) + sinh(0) + tanh(0)", 1.0),
    ],
)  # fmt: skip
def test_an_expression_means_what_mathematics_means(text: str, expected: float) -> None:
    assert value(text) == pytest.approx(expected, rel=1e-14, abs=1e-15)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "nothing is written"), ("2 +", "missing at the end"), ("(1 + 2", "')' is missing"),
        ("1 2", "one too many"),
        ("x/0", "division by zero"), ("1/(0)", "division by zero"),
        ("x ** 2", "powers are written with ^"), ("a > b", "only in if"), ("if(x, 1, 2)", "needs a comparison"),
        ("x.__class__", "'.' has no meaning"), ("__import__('os')", "has no meaning"), ("x[0]", "'[' has no meaning"),
        ("sine(x)", "did you mean sin"), ("sin", "is a function"), ("atan2(1)", "takes 2"), ("x == 2", "only in if"),
        ("lambda: 0", "':' has no meaning"), ("(" * 500 + "x" + ")" * 500, "nested too deep"), ("-" * 99 + "x", "deep"),
        ("2^" * 500 + "2", "deep"), ("x" * 30_000, "characters"), ("exec('1')", "has no meaning"),
    ],
)  # fmt: skip
def test_what_is_no_expression_is_refused_in_one_line(text: str, says: str) -> None:
    with pytest.raises(InputError) as refused:
        parse(text, "m.toml derivative of x")
    message = str(refused.value)
    assert says in message
    assert "\n" not in message
    assert message.startswith("m.toml derivative of x")


def trees() -> st.SearchStrategy[Expression]:
    leaves = st.one_of(st.floats(0.0, 1e6, allow_nan=False).map(Number), st.sampled_from(["x", "u", "a_1"]).map(Name))

    def grown(inner: st.SearchStrategy[Expression]) -> st.SearchStrategy[Expression]:
        pair = st.tuples(inner, inner)
        return st.one_of(
            st.builds(Call, st.sampled_from(["+", "-", "*", "^", "atan2", "min", "max"]), pair),
            # a number that is 0 is no divisor: a division by it is refused where it is read
            st.builds(Call, st.just("/"), st.tuples(inner, inner.filter(lambda divisor: divisor != Number(0.0)))),
            st.builds(Call, st.sampled_from(["neg", "sin", "exp", "sqrt", "abs", "sign"]), st.tuples(inner)),
            st.builds(
                lambda sign, c, ab: Call("if", (Call(sign, c), *ab)),
                st.sampled_from(["<", "<=", ">", ">="]),
                pair,
                pair,
            ),
        )

    return st.recursive(leaves, grown, max_leaves=12)


@given(tree=trees())
def test_what_is_written_reads_back_the_same(tree: Expression) -> None:
    assert parse(to_text(tree)) == tree
