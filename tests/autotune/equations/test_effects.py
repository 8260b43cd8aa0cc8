"""Effects of the catalogue in models of equations: each acts as its equation says."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.effects import KINDS
from autotune.equations import Drive, EquationModel, apply, compile_model, simulate
from autotune.equations.effects import equation_of
from autotune.errors import InputError
from autotune.models import Effect, Parameter
from tests.autotune.equations.models import model, one_state

T = np.arange(400) * 0.02
U = np.repeat(np.random.default_rng(7).normal(0.0, 0.6, 20), 20)


def effect(name: str, *, state: str = "", input: str = "", port: str = "", column: str = "", **values: float) -> Effect:
    parameters = {key: Parameter(value=value) for key, value in values.items()}
    return Effect(name=name, parameters=parameters, state=state, input=input, port=port, column=column)


def y_of(base: EquationModel, *effects: Effect, u: np.ndarray = U) -> np.ndarray:
    applied = apply(base, effects)
    compiled = compile_model(base, applied.extensions)
    start = np.zeros((1, len(compiled.states)))
    drive = applied.before(Drive(t=T, inputs=u[:, None]))
    run = simulate(compiled, compiled.parameter_vector, drive, start, delays=applied.delays)
    return applied.after(run.y)


PENDULUM = model()
LAG = one_state("u - x", state=[{"name": "x", "derivative": "u - x", "kind": "level"}])


@pytest.mark.parametrize(
    ("base", "one", "written"),
    [
        (PENDULUM, effect("plant.coulomb_friction", state="omega", level=4.0), "omega: -4*sign(omega)"),
        (PENDULUM, effect("plant.viscous_friction", state="omega", coefficient=2.0), "omega: -2*omega"),
        (PENDULUM, effect("plant.quadratic_drag", state="omega", coefficient=0.5), "omega: -0.5*omega*abs(omega)"),
        (PENDULUM, effect("plant.cubic_stiffness", state="omega", coefficient=20.0), "omega: -20*theta^3"),
        (PENDULUM, effect("plant.sine_torque", state="omega", amplitude=5.0, period=1.5, phase=0.3),
         "omega: -5*sin(2*pi*theta/1.5 + 0.3)"),
        (PENDULUM, effect("plant.stribeck_friction", state="omega", level=2.0, breakaway=4.0, stribeck_speed=0.1),
         "omega: -(2 + 2*exp(-(omega/0.1)^2))*sign(omega)"),
        (LAG, effect("plant.leak", state="x", rate=0.3), "x: -0.3*x"),
        (LAG, effect("plant.sqrt_outflow", state="x", coefficient=0.2), "x: -0.2*sqrt(max(x, 0))"),
        (LAG, effect("environment.step_load", state="x", amplitude=0.4, time=3.0), "x: if(t >= 3, 0.4, 0)"),
        (LAG, effect("environment.drifting_load", state="x", rate=0.1), "x: 0.1*t"),
        (LAG, effect("environment.periodic_load", state="x", in_phase=0.3, quadrature=-0.2, frequency=0.5),
         "x: 0.3*sin(pi*t) - 0.2*cos(pi*t)"),
    ],
)  # fmt: skip
def test_a_force_adds_to_the_derivative(base: EquationModel, one: Effect, written: str) -> None:
    from dataclasses import replace

    from autotune.equations.expressions import Call, parse

    name, text = written.split(": ")
    states = tuple(
        replace(s, derivative=Call("+", (s.derivative, parse(text)))) if s.name == name else s for s in base.states
    )
    np.testing.assert_allclose(y_of(base, one), y_of(replace(base, states=states)), atol=1e-5)
    assert np.max(np.abs(y_of(base, one) - y_of(base))) > 1e-3
    assert name in equation_of(base, one)


@pytest.mark.parametrize(
    ("one", "u"),
    [
        (effect("actuator.saturation", low=-0.3, high=0.4), np.clip(U, -0.3, 0.4)),
        (effect("actuator.dead_zone", half_width=0.2), U - np.clip(U, -0.2, 0.2)),
        (effect("actuator.offset", offset=0.3), U + 0.3),
        (effect("actuator.nonlinear_gain", second_order=0.5, third_order=-0.2), U + 0.5 * U**2 - 0.2 * U**3),
        (effect("actuator.quantisation", step=0.25), 0.25 * np.floor(U / 0.25 + 0.5)),
        (effect("timing.dead_time", delay=0.06), np.concatenate([np.full(3, U[0]), U[:-3]])),
        (effect("timing.jitter"), U),
    ],
)
def test_an_actuator_changes_the_command(one: Effect, u: np.ndarray) -> None:
    np.testing.assert_allclose(y_of(PENDULUM, one), y_of(PENDULUM, u=u), atol=1e-6)


def test_backlash_and_stiction_have_a_memory() -> None:
    triangle = np.interp(np.arange(400), [0, 100, 300, 399], [0.0, 1.0, -1.0, 0.0])
    direct = one_state("0*x", output="u")
    play = y_of(direct, effect("actuator.backlash", width=0.4), u=triangle)[1:]
    assert play.max() == pytest.approx(0.8, abs=1e-12)
    assert np.all(play[100:140] == play[101])  # held while the play is taken up
    stuck = y_of(direct, effect("actuator.stiction", band=0.3), u=triangle)
    assert len(set(stuck.round(9))) < 16


def test_a_sensor_changes_the_reading() -> None:
    clean = y_of(PENDULUM)
    np.testing.assert_allclose(y_of(PENDULUM, effect("sensor.saturation", high=0.2)), np.minimum(clean, 0.2), atol=1e-9)
    np.testing.assert_allclose(y_of(PENDULUM, effect("sensor.drift", rate=0.1)), clean + 0.1 * T, atol=1e-9)
    np.testing.assert_allclose(y_of(PENDULUM, effect("sensor.absolute_value")), np.abs(clean), atol=1e-9)
    step = y_of(PENDULUM, effect("sensor.quantisation", step=0.05))
    np.testing.assert_allclose(step / 0.05, np.round(step / 0.05), atol=1e-9)


def test_a_stop_holds_the_position_near_its_place() -> None:
    stop = effect("plant.hard_stop", state="omega", high=0.1, stiffness=1e5, damping=500.0)
    y = y_of(PENDULUM, stop, u=np.where(T < 4.0, 1.0, -1.0))
    assert 0.099 < y.max() < 0.102
    assert y.min() < -0.5


def test_every_effect_is_refused_in_one_line_where_it_cannot_act() -> None:
    for one in (effect("plant.coulomb_friction", level=1.0), effect("plant.coulomb_friction", state="omega"),
                effect("plant.magic"), effect("timing.dead_time", delay=-1.0),
                effect("actuator.offset", input="w", offset=1.0),
                effect("plant.leak", port="F", rate=1.0), effect("plant.leak", state="v", rate=1.0)):  # fmt: skip
        with pytest.raises(InputError) as refused:
            y_of(PENDULUM, one)
        assert "\n" not in str(refused.value)


def test_at_a_port_friction_acts_on_the_difference_of_speeds() -> None:
    quarter_car = {
        "state": [
            {"name": "zb", "derivative": "vb", "kind": "position"},
            {"name": "zw", "derivative": "vw", "kind": "position"},
            {"name": "vb", "derivative": "(F_d - ks*(zb - zw))/mb", "kind": "speed", "of": "zb"},
            {"name": "vw", "derivative": "(ks*(zb - zw) - F_d - kt*(zw - u))/mw", "kind": "speed", "of": "zw"},
        ],
        "port": [{"name": "F_d", "kind": "force", "across": "vb - vw", "unit": "N"}],
    }  # fmt: skip
    base = one_state("0", {"mb": 300.0, "mw": 40.0, "ks": 2e4, "kt": 2e5}, output="zb - zw", **quarter_car)
    damper = effect("plant.viscous_friction", port="F_d", coefficient=1500.0)
    assert equation_of(base, damper) == "F_d = -coefficient*(vb - vw)"
    assert np.std(y_of(base, damper)) < 0.5 * np.std(y_of(base))
    spring = effect("plant.cubic_stiffness", port="F_d", coefficient=1e5)
    assert equation_of(base, spring) == "F_d = -coefficient*(zb - zw)^3"


def test_every_known_effect_can_be_simulated() -> None:
    values = dict.fromkeys(
        ("level", "breakaway", "stribeck_speed", "coefficient", "amplitude", "period", "rate", "width", "stiffness",
         "half_width", "band", "step", "delay", "offset", "time_constant", "time_constant_up", "time_constant_down",
         "slope", "share", "frequency", "time", "in_phase", "quadrature", "damping", "gain"), 0.3,
    )  # fmt: skip
    for name in (name for name, kind in KINDS.items() if kind.in_equations is not None):
        state = "omega" if name.startswith(("plant", "environment")) else ""
        assert np.all(np.isfinite(y_of(PENDULUM, effect(name, state=state, column="u", **values)))), name


def test_a_recorded_column_acts_at_a_state_at_an_input_and_beside_the_reading() -> None:
    name, inputs = "environment.measured_input", [{"column": "u"}, {"column": "w", "hold": "linear"}]
    plant = one_state("u - x", input=inputs, state=[{"name": "x", "derivative": "u - x"}])
    late = {"gain": 0.5, "reference": 0.1, "time_constant": 0.2}

    def run(*effects: Effect) -> np.ndarray:
        compiled = compile_model(plant, apply(plant, effects).extensions)
        drive = Drive(t=T, inputs=np.column_stack([U, np.sin(T)]))
        return simulate(compiled, compiled.parameter_vector, drive, np.zeros((1, len(compiled.states)))).y

    at_state = run(effect(name, column="w", state="x", **late))
    np.testing.assert_allclose(at_state, run(effect(name, column="w", input="u", **late)), atol=1e-6)
    beside = run(effect(name, column="w", gain=0.5, reference=0.1))
    np.testing.assert_allclose(beside, run() + 0.5 * (np.sin(T) - 0.1), atol=1e-9)
    assert equation_of(plant, effect(name, column="w", state="x", gain=1.0)).startswith("d x/dt: + gain*(w")
    with pytest.raises(InputError, match="column"):
        run(effect(name, column="wind", state="x", gain=1.0))


def test_what_an_effect_takes_away_has_one_sign() -> None:
    plant = one_state("u - x", state=[{"name": "x", "kind": "speed", "derivative": "u - x"}])
    drag = effect("plant.quadratic_drag", state="x", coefficient=1.0)
    assert equation_of(plant, drag).startswith("d x/dt: - coefficient*x")
