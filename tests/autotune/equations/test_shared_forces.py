"""A force that is missing acts on every body that the model's own force there acts on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from autotune.arrays import FloatArray
from autotune.equations import Drive, EquationModel, apply, compile_model, simulate
from autotune.equations.effects import equation_of
from autotune.equations.expressions import to_text
from autotune.equations.read import equations_of
from autotune.equations.shared_forces import joint_at
from autotune.models import Effect, Parameter

T = 0.01 * np.arange(300)
PUSH = 3.0


def two_bodies(**changes: str) -> EquationModel:
    """A body on a spring and a damper upon another one, which stands on a spring of its own."""
    written = {
        "vb": "(-ks*(zb - zw) - cs*(vb - vw) + u)/mb", "vw": "(ks*(zb - zw) + cs*(vb - vw) - u - kt*zw)/mw", **changes,
    }  # fmt: skip
    states = [{"name": "zb", "kind": "position", "derivative": "vb"},
              {"name": "vb", "kind": "speed", "of": "zb", "derivative": written["vb"]},
              {"name": "zw", "kind": "position", "derivative": "vw"},
              {"name": "vw", "kind": "speed", "of": "zw", "derivative": written["vw"]}]  # fmt: skip
    numbers = {"mb": 3.0, "mw": 0.4, "ks": 18.0, "cs": 1.2, "kt": 180.0}
    return equations_of(
        {"name": "two bodies", "input": [{"column": "u"}], "output": {"value": "zb - zw"}, "state": states,
         "parameters": {name: {"value": value} for name, value in numbers.items()}}, "two.toml",
    )  # fmt: skip


def crane() -> EquationModel:
    """A cart with a hanging load: friction of the cart is a force on it, which the load feels."""
    push = "(u - b*v + m*l*omega^2*sin(theta) + m*g*sin(theta)*cos(theta))/(M + m*sin(theta)^2)"
    states = [{"name": "x", "kind": "position", "derivative": "v"},
              {"name": "v", "kind": "speed", "of": "x", "derivative": push},
              {"name": "theta", "kind": "position", "derivative": "omega"},
              {"name": "omega", "kind": "speed", "of": "theta",
               "derivative": f"-(cos(theta)*{push} + g*sin(theta))/l - cp*omega"}]  # fmt: skip
    numbers = {"M": 2.0, "m": 0.5, "l": 0.8, "b": 0.4, "cp": 0.15, "g": 9.81}
    return equations_of(
        {"name": "crane", "input": [{"column": "u"}], "output": {"value": "theta"}, "state": states,
         "parameters": {name: {"value": value} for name, value in numbers.items()}}, "crane.toml",
    )  # fmt: skip


def sprung(t: float, x: FloatArray) -> list[float]:
    """Return the bodies' equations of motion with a spring between them that stiffens: 40 N/m^3."""
    zb, vb, zw, vw = x
    force = 18.0 * (zb - zw) + 1.2 * (vb - vw) + 40.0 * (zb - zw) ** 3 - PUSH
    return [vb, -force / 3.0, vw, (force - 180.0 * zw) / 0.4]


def dragged(t: float, x: FloatArray) -> list[float]:
    """Return the crane's motion, by its mass matrix, with a drag of 6 N s^2/m^2 on the cart."""
    _, v, theta, omega = x
    mass = np.array([[2.5, 0.4 * np.cos(theta)], [np.cos(theta), 0.8]])
    pushed = PUSH - 0.4 * v - 6.0 * v * abs(v) + 0.4 * omega**2 * np.sin(theta)
    a, alpha = np.linalg.solve(mass, [pushed, -9.81 * np.sin(theta)])
    return [v, a, omega, alpha - 0.15 * omega]


def moved(base: EquationModel, *effects: Effect) -> FloatArray:
    """Return the simulated reading from rest under a constant push."""
    applied = apply(base, effects)
    compiled = compile_model(base, applied.extensions)
    drive = Drive(t=T, inputs=np.full((T.size, 1), PUSH))
    return simulate(compiled, compiled.parameter_vector, drive, np.zeros((1, len(compiled.states)))).y


def effect(name: str, state: str, **values: float) -> Effect:
    return Effect(name=name, state=state, parameters={key: Parameter(value=value) for key, value in values.items()})


# in units of the acceleration of what it acts on: 40 N/m^3 over 3 kg, 6 N s^2/m^2 over the cart's 2 kg, which with
# the load's share M + m sin^2(theta) are 2.02 kg at most here
@pytest.mark.parametrize(
    ("base", "one", "truth", "reads", "error"),
    [
        (two_bodies(), effect("plant.cubic_stiffness", "vb", coefficient=40.0 / 3.0), sprung, (1, 0, -1, 0), 1e-4),
        (crane(), effect("plant.quadratic_drag", "v", coefficient=3.0), dragged, (0, 0, 1, 0), 0.02),
    ],
)
def test_the_plant_moves_as_its_equations_of_motion_with_the_force_say(
    base: EquationModel, one: Effect, truth: Callable[..., list[float]], reads: tuple[int, ...], error: float
) -> None:
    x = solve_ivp(truth, (0.0, T[-1]), np.zeros(4), t_eval=T, rtol=1e-9, atol=1e-12).y
    y, without = moved(base, one), moved(base)
    assert np.ptp(without - y) > 0.1 * np.ptp(y)  # the force is felt
    assert np.max(np.abs(y - np.array(reads) @ x)) < error * np.ptp(without - y)


def test_what_others_take_of_a_force_is_read_off_the_equations() -> None:
    between, cart = joint_at(two_bodies(), "vb"), joint_at(crane(), "v")
    assert (to_text(between.speed), to_text(between.position)) == ("vb - vw", "zb - zw")
    assert {name: to_text(share) for name, share in between.shares.items()} == {"vw": "-mb/mw"}
    assert (to_text(cart.speed), to_text(cart.position)) == ("v", "x")
    assert {name: to_text(share) for name, share in cart.shares.items()} == {"omega": "-cos(theta)/l"}
    friction = effect("plant.coulomb_friction", "v", level=0.1)
    assert equation_of(crane(), friction).endswith("; d omega/dt: that times -cos(theta)/l")


@pytest.mark.parametrize(
    ("state", "slope"),
    [
        ("vw", "(ks*(zb - zw) + cs*(vb - vw) - u - kt*zw)/mw"),  # the body that is second in the difference
        ("vb", "(-ks*sin(zb - zw) - cs*vb + u)/mb"),  # nothing is shared that is a parameter times a difference
        ("vb", "(-ks*(zb - zw)^3 - cs*(vb - vw)/(1 + cs) + u)/mb"),  # the damper's number stands elsewhere too
    ],
)
def test_a_state_whose_forces_are_its_own_takes_them_alone(state: str, slope: str) -> None:
    joint = joint_at(two_bodies(**{state: slope}), state)
    assert not joint.shares
    assert to_text(joint.speed) == state
