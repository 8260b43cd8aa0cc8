"""Model files of equations: what is refused, and in which words; what is written reads back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from autotune.equations import read_equations, write_equations
from autotune.equations.read import equations_of
from autotune.errors import InputError
from autotune.models import Effect, Parameter
from autotune.units import read_unit
from tests.autotune.equations.models import PENDULUM, model


def changed(**tables: Any) -> dict[str, Any]:
    return {**PENDULUM, **tables}


def states(omega: str) -> list[dict[str, Any]]:
    return [PENDULUM["state"][0], PENDULUM["state"][1] | {"derivative": omega}]


def parameter(name: str, **entries: Any) -> dict[str, Any]:
    return PENDULUM["parameters"] | {name: PENDULUM["parameters"][name] | entries}


def without_units(**tables: Any) -> dict[str, Any]:
    """Return the pendulum with no unit but those of the tables that are replaced."""
    bare = [{key: value for key, value in one.items() if key != "unit"} for one in PENDULUM["state"]]
    numbers = {name: one["value"] for name, one in PENDULUM["parameters"].items()}
    return {**PENDULUM, "input": [{"column": "u"}], "state": bare, "parameters": numbers, **tables}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (changed(state=states("(u - c*omga)/J")), "unknown name 'omga'; did you mean 'omega'?"),
        (changed(state=states("(u - c*omega")), "')' is missing"),
        (changed(define={"a": "b + 1", "b": "2*a"}), "algebraic loop a -> b -> a"),
        (changed(define={"a": "a + 1"}), "algebraic loop a -> a"),
        (changed(define={"a": "b + 1", "b": "2"}), "uses 'b', which is defined after it"),
        (changed(port=[{"name": "F", "kind": "torque", "across": "omega + F"}]), "algebraic loop through port 'F'"),
        (changed(port=[{"name": "F", "kind": "magic"}]), "kind = 'magic'"),
        (changed(parameters=parameter("J", unit="kg m")), "gives m s^-2 where s^-2 is wanted"),
        (changed(parameters=parameter("J", unit="kgm^2")), "the unit 'kgm^2' is not known"),
        (changed(parameters=parameter("l", unit="cm")), "differ by a factor"),
        (changed(state=states("(u - c*omega - m*g*l*sin(omega))/J")), "sin of 'omega'"),
        (changed(state=states("(u + theta)/J")), "only like units can be added"),
        (changed(output={"value": "theta", "unit": "deg"}), "times the one that is wanted"),
        (changed(output={"unit": "rad"}), "value is missing"),
        (without_units(output={"value": "theta", "unit": "fulrong"}), "the unit 'fulrong' is not known"),
        (
            changed(
                effect=[
                    {
                        "name": "plant.coulomb_friction",
                        "state": "omega",
                        "parameters": {"level": {"value": 0.1, "unit": "fulrong"}},
                    }
                ]
            ),
            "plant.coulomb_friction level: the unit 'fulrong' is not known",
        ),
        (changed(parameters=parameter("J", value="big")), "value = 'big'"),
        (changed(parameters=parameter("J", spread=-1.0)), "spread = -1"),
        (changed(parameters=PENDULUM["parameters"] | {"u": 1.0}), "'u' is both input and parameter"),
        (changed(parameters=PENDULUM["parameters"] | {"sin": 1.0}), "has the name of a function"),
        (changed(state=[*PENDULUM["state"], PENDULUM["state"][0]]), "two states 'theta'"),
        (changed(input={"column": "u"}), "write [[input]]"),
        (changed(input=[{"column": "u", "hold": "cubic"}]), "hold = 'cubic'"),
        (changed(colour="red"), "unknown key 'colour'"),
        (changed(state=[]), "no [[state]]"),
        (changed(horizon_s=-1), "positive number"),
        (changed(state=[PENDULUM["state"][0], PENDULUM["state"][1] | {"of": "angle"}]), "of = 'angle' is no state"),
    ],
)
def test_what_is_wrong_is_one_line_with_what_and_where(content: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError) as refused:
        equations_of(content, "pendulum.toml")
    message = str(refused.value)
    assert says in message
    assert "\n" not in message
    assert "pendulum" in message


def test_a_model_written_reads_back_equal(tmp_path: Path) -> None:
    effect = Effect(
        name="plant.coulomb_friction", state="omega", parameters={"level": Parameter(value=0.1, unit="N m", sd=0.01)}
    )
    full = model(
        input=[{"column": "u", "unit": "N m", "delay": 0.1, "offset": 0.5}, {"column": "w", "hold": "linear"}],
        define={"torque": "u + w"},
        port=[{"name": "T_d", "kind": "torque", "across": "omega", "unit": "N m"}],
        state=states("(torque + T_d - c*omega - m*g*l*sin(theta))/J"),
        horizon_s=2.0,
    )
    from dataclasses import replace

    full = replace(full, effects=(effect,))
    write_equations(full, tmp_path / "m.toml", {effect.name: "-level*sign(omega)"})
    assert "-level*sign(omega)" in (tmp_path / "m.toml").read_text()
    assert read_equations(tmp_path / "m.toml") == full


def test_units_convert_by_a_number_in_the_expression() -> None:
    assert model(output={"value": "theta*180/pi", "unit": "deg"}).output_unit == "deg"


def test_a_temperature_rise_in_kelvin_and_celsius_are_alike() -> None:
    content = {
        "name": "oven", "input": [{"column": "u", "unit": "W"}, {"column": "room", "unit": "degC"}],
        "output": {"value": "T", "unit": "degC"},
        "state": [{"name": "T", "unit": "degC", "kind": "temperature", "derivative": "(u - G*(T - room))/C"}],
        "parameters": {"G": {"value": 2.0, "unit": "W/K"}, "C": {"value": 500.0, "unit": "J/degC"}},
    }  # fmt: skip
    assert equations_of(content, "oven.toml").columns == ("u", "room")


@pytest.mark.parametrize(
    ("written", "usual"),
    [("Nm", "N m"), ("mNm", "mN m"), ("Nms/rad", "N m s/rad"), ("Vs/rad", "V s/rad"), ("Pas", "Pa s"),
     ("pct", "%"), ("m/s2", "m/s^2"), ("m s-2", "m/s^2"), ("Nm3/h", "m^3/h"), ("cfm", "ft^3/min"), ("pH", "1")],
)  # fmt: skip
def test_units_are_read_as_engineers_write_them(written: str, usual: str) -> None:
    found, wanted = read_unit(written), read_unit(usual)
    assert found is not None
    assert wanted is not None
    assert found.powers == wanted.powers
    assert found.factor == pytest.approx(wanted.factor, rel=1e-12)


def test_a_motor_in_newton_metres_without_a_blank_is_accepted() -> None:
    assert PENDULUM["input"][0]["unit"] == "N m"
    assert model(input=[{"column": "u", "unit": "Nm"}]).inputs[0].unit == "Nm"
