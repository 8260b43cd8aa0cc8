"""Models of equations that several tests use."""

from __future__ import annotations

from autotune.equations import EquationModel
from autotune.equations.read import equations_of

PENDULUM = {
    "name": "pendulum",
    "input": [{"column": "u", "unit": "N m"}],
    "output": {"value": "theta", "unit": "rad"},
    "state": [
        {"name": "theta", "unit": "rad", "kind": "position", "derivative": "omega"},
        {"name": "omega", "unit": "rad/s", "kind": "speed", "of": "theta",
         "derivative": "(u - c*omega - m*g*l*sin(theta))/J"},
    ],
    "parameters": {
        "J": {"value": 0.05, "unit": "kg m^2"}, "c": {"value": 0.02, "unit": "N m s/rad"},
        "m": {"value": 0.5, "unit": "kg"}, "l": {"value": 0.3, "unit": "m", "spread": 0.1},
        "g": {"value": 9.81, "unit": "m/s^2", "fixed": True},
    },
}  # fmt: skip


def model(**changes: object) -> EquationModel:
    """Return the pendulum with tables of its file replaced."""
    return equations_of({**PENDULUM, **changes}, "pendulum.toml")


def one_state(
    derivative: str, parameters: dict[str, object] | None = None, output: str = "x", **more: object
) -> EquationModel:
    """Return a model with the single state x, driven by u."""
    content = {"name": "one", "input": [{"column": "u"}], "output": {"value": output},
               "state": [{"name": "x", "derivative": derivative}], "parameters": parameters or {}, **more}  # fmt: skip
    return equations_of(content, "one.toml")
