"""Equations elsewhere: chains, Modelica, Python, LaTeX and linearisations say the same as the model itself."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import control
import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

from autotune.cli import app
from autotune.equations import Drive, EquationModel, apply, compile_model, read_equations, simulate, write_equations
from autotune.equations.black_box import BlackBox
from autotune.equations.chain import from_chain
from autotune.equations.exports import as_modelica, as_python, as_text
from autotune.equations.files import read_any_model
from autotune.equations.flatten import flatten
from autotune.equations.linearise import as_chain, linearise, transfer_function
from autotune.equations.typeset import as_latex
from autotune.errors import InputError
from autotune.model_tables import read_model
from autotune.models import Effect, Parameter, TransferFunction
from tests.autotune.equations.models import model, one_state

T = np.arange(300) * 0.02
U = np.repeat(np.random.default_rng(8).normal(0.0, 0.6, 15), 20)


def effect(name: str, **values: float) -> Effect:
    parameters = MappingProxyType({key: Parameter(value=value, sd=0.1) for key, value in values.items()})
    return Effect(name=name, state="omega" if name.startswith("plant") else "", parameters=parameters)


EXTENDED = replace(
    model(
        input=[{"column": "u", "unit": "N m", "offset": 0.1}], define={"torque": "u*1"},
        port=[{"name": "F_d", "kind": "torque", "across": "omega"}],
        state=[{"name": "theta", "derivative": "omega"},
               {"name": "omega", "derivative": "(torque + F_d - c*omega - m*g*l*sin(theta))/J"}],
    ),
    effects=(
        effect("plant.quadratic_drag", coefficient=0.4), effect("actuator.saturation", low=-0.5, high=0.5),
        effect("actuator.lag", time_constant=0.1), effect("sensor.drift", rate=0.01),
        replace(effect("plant.viscous_friction", coefficient=0.05), state="", port="F_d"),
    ),
)  # fmt: skip


def y_of(one: EquationModel, t: np.ndarray = T, u: np.ndarray = U) -> np.ndarray:
    applied = apply(one)
    compiled = compile_model(one, applied.extensions)
    start = np.zeros((1, len(compiled.states)))
    drive = Drive(t=t, inputs=u[:, None] if u.ndim == 1 else u)
    return simulate(compiled, compiled.parameter_vector, drive, start, delays=applied.delays, tolerance=1e-9).y


def test_written_out_effects_are_the_same_model() -> None:
    flat = flatten(EXTENDED)
    assert not flat.effects
    assert not flat.ports
    np.testing.assert_allclose(y_of(flat), y_of(EXTENDED), atol=1e-8)


def test_what_acts_on_samples_is_not_written_out_in_silence() -> None:
    with pytest.raises(InputError, match="no differential equation"):
        flatten(replace(model(), effects=(effect("sensor.quantisation", step=0.1),)))


def test_the_python_function_integrates_to_the_same(tmp_path: Path) -> None:
    names: dict[str, object] = {}
    exec(compile(as_python(EXTENDED), "rig.py", "exec"), names)
    derivatives, output = names["derivatives"], names["output"]
    x, found = np.zeros(3), []
    for k, u in enumerate(U):
        found.append(output(T[k], x, [u]))  # type: ignore[operator]
        x = solve_ivp(derivatives, (T[k], T[k] + 0.02), x, args=([u],), rtol=1e-10, atol=1e-12).y[:, -1]  # type: ignore[call-overload]
    np.testing.assert_allclose(found, y_of(EXTENDED), atol=1e-6)


def test_a_python_word_as_a_name_is_let_through() -> None:
    word = one_state("lambda*x + u", {"lambda": -2.0})
    names: dict[str, object] = {}
    exec(compile(as_python(word), "rig.py", "exec"), names)
    assert names["derivatives"](0.0, [1.0], [0.5]) == [-1.5]  # type: ignore[operator]


def test_latex_and_text_say_what_is_written() -> None:
    latex = as_latex(model())
    assert r"\dot{\theta} &= \omega" in latex
    assert r"\frac{u - c \, \omega - m \, g \, l \, \sin\left(\theta\right)}{J}" in latex
    assert latex.count("{") == latex.count("}")
    text = as_text(model())
    assert "domega/dt = (u - c*omega - m*g*l*sin(theta))/J   [rad/s]" in text
    assert "J = 0.05 kg m^2" in text


def test_modelica_declares_everything_that_it_uses() -> None:
    text = as_modelica(model(input=[{"column": "u", "unit": "N m", "delay": 0.1}]))
    assert text.startswith("model pendulum\n")
    assert "  u_late = delay(u, 0.1);" in text
    assert "  der(omega) = (((u_late - (c * omega)) - (((m * g) * l) * sin(theta))) / J);" in text
    assert text.rstrip().endswith("end pendulum;")


@pytest.mark.system("openmodelica")
@pytest.mark.skipif(shutil.which("omc") is None, reason="OpenModelica is not installed: apt install openmodelica")
def test_openmodelica_simulates_the_same(tmp_path: Path) -> None:
    # a constant command: y after 2 s
    (tmp_path / "rig.mo").write_text(as_modelica(model()))
    script = ('loadFile("rig.mo"); simulate(pendulum, stopTime=2, numberOfIntervals=100, tolerance=1e-9, '
              'outputFormat="csv", simflags="-override=u=0.5");')  # fmt: skip
    (tmp_path / "run.mos").write_text(script)
    subprocess.run(["omc", "run.mos"], cwd=tmp_path, check=True, capture_output=True)
    rows = np.genfromtxt(tmp_path / "pendulum_res.csv", delimiter=",", names=True)
    t = np.linspace(0.0, 2.0, 101)
    np.testing.assert_allclose(rows["y"][:101], y_of(model(), t, np.full(101, 0.5)), atol=1e-6)


CHAIN = """
name = "oven"
[input]
unit = "kW"
offset = 0.2
[output]
unit = "degC"
offset = 50.0
[[block]]
name = "heater"
place = "actuator"
den = [0.3, 1.0]
delay = 0.05
[[block]]
name = "oven"
place = "plant"
num = [0.4, 2.0]
den = [0.5, 0.9, 1.0]
[[block]]
name = "store"
place = "plant"
den = [1.0, 0.0]
[[block]]
name = "lead"
place = "sensor"
num = [0.2, 1.0]
den = [0.1, 1.0]
"""


def test_a_chain_of_blocks_is_a_special_case(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text(CHAIN)
    chain = read_model(tmp_path / "m.toml")
    fine = np.arange(0, T[-1], 0.001)
    held = U[np.clip(((fine - 0.05) / 0.02 + 1e-9).astype(int), 0, None)]
    tf = chain.transfer_function()
    _, y = control.forced_response(control.tf(tf.num, tf.den), fine, held - 0.2, interpolate=False)
    np.testing.assert_allclose(y_of(from_chain(chain))[:-1], 50.0 + y[::20][: T.size - 1], atol=2e-3)


def test_a_chain_may_have_a_measured_disturbance(tmp_path: Path) -> None:
    text = CHAIN.replace("[input]\n", '[[input]]\ncolumn = "u"\n')
    text += '[[input]]\ncolumn = "door"\nnum = [-3.0]\nden = [2.0, 1.0]\nacts = "output"\n'
    (tmp_path / "m.toml").write_text(text)
    found = read_any_model(tmp_path / "m.toml")
    assert isinstance(found, EquationModel)
    assert found.columns == ("u", "door")
    both = np.column_stack([np.full(T.size, 0.2), np.ones(T.size)])
    np.testing.assert_allclose(y_of(found, T, both), 50.0 - 3.0 * (1.0 - np.exp(-T / 2.0)), atol=1e-6)


@pytest.mark.skipif(shutil.which("cc") is None and shutil.which("gcc") is None, reason="no C compiler: apt install gcc")
@pytest.mark.parametrize("which", ["equations with effects", "a chain with dead time"])
def test_an_exported_fmu_is_valid_and_runs_as_the_model_does(tmp_path: Path, which: str) -> None:
    """Dead times need not be multiples of the communication step: what arrives within one is met there."""
    if which == "equations with effects":
        write_equations(EXTENDED, tmp_path / "m.toml")
        exported, tuned = EXTENDED, "J"
    else:
        (tmp_path / "m.toml").write_text(CHAIN)
        exported = from_chain(read_model(tmp_path / "m.toml"))
        tuned = exported.parameters[0].name
    command = ["model", "export", str(tmp_path / "m.toml"), "--form", "fmu", "--out", str(tmp_path / "rig.fmu")]
    said = CliRunner().invoke(app, command)
    assert said.exit_code == 0, said.output
    assert f"a library for {fmpy.platform_tuple}" in said.output
    assert validate_fmu(tmp_path / "rig.fmu") == []
    back = tmp_path / "back.toml"
    assert CliRunner().invoke(app, ["model", "from-fmu", str(tmp_path / "rig.fmu"), "--out", str(back)]).exit_code == 0
    box = read_any_model(back)
    assert isinstance(box, BlackBox)
    values, drive = {p.name: p.value for p in box.parameters}, Drive(t=T, inputs=U[:, None])
    wanted = y_of(exported)
    np.testing.assert_allclose(box.simulation(values, drive), wanted, atol=1e-5 * np.ptp(wanted))
    other = replace(
        exported,
        parameters=tuple(replace(p, value=1.5 * p.value) if p.name == tuned else p for p in exported.parameters),
    )
    retuned = box.simulation(values | {tuned: 1.5 * values[tuned]}, drive)
    np.testing.assert_allclose(retuned, y_of(other), atol=1e-5 * np.ptp(wanted))
    assert not np.allclose(retuned, wanted, atol=1e-3 * np.ptp(wanted))


def test_a_linearisation_is_the_tangent() -> None:
    at = linearise(model(), np.array([0.5]))
    J, c, m, length, g = (p.value for p in model().parameters)
    stiffness = m * g * length * np.cos(at.states[0]) / J
    np.testing.assert_allclose(at.A, [[0.0, 1.0], [-stiffness, -c / J]], atol=1e-6)
    tf = transfer_function(at)
    omega = np.array([0.1, 3.0, 30.0])
    wanted = TransferFunction(num=(1.0 / J,), den=(1.0, c / J, stiffness)).response(omega)
    np.testing.assert_allclose(tf.response(omega), wanted, rtol=1e-5)
    assert as_chain(model(), at).output.offset == pytest.approx(at.states[0])
    np.testing.assert_allclose(np.linalg.eigvals(at.A), np.roots(tf.den), rtol=1e-9)


def test_no_rest_is_refused() -> None:
    with pytest.raises(InputError, match="no rest"):
        linearise(model(), np.array([5.0]))  # more than the weight can hold


def test_effects_stay_in_the_file(tmp_path: Path) -> None:
    write_equations(EXTENDED, tmp_path / "m.toml")
    assert read_equations(tmp_path / "m.toml") == EXTENDED
