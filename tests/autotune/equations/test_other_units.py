"""The same model written in other units of its states, its reading and its command says the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.arrays import FloatArray
from autotune.equations import Drive, EquationModel, compile_model
from autotune.equations.expressions import Call, Expression, Name, Number, substitute
from autotune.equations.linearise import Linear, linearise, transfer_function
from autotune.equations.rest import rest_state, state_scales
from autotune.equations.simulate import derivatives
from autotune.errors import InputError
from drivers.model_plant import ModelPlant
from tests.autotune.equations.models import model, one_state

TANKS = one_state("k*u - a*sqrt(max(x, 0))", {"k": 0.5, "a": 1.0})
CASCADE = replace(
    TANKS,
    output=Name("x2"),
    states=(*TANKS.states, replace(TANKS.states[0], name="x2", derivative=Call("-", (Name("x"), Name("x2"))))),
)
LAG = one_state("(2*u - x)/T", {"T": 0.01}, output="x + 20")
INTEGRATOR = one_state("k*(u - 0.3)", {"k": -4.0}, output="3*x + 7")
OVEN = one_state("(30*u - (x - 20) - e*((x + 273)^4 - 293^4))/T", {"T": 80.0, "e": 2e-9})
PENDULUM = model()
#: A model, a command, and the reading that is given with it: NaN where the command alone tells the rest.
CASES: dict[str, tuple[EquationModel, float, float]] = {
    "tank": (TANKS, 4.0, np.nan), "tank read": (TANKS, 4.0, 4.0), "tanks": (CASCADE, 4.0, np.nan),
    "lag": (LAG, 0.7, np.nan), "lag at zero": (LAG, 0.0, np.nan), "lag that moves": (LAG, 0.7, 26.0),
    "integrator": (INTEGRATOR, 0.3, 11.0), "integrator that moves": (INTEGRATOR, 0.5, 11.0),
    "oven": (OVEN, 4.0, np.nan), "pendulum": (PENDULUM, 0.5, np.nan), "pendulum at zero": (PENDULUM, 0.0, np.nan),
    "pendulum off its rest": (PENDULUM, 0.5, 0.2), "pendulum far off": (PENDULUM, 1e-4, 2.5),
}  # fmt: skip
UNITS = (1e-12, 1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9, 1e12)
#: A simulation keeps no state closer than 1e-14 of its unit.
SIMULATED = UNITS[1:-1]


def in_units(known: EquationModel, states: FloatArray, reading: float, command: float) -> EquationModel:
    """Return a model with its states, its reading and its command told in other units: as numbers so many times."""
    factors = dict(zip(known.state_names, states, strict=True)) | {known.columns[0]: command}

    def told(tree: Expression, factor: float) -> Expression:
        inside = substitute(
            tree, lambda name: Call("/", (Name(name), Number(float(factors[name])))) if name in factors else None
        )
        return Call("*", (Number(float(factor)), inside))

    return replace(
        known,
        states=tuple(
            replace(one, derivative=told(one.derivative, factors[one.name]))
            for one in known.states
        ),
        output=told(known.output, reading),
        inputs=(replace(known.inputs[0], offset=known.inputs[0].offset * command), *known.inputs[1:]),
    )  # fmt: skip


@st.composite
def units(draw: st.DrawFn, known: tuple[float, ...] = UNITS) -> tuple[str, FloatArray, float, float]:
    """Draw a case, and units of its states, its reading and its command."""
    case, one = draw(st.sampled_from(sorted(CASES))), st.sampled_from(known)
    count = len(CASES[case][0].states)
    states = np.array(draw(st.lists(one, min_size=count, max_size=count)))
    # of a command of 0 nothing tells the unit: a change of 1 is taken
    return case, states, draw(one), draw(one) if CASES[case][1] else 1.0


def rests(known: EquationModel, u: float, y: float) -> FloatArray:
    compiled = compile_model(known)
    return rest_state(compiled, compiled.parameter_vector, np.array([u]), y)


@given(told=units())
def test_a_rest_is_the_same_in_other_units(told: tuple[str, FloatArray, float, float]) -> None:
    case, states, reading, command = told
    known, u, y = CASES[case]
    wanted = rests(known, u, y)
    found = rests(in_units(known, states, reading, command), u * command, y * reading) / states
    assert found == pytest.approx(wanted, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("case", [case for case, (_, _, y) in CASES.items() if np.isfinite(y)])
def test_a_state_reads_what_was_read_where_it_cannot_rest_there(case: str) -> None:
    known, u, y = CASES[case]
    compiled = compile_model(known)
    states, inputs = rests(known, u, y), np.array([u])
    assert derivatives(compiled, compiled.parameter_vector, states, inputs)[1][0, 0] == pytest.approx(y, rel=1e-3)


@given(told=units())
def test_a_linearisation_is_the_same_in_other_units(told: tuple[str, FloatArray, float, float]) -> None:
    case, states, reading, command = told
    known, u, y = CASES[case]

    def tangent(of: EquationModel, u: float, y: float) -> Linear | None:
        try:
            return linearise(of, np.array([u]), y)
        except InputError:
            return None

    wanted = tangent(known, u, y)
    found = tangent(in_units(known, states, reading, command), u * command, y * reading)
    if wanted is None:
        assert found is None
        return
    assert found is not None
    omega = np.array([0.01, 1.0, 100.0])
    np.testing.assert_allclose(found.A * states[None, :] / states[:, None], wanted.A, rtol=1e-4, atol=1e-7)
    response, expected = transfer_function(found).response(omega), transfer_function(wanted).response(omega)
    np.testing.assert_allclose(response / (reading / command), expected, rtol=1e-4)


@given(told=units(SIMULATED))
def test_a_twin_is_the_same_in_other_units(told: tuple[str, FloatArray, float, float]) -> None:
    case, states, reading, command = told
    known, u, _ = CASES[case]
    wanted = ModelPlant(known, u_start=u)
    found = ModelPlant(in_units(known, states, reading, command), u_start=u * command)
    assert found.u_applied / command == pytest.approx(wanted.u_applied)
    assert found.y_true / reading == pytest.approx(wanted.y_true, rel=1e-6, abs=1e-9)
    for plant, times in ((wanted, 1.0), (found, command)):
        plant.advance((u + 0.1) * times, 0.2)
    assert found.y_true / reading == pytest.approx(wanted.y_true, rel=1e-4, abs=1e-7)


@given(told=units(SIMULATED))
def test_a_state_is_as_large_in_other_units(told: tuple[str, FloatArray, float, float]) -> None:
    case, states, reading, command = told
    known, u, y = CASES[case]
    t = np.arange(200) * 0.05
    commands = u + 0.2 * np.sign(np.sin(t))

    def sizes(of: EquationModel, start: FloatArray, times: float) -> FloatArray:
        compiled = compile_model(of)
        return state_scales(compiled, compiled.parameter_vector, Drive(t=t, inputs=times * commands[:, None]), start)

    start = rests(known, u, y)
    wanted = sizes(known, start, 1.0)
    found = sizes(in_units(known, states, reading, command), start * states, command) / states
    assert found == pytest.approx(wanted, rel=1e-4)
