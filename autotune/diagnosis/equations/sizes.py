"""Sizes of effects in equations: with their units, as the command that does the same, and where they were seen."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.followed import positions_of, speeds_of
from autotune.diagnosis.result import OperatingRange
from autotune.effects import KINDS
from autotune.equations.effects import at_state, where_of
from autotune.equations.expressions import Number
from autotune.equations.linearise import Linear, linearise_at
from autotune.equations.model import EquationModel, Extension
from autotune.equations.simulate import compile_model, derivatives
from autotune.models import Effect

#: Share of the fastest rate at which a steady command and a steady force are compared: an integrator has no rest.
STEADY = 1e-6


def units_at(model: EquationModel, effect: Effect, output_unit: str) -> dict[str, str]:
    """Return the units of what acts where an effect does: command, force, speed or state, position or reading."""
    states = {one.name: one for one in model.states}
    ports = {one.name: one for one in model.ports}
    units = {"u": model.inputs[0].unit, "f": "", "v": "", "y": output_unit}
    if effect.state in states:
        state = states[effect.state]
        at = states[state.of] if state.of else state
        units |= {"f": _per_second(state.unit), "v": state.unit, "y": at.unit}
    elif effect.port in ports:
        name = positions_of(model)[effect.port]
        units |= {"f": ports[effect.port].unit, "y": states[name].unit if name in states else ""}
    return units


def _per_second(unit: str) -> str:
    """Return the unit of a change per second of what has a unit; nothing where that is not stated."""
    return f"{unit}^2" if unit.endswith("/s") else f"{unit}/s" if unit else ""


def with_units(model: EquationModel, effect: Effect, output_unit: str) -> Effect:
    """Return an effect with the units of its numbers, as far as the model states those that they are made of."""
    units, parameters = units_at(model, effect, output_unit), dict(effect.parameters)
    for key, p in parameters.items():
        q = KINDS[effect.name].quantity(key)
        needed = [] if q is None else [name for name in units if f"{{{name}}}" in q.unit]
        if q is not None and not p.unit and all(units[name] for name in needed):
            parameters[key] = replace(p, unit=q.unit.format(**units))
    return replace(effect, parameters=MappingProxyType(parameters))


def command_of(bench: Bench, outcome: Outcome, effect: Effect) -> float:
    """Return the steady command that does what a unit of force at an effect's place does; 0 where none does.

    Notes
    -----
    Both go through the equations, linearised where they usually are, to the reading; where the plant integrates their
    ratio is taken as its limit at low frequencies.
    """
    if not (effect.state or effect.port):
        return 0.0
    model, signals = bench.model, bench.signals(outcome)
    bare = replace(model, effects=()).with_parameters(outcome.fitted.parameters[: len(model.parameters)])
    states = np.array([float(np.median(signals.values[name])) for name in model.state_names])
    columns = [np.concatenate([r[name] for r in bench.recordings]) for name in model.columns]
    linear = linearise_at(bare, states, np.array([float(np.median(column)) for column in columns]))
    force, A = _unit_force(bare, linear, effect), linear.A
    fastest = float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0)) or 1.0
    reach = np.linalg.solve((STEADY * fastest * np.eye(A.shape[0]) - A).T, linear.C[0])
    of_force, of_command = float(reach @ force), float(reach @ linear.B[:, 0] + linear.D[0, 0])
    return of_force / of_command if of_command and np.isfinite(of_force / of_command) else 0.0


def _unit_force(model: EquationModel, linear: Linear, effect: Effect) -> FloatArray:
    """Return how a unit at an effect's state or port changes the derivatives."""
    x, inputs, compiled = linear.states[None, :], linear.inputs[None, :], compile_model(model)
    p = compiled.parameter_vector
    unit = Extension(name="unit", port={effect.port: Number(1.0)})
    if effect.state:
        unit = Extension(name="unit", derivative=at_state(model, effect.state, Number(1.0)))
    acting = compile_model(model, [unit])
    return np.asarray((derivatives(acting, p, x, inputs)[0] - derivatives(compiled, p, x, inputs)[0])[0])


def spans_at(bench: Bench, outcome: Outcome, effect: Effect) -> OperatingRange | None:
    """Return between which values of its signal an effect was seen; nothing where no signal of the model is it."""
    signals, model, place = bench.signals(outcome), bench.model, where_of(effect)
    units = units_at(model, effect, model.output_unit)
    if not place:
        values, name, unit = signals.y, "y", units["y"]
    elif place == model.columns[0]:
        values, name, unit = signals.u, place, units["u"]
    elif place in signals.values:
        values, name, unit = signals.values[speeds_of(model)[place]], place, units["v"]
    else:
        return None
    return OperatingRange(signal=name, low=float(np.nanmin(values)), high=float(np.nanmax(values)), unit=unit)
