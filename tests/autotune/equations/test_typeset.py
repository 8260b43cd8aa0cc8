"""Equations are set as formulas, in LaTeX and in well-formed MathML, that say what the text of the same model says."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest

from autotune.equations.exports import as_text
from autotune.equations.typeset import as_latex, as_mathml
from tests.autotune.equations.models import one_state


def read(formula: str) -> str:
    """Return the characters of a formula in their order, without space."""
    return re.sub(r"\s", "", "".join(ElementTree.fromstring(formula).itertext()))


@pytest.mark.parametrize(
    ("derivative", "shown", "latex"),
    [
        ("-a*x + -b*u", "−ax−bu", r"-a \, x - b \, u"),
        ("(u - x)/a - (x - u)", "u−xa−(x−u)", r"\frac{u - x}{a} - \left(x - u\right)"),
        ("2*10^-3*x^2", "2·10−3x2", r"2 \cdot {10}^{-3} \, {x}^{2}"),
        (
            "if(x < 0, sqrt(abs(x)), 1e-5*x)",
            "{|x|ifx<01·10−5xotherwise",
            r"\begin{cases} \sqrt{\left|x\right|} & \text{if } x < 0 \\ "
            r"1 \cdot {10}^{-5} \, x & \text{otherwise} \end{cases}",
        ),
        (
            "min(a, atan(x))*sign(u)",
            "min(a,arctan(x))sgn(u)",
            r"\min\left(a, \arctan\left(x\right)\right) \, \operatorname{sgn}\left(u\right)",
        ),
    ],
)
def test_a_derivative_is_set_with_its_signs_and_brackets(derivative: str, shown: str, latex: str) -> None:
    model = one_state(derivative, {"a": 2.0, "b": 3.0})
    slope, _ = as_mathml(model)
    assert read(slope) == f"dxdt={shown}"
    assert f"\\dot{{x}} &= {latex} \\\\\n" in as_latex(model)


def test_greek_letters_and_indices_are_set_and_long_names_are_words() -> None:
    model = one_state("theta_0*x + quadratic_drag_0*u", {"theta_0": 1.0, "quadratic_drag_0": 2.0})
    slope, _ = as_mathml(model)
    assert r"\theta_{\text{0}} \, x + \text{quadratic drag 0} \, u" in as_latex(model)
    assert "<msub><mi>θ</mi><mtext>0</mtext></msub>" in slope
    assert "<mtext>quadratic drag 0</mtext>" in slope
    assert "*" not in slope


def test_every_equation_of_the_text_is_there() -> None:
    model = one_state("a*(u - x)", {"a": 1.0})
    assert len(as_mathml(model)) == as_text(model).split("\n\n")[1].count("=")
