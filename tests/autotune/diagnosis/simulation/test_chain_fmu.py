"""A chain with effects leaves as an FMU whose y is that of the simulation, for every effect that a chain can have."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from typer.testing import CliRunner

from autotune.cli import app
from autotune.diagnosis.simulation.assembly import assemble
from autotune.diagnosis.simulation.chain_fmu import chain_as_fmu
from autotune.effects import ALL
from autotune.errors import InputError
from autotune.model_tables import write_model
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording

pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None and shutil.which("gcc") is None, reason="no C compiler: apt install gcc"
)

#: an hour of samples, a second each
T = np.arange(3601.0)
U = 2.0 + np.repeat(np.random.default_rng(4).normal(0.0, 1.0, 181), 20)[: T.size]


def block(name: str, place: Any, num: tuple[float, ...], den: tuple[float, ...], delay_s: float = 0.0) -> Block:
    return Block(name=name, place=place, dynamics=TransferFunction(num=num, den=den, delay_s=delay_s))


#: a valve that lags, before a shaft with a spring, or two levels and a sensor with a dead time between two samples
SHAFT = Model(
    name="shaft",
    input=Port(unit="V", offset=2.0),
    output=Port(unit="rad", offset=3.0),
    blocks=(
        block("valve", "actuator", (1.0,), (2.0, 1.0)),
        block("shaft", "plant", (0.3,), (8.0, 1.0, 0.02)),
    ),
)
LEVELS = Model(
    name="levels",
    input=Port(unit="%", offset=2.0),
    output=Port(unit="cm", offset=40.0),
    blocks=(
        block("valve", "actuator", (1.0,), (3.0, 1.0), delay_s=2.35),
        block("upper", "plant", (2.0,), (20.0, 1.0)),
        block("lower", "plant", (1.0,), (30.0, 1.0)),
        block("lead", "sensor", (0.2, 1.0), (1.5, 1.0)),
    ),
)
#: of an effect, the chain that has it and its numbers
CASES: dict[str, tuple[Model, dict[str, float]]] = {
    "actuator.quantisation": (LEVELS, {"step": 0.3}),
    "actuator.backlash": (LEVELS, {"width": 0.5}),
    "actuator.stiction": (LEVELS, {"band": 0.6, "slip": 0.2}),
    "actuator.dead_zone": (LEVELS, {"half_width": 0.3}),
    "actuator.nonlinear_gain": (LEVELS, {"second_order": 0.05, "third_order": 0.01, "low": -1.5, "high": 1.2}),
    "actuator.saturation": (LEVELS, {"low": 1.3, "high": 2.9}),
    "actuator.rate_limit": (LEVELS, {"rate": 0.07}),
    "actuator.gain_drift": (LEVELS, {"rate": 1e-4}),
    "actuator.lag": (LEVELS, {"time_constant": 4.0}),
    "actuator.asymmetric_lag": (LEVELS, {"time_constant_up": 2.0, "time_constant_down": 7.0}),
    "actuator.offset": (LEVELS, {"offset": 0.4}),
    "plant.coulomb_friction": (SHAFT, {"level": 0.2}),
    "plant.stribeck_friction": (SHAFT, {"level": 0.1, "breakaway": 0.25, "stribeck_speed": 0.05}),
    "plant.quadratic_drag": (SHAFT, {"coefficient": 0.8}),
    "plant.cubic_stiffness": (SHAFT, {"coefficient": 0.002}),
    "plant.position_dependent_gain": (SHAFT, {"slope": 0.03, "low": -6.0, "high": 8.0}),
    "plant.hard_stop": (SHAFT, {"low": 0.5, "high": 6.0}),
    "plant.sqrt_outflow": (LEVELS, {"operating_level": 40.0, "operating_level_2": 35.0}),
    "plant.resonance": (LEVELS, {"frequency": 0.08, "damping": 0.2}),
    "plant.hysteresis": (SHAFT, {"amplitude": 0.2, "width": 1.0}),
    "plant.radiation_loss": (LEVELS, {"coefficient": 2e-8}),
    "plant.nonlinear_loss": (LEVELS, {"coefficient": 0.01}),
    "plant.leak": (replace(SHAFT, blocks=(SHAFT.blocks[0], block("tank", "plant", (0.01,), (1.0, 0.0)))),
                   {"rate": 0.01}),
    "plant.sine_torque": (SHAFT, {"amplitude": 0.3, "period": 2.0, "phase": 0.4}),
    "plant.slow_mode": (LEVELS, {"share": 0.3, "time_constant": 200.0}),
    "sensor.lag": (LEVELS, {"time_constant": 5.0}),
    "sensor.nonlinear_gain": (LEVELS, {"second_order": 0.02, "third_order": 0.001, "low": -3.0, "high": 3.0}),
    "sensor.drift": (LEVELS, {"rate": 1e-3}),
    "sensor.absolute_value": (LEVELS, {"fold": 40.5}),
    "sensor.saturation": (LEVELS, {"low": 38.0, "high": 42.0}),
    "sensor.quantisation": (LEVELS, {"step": 0.05}),
    "timing.dead_time": (LEVELS, {"delay": 3.7}),
    "environment.step_load": (LEVELS, {"amplitude": 0.5, "time": 1000.0, "end": 2000.0}),
    "environment.periodic_load": (LEVELS, {"in_phase": 0.3, "quadrature": 0.1, "frequency": 0.004}),
    "environment.drifting_load": (LEVELS, {"rate": 2e-4}),
    "environment.gain_step": (LEVELS, {"change": -0.3, "time": 1500.0}),
    "environment.loss_step": (LEVELS, {"change": 0.2, "time": 1500.0}),
}  # fmt: skip


def extended(chain: Model, **effects: dict[str, float]) -> Model:
    made = [
        Effect(name=name, parameters=MappingProxyType({key: Parameter(value=value) for key, value in values.items()}))
        for name, values in effects.items()
    ]
    return replace(chain, effects=tuple(made))


def run_fmu(path: Path, u: np.ndarray = U, **starts: float) -> np.ndarray:
    driven = np.rec.fromarrays([T, u], names=["time", "u"])
    result = fmpy.simulate_fmu(
        str(path), stop_time=float(T[-1]), output_interval=1.0, input=driven, output=["y"], start_values=starts
    )
    np.testing.assert_allclose(result["time"], T)
    return np.asarray(result["y"])


def run_here(model: Model, u: np.ndarray = U) -> np.ndarray:
    sim = assemble(model)
    out, _ = sim.run(Recording(t=T, u=u, y=0.0 * T), np.zeros(sim.order), signals=1)
    return np.asarray(out[:, 0])


def test_every_effect_that_a_simulation_has_is_a_case_or_refused() -> None:
    assert {*CASES, "timing.clock_error"} == {kind.name for kind in ALL if kind.is_simulated}


@pytest.mark.parametrize("name", CASES)
def test_the_fmu_of_an_effect_runs_as_the_simulation_for_an_hour(name: str, tmp_path: Path) -> None:
    chain, values = CASES[name]
    model = extended(chain, **{name: values})
    (tmp_path / "rig.fmu").write_bytes(chain_as_fmu(model)[0])
    wanted = run_here(model)
    assert np.ptp(wanted - run_here(chain)) > 1e-3 * np.ptp(wanted)  # the effect shows
    np.testing.assert_allclose(run_fmu(tmp_path / "rig.fmu"), wanted, atol=1e-9, rtol=0.0)


def test_effects_together_their_numbers_tunable(tmp_path: Path) -> None:
    names = ("actuator.backlash", "plant.hysteresis", "plant.coulomb_friction", "sensor.drift", "actuator.rate_limit")
    effects = {name: CASES[name][1] for name in names}
    model = extended(SHAFT, **effects)
    write_model(model, tmp_path / "extended_model.toml")
    out = tmp_path / "rig.fmu"
    command = ["model", "export", str(tmp_path / "extended_model.toml"), "--form", "fmu", "--out", str(out)]
    said = CliRunner().invoke(app, command)
    assert said.exit_code == 0, said.output
    assert validate_fmu(out) == []
    np.testing.assert_allclose(run_fmu(out), run_here(model), atol=1e-9, rtol=0.0)
    other = extended(SHAFT, **(effects | {"actuator.backlash": {"width": 0.9}}))
    np.testing.assert_allclose(run_fmu(out, **{"actuator.backlash.width": 0.9}), run_here(other), atol=1e-9, rtol=0.0)


def test_what_an_fmu_cannot_know_is_refused() -> None:
    with pytest.raises(InputError, match="before they are given"):
        chain_as_fmu(extended(LEVELS, **{"timing.clock_error": {"error": -1e-4}}))
    straight = replace(LEVELS, input=replace(LEVELS.input, hold="linear"))
    with pytest.raises(InputError, match="straight from row to row"):
        chain_as_fmu(extended(straight, **{"sensor.drift": {"rate": 1e-3}}))
