"""Models from elsewhere: the same dynamics as where they come from."""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from autotune.cli import app
from autotune.equations import EquationModel, compile_model, derivatives
from autotune.equations.imports import from_control, from_matlab
from autotune.equations.transfer_text import parse_transfer_function
from autotune.errors import InputError
from autotune.model_tables import read_model
from autotune.models import Model

OMEGA = np.logspace(-2, 2, 9)


@pytest.mark.parametrize(
    ("text", "num", "den", "delay"),
    [
        ("-65.5/(s(0.36s+1)) e^-0.1s", [-65.5], [0.36, 1.0, 0.0], 0.1),
        ("2/(0.5s+1)^2 exp(-0.3s)", [2.0], [0.25, 1.0, 1.0], 0.3),
        ("1.5e-3/(2e-2 s + 1)", [1.5e-3], [0.02, 1.0], 0.0),
        ("(s + 2)*(s - 1)/((3s + 1)(s^2 + 0.2 s + 4))", [1.0, 1.0, -2.0], [3.0, 1.6, 12.2, 4.0], 0.0),
        ("zpk([-1]; [-2, -3+1j, -3-1j]; 4)", [4.0, 4.0], [1.0, 8.0, 22.0, 20.0], 0.0),
        ("K=2 T=0.3,0.1 L=0.05", [2.0], [0.03, 0.4, 1.0], 0.05),
        ("5 e^{-2s}/(1+10s)", [5.0], [10.0, 1.0], 2.0),
        ("1 - 1/(s+1)", [1.0, 0.0], [1.0, 1.0], 0.0),
    ],
)
def test_a_transfer_function_is_read_as_it_is_written(
    text: str, num: list[float], den: list[float], delay: float
) -> None:
    found = parse_transfer_function(text)
    s = 1j * OMEGA
    wanted = np.polyval(num, s) / np.polyval(den, s) * np.exp(-s * delay)
    np.testing.assert_allclose(found.response(OMEGA), wanted, rtol=1e-12)


@pytest.mark.parametrize(
    "text", ["", "s^2 + 1", "2/(s", "abc", "1/s(0.5s+1)", "2^s", "1//s", "zpk(1,2)", "K=a", "s^99"]
)
def test_what_is_no_transfer_function_is_one_line(text: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_transfer_function(text)
    assert "\n" not in str(refused.value)


@given(
    poles=st.lists(st.floats(0.1, 9.0), min_size=1, max_size=4),
    gain=st.floats(-9.0, 9.0).filter(lambda k: abs(k) > 0.1),
)
def test_factors_multiply(poles: list[float], gain: float) -> None:
    factors = "".join(f"(s+{p!r})" for p in poles)
    found = parse_transfer_function(f"{gain!r}/({factors})")
    np.testing.assert_allclose(
        found.response(OMEGA), gain / np.prod([1j * OMEGA + p for p in poles], axis=0), rtol=1e-9
    )


def test_a_system_of_python_control_keeps_its_response(tmp_path: Path) -> None:
    system = control.tf([2.0, 1.0], [1.0, 3.0, 2.0])
    made = from_control(system)
    assert isinstance(made, Model)
    np.testing.assert_allclose(made.response(OMEGA), system(1j * OMEGA), rtol=1e-9)
    (tmp_path / "mine.py").write_text("import control\nmotor = control.tf([2, 1], [1, 3, 2])\n")
    out = tmp_path / "m.toml"
    run = CliRunner().invoke(app, ["model", "from-control", f"{tmp_path / 'mine.py'}:motor", "--out", str(out)])
    assert run.exit_code == 0, run.output
    np.testing.assert_allclose(read_model(out).response(OMEGA), system(1j * OMEGA), rtol=1e-9)


def test_a_state_space_with_two_inputs_becomes_equations() -> None:
    A, B, C = np.array([[-1.0, 0.5], [0.0, -3.0]]), np.array([[0.0, 1.0], [2.0, 0.0]]), np.array([[1.0, 0.2]])
    made = from_control(control.ss(A, B, C, [[0.0, 0.3]], inputs=["u", "supply"]))
    assert isinstance(made, EquationModel)
    assert made.columns == ("u", "supply")
    x, w = np.array([[0.7, -0.4]]), np.array([[1.1, 2.0]])
    compiled = compile_model(made)
    slopes, outputs = derivatives(compiled, compiled.parameter_vector, x, w)
    np.testing.assert_allclose(slopes, x @ A.T + w @ B.T)
    np.testing.assert_allclose(outputs, x @ C.T + w @ [[0.0], [0.3]])


@pytest.mark.parametrize(
    "system", [control.tf([1.0], [1.0, 0.5], 0.1), control.ss(-1.0, 1.0, [[1.0], [2.0]], 0.0), "text"]
)
def test_what_is_no_continuous_system_with_one_output_is_refused(system: object) -> None:
    with pytest.raises(InputError):
        from_control(system)


def test_vectors_of_matlab() -> None:
    made = from_matlab("[2 1]", "[1, 3; 2]", 0.2)
    assert made.blocks[0].dynamics.num == (2.0, 1.0)
    assert made.blocks[0].dynamics.den == (1.0, 3.0, 2.0)
    for num, den in (("[]", "[1]"), ("[a]", "[1]"), ("[1 2 3]", "[1 1]")):
        with pytest.raises(InputError):
            from_matlab(num, den)


def test_the_public_face_makes_models_and_simulates_them() -> None:
    import autotune as at

    t = np.arange(200) * 0.05
    data = {"t": t, "u": np.ones(200), "y": 2.0 * (1.0 - np.exp(-t / 0.5))}
    lag = at.Model.from_equations({
        "input": [{"column": "u"}], "output": {"value": "x"}, "parameters": {"K": 2.0, "T": 0.5},
        "state": [{"name": "x", "derivative": "(K*u - x)/T"}],
    })  # fmt: skip

    def step(x, inputs, p, dt):  # type: ignore[no-untyped-def]
        lost = np.exp(-dt / p["T"])
        return lost * x + (1.0 - lost) * p["K"] * inputs[0], x

    for made in (lag, at.Model.from_text("2/(0.5s + 1)"), at.Model.from_function(step, 0.0, {"K": 2.0, "T": 0.5})):
        np.testing.assert_allclose(at.simulate(made, data), data["y"], atol=1e-3)
