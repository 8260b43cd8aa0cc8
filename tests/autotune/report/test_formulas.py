"""Equations on a page are set as formulas: well-formed MathML that says what the text of the same model says."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest

from autotune.equations.exports import as_text
from autotune.report.formulas import model_formulas
from tests.autotune.equations.models import one_state


def read(formula: str) -> str:
    """Return the characters of a formula in their order, without space."""
    return re.sub(r"\s", "", "".join(ElementTree.fromstring(formula).itertext()))


@pytest.mark.parametrize(
    ("derivative", "shown"),
    [
        ("-a*x + -b*u", "−ax−bu"),
        ("(u - x)/a - (x - u)", "u−xa−(x−u)"),
        ("2*10^-3*x^2", "2·10−3x2"),
        ("if(x < 0, sqrt(abs(x)), 1e-5*x)", "{|x|ifx<01·10−5xotherwise"),
        ("min(a, atan(x))*sign(u)", "min(a,arctan(x))sgn(u)"),
    ],
)
def test_a_derivative_is_set_with_its_signs_and_brackets(derivative: str, shown: str) -> None:
    slope, _ = model_formulas(one_state(derivative, {"a": 2.0, "b": 3.0}))
    assert read(slope) == f"dxdt={shown}"


def test_greek_letters_and_indices_are_set_and_long_names_are_words() -> None:
    slope, _ = model_formulas(one_state("theta_0*x + quadratic_drag_0*u", {"theta_0": 1.0, "quadratic_drag_0": 2.0}))
    assert "<msub><mi>θ</mi><mtext>0</mtext></msub>" in slope
    assert "<mtext>quadratic drag 0</mtext>" in slope
    assert "*" not in slope


def test_every_equation_of_the_text_is_there() -> None:
    model = one_state("a*(u - x)", {"a": 1.0})
    assert len(model_formulas(model)) == as_text(model).split("\n\n")[1].count("=")
