"""Effects of the catalogue in models of equations: each in the model's own language, or on samples, or as dead time.

Where it acts is said by the effect itself: ``state`` (added to its derivative, in the derivative's unit), ``port``
(a force, torque, flow or heat of the port's unit), ``input`` (a column), or nothing for the output and the first
input. In the expressions below ``V`` is the speed (``across`` of the port, or the state), ``X`` the position, level
or temperature that goes with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.expressions import Call, Expression, Name, parse, substituted, to_text
from autotune.equations.model import EquationModel, Extension, ModelParameter, State
from autotune.equations.samples import BEFORE, quantised
from autotune.equations.simulate import Compiled, Drive, Held, compile_model
from autotune.errors import InputError
from autotune.models import Effect, Parameter

#: Forces, torques, flows and heats: what is added to a derivative or at a port.
FORCES: Mapping[str, str] = {
    "plant.coulomb_friction": "-level*sign(V)",
    "plant.stribeck_friction": "-(level + (breakaway - level)*exp(-(V/stribeck_speed)^2))*sign(V)",
    "plant.viscous_friction": "-coefficient*V",
    "plant.quadratic_drag": "-coefficient*V*abs(V)",
    "plant.nonlinear_loss": "-coefficient*V*abs(V)",
    "plant.cubic_stiffness": "-coefficient*X^3",
    "plant.sine_torque": "-amplitude*sin(2*pi*X/period + phase)",
    "plant.leak": "-rate*X",
    "plant.sqrt_outflow": "-coefficient*sqrt(max(X, 0))",
    "plant.radiation_loss": "-coefficient*((X + zero)^4 - surroundings^4)",
    "plant.hysteresis": "-amplitude*memory",
    "plant.hard_stop": "if(X > high, -stiffness*(X - high) - damping*max(V, 0), 0)"
    " + if(X < low, -stiffness*(X - low) - damping*min(V, 0), 0)",
    "environment.step_load": "if(t >= time, if(t < end, amplitude, 0), 0)",
    "environment.periodic_load": "in_phase*sin(2*pi*frequency*t) + quadrature*cos(2*pi*frequency*t)",
    "environment.drifting_load": "rate*t",
}
#: What the equations receive in place of a column, which is ``value``.
INPUTS: Mapping[str, str] = {
    "actuator.saturation": "min(max(value, low), high)",
    "actuator.dead_zone": "value - min(max(value, -half_width), half_width)",
    "actuator.nonlinear_gain": "value + second_order*(value - origin)^2 + third_order*(value - origin)^3",
    "actuator.offset": "value + offset",
    "actuator.gain_drift": "value*(1 + rate*t)",
    "actuator.lag": "memory",
    "actuator.asymmetric_lag": "memory",
    "actuator.rate_limit": "memory",
    "plant.position_dependent_gain": "value*(1 + slope*X)",
}
#: The reading in place of the undisturbed output, which is ``value``.
OUTPUTS: Mapping[str, str] = {
    "sensor.saturation": "min(max(value, low), high)",
    "sensor.nonlinear_gain": "value + second_order*(value - origin)^2 + third_order*(value - origin)^3",
    "sensor.absolute_value": "fold + abs(value - fold)",
    "sensor.drift": "value + rate*t",
    "sensor.lag": "memory",
    "plant.slow_mode": "(1 - share)*value + share*memory",
    "plant.resonance": "memory",
}
#: What is added wherever it acts: at a state, a port, an input, or to the reading.
ADDED: Mapping[str, str] = {"environment.measured_input": "gain*(column - reference)"}
#: The same where a parameter of the effect's memory is given; otherwise it has none.
DELAYED: Mapping[str, str] = {"environment.measured_input": "gain*memory"}
#: States that effects bring: name, derivative, and whether it starts at the undisturbed value.
MEMORIES: Mapping[str, Sequence[tuple[str, str]]] = {
    "plant.hysteresis": (("memory", "(V - abs(V)*memory)/width"),),
    "actuator.lag": (("memory", "(value - memory)/time_constant"),),
    "actuator.asymmetric_lag": (
        ("memory", "(value - memory)/if(value > memory, time_constant_up, time_constant_down)"),
    ),
    "actuator.rate_limit": (("memory", "rate*sign(value - memory)"),),
    "sensor.lag": (("memory", "(value - memory)/time_constant"),),
    "environment.measured_input": (("memory", "(column - reference - memory)/time_constant"),),
    "plant.slow_mode": (("memory", "(value - memory)/time_constant"),),
    "plant.resonance": (
        ("memory", "memory_rate"),
        ("memory_rate", "(2*pi*frequency)^2*(value - memory) - 2*damping*(2*pi*frequency)*memory_rate"),
    ),
}
#: Parameters that may be left out, with the value that they then have.
DEFAULTS: Mapping[str, float] = {
    "low": -1e300, "high": 1e300, "second_order": 0.0, "third_order": 0.0, "origin": 0.0, "end": 1e300, "phase": 0.0,
    "zero": 0.0, "surroundings": 293.15, "damping": 0.0, "fold": 0.0, "reference": 0.0,
}  # fmt: skip
#: What a name in the expressions stands for that a model may lack, and how to add it.
WANTED: Mapping[str, tuple[str, str]] = {
    "V": ("speed", 'say of the states what they are: kind = "position", "speed" with of, "level"'),
    "X": ("position", 'say of the states what they are: kind = "position", "speed" with of, "level"'),
    "column": ("column", 'name a column of the recording that is a further [[input]]: column = "NAME"'),
}
#: Effects on the samples of the reading.
AFTER = ("sensor.quantisation",)
#: Effects that lie in the recorded samples or the law alone: a simulation stays as it is.
IDLE = ("sensor.dropout", "sensor.outliers", "timing.jitter", "controller.law")
#: All that a model of equations can be simulated with.
KNOWN = frozenset({*FORCES, *INPUTS, *OUTPUTS, *ADDED, *BEFORE, *AFTER, *IDLE, "timing.dead_time"})

#: Width of belief about an effect's parameter, on a logarithmic scale: it may well be three times as large or small.
EFFECT_SPREAD = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Applied:
    """Effects ready for a simulation.

    Attributes
    ----------
    extensions : tuple of Extension
        For :func:`autotune.equations.simulate.compile_model`.
    delays : (m,) array
        Dead time of each input with that of the effects [s].
    before : callable
        Transforms the drive's samples; apply it to what :func:`drive_of` returns.
    after : callable
        Transforms simulated readings (N,).
    """

    extensions: tuple[Extension, ...]
    delays: FloatArray
    before: Callable[[Drive], Drive]
    after: Callable[[FloatArray], FloatArray]


def apply(model: EquationModel, effects: Sequence[Effect] | None = None) -> Applied:
    """Prepare effects for a simulation.

    Parameters
    ----------
    model : EquationModel
        The model.
    effects : sequence of Effect, optional
        What acts, the model's own effects by default.

    Returns
    -------
    Applied
        What compiles, delays and transforms.

    Raises
    ------
    InputError
        An effect that cannot be simulated, acts nowhere, or lacks a parameter.
    """
    acting = model.effects if effects is None else effects
    extensions = []
    delays = np.array([one.delay_s for one in model.inputs], dtype=np.float64)
    before: list[tuple[int, Effect]] = []
    steps = []
    for number, effect in enumerate(acting):
        if effect.name not in KNOWN:
            raise InputError(
                f"effect {effect.name!r} cannot be simulated in equations", where=model.name,
                remedy=f"use one of {', '.join(sorted(KNOWN))}",
            )  # fmt: skip
        if effect.name == "timing.dead_time":
            delays = delays + np.where(_acts_on(model, effect), _value(effect, "delay", model), 0.0)
        elif effect.name in BEFORE:
            before.append((int(np.argmax(_acts_on(model, effect))), effect))
        elif effect.name in AFTER:
            steps.append(_value(effect, "step", model))
        elif effect.name not in IDLE:
            extensions.append(extension_of(model, effect, number))
    if np.any(delays < 0.0):
        raise InputError("the dead time is negative", where=f"{model.name}: timing.dead_time")

    def on_drive(drive: Drive) -> Drive:
        inputs = drive.inputs.copy()
        for column, effect in before:
            keys, transform = BEFORE[effect.name]
            inputs[:, column] = transform(drive.t, inputs[:, column], *(_value(effect, key, model) for key in keys))
        return replace(drive, inputs=inputs)

    def on_reading(y: FloatArray) -> FloatArray:
        for step in steps:
            y = quantised(y, step)
        return y

    return Applied(extensions=tuple(extensions), delays=delays, before=on_drive, after=on_reading)


def compile_with(model: EquationModel, effects: Sequence[Effect], signals: Sequence[str] = ()) -> Compiled:
    """Translate a model with effects, every number of theirs among its parameters; takes about a millisecond.

    Parameters
    ----------
    model : EquationModel
        The model; its own ``effects`` are not looked at.
    effects : sequence of Effect
        What acts, in the order in which a signal meets it; a converter of the reading is left to :func:`apply`.
    signals : sequence of str
        Expressions that are wanted at the rows beside y.

    Returns
    -------
    Compiled
        With dead times and what happens to held commands: a drive needs no preparation.

    Raises
    ------
    InputError
        As :func:`apply` and :func:`~autotune.equations.simulate.compile_model`.
    """
    held = []
    for number, effect in enumerate(effects):
        late = effect.name == "timing.dead_time"
        if not late and effect.name not in BEFORE:
            continue
        (key,), transform = (("delay",), None) if late else BEFORE[effect.name]
        unit = effect.parameters[key].unit if key in effect.parameters else ""
        parameter = ModelParameter(
            name=f"{effect.name.split('.')[1]}_{number}_{key}", value=_value(effect, key, model), unit=unit,
            spread=EFFECT_SPREAD,
        )  # fmt: skip
        column = int(np.argmax(_acts_on(model, effect)))
        held.append(Held(column=column, parameter=parameter, transform=transform))
    return compile_model(model, apply(model, effects).extensions, signals, held)


def extension_of(model: EquationModel, effect: Effect, number: int = 0) -> Extension:
    """Return an effect in the model's language; its parameters are named ``EFFECT_NUMBER_KEY``.

    Raises
    ------
    InputError
        Nowhere to act, or a parameter that is missing.
    """
    prefix = f"{effect.name.split('.')[1]}_{number}_"
    text = text_of(effect)
    local = _local(model, effect)
    parameters: dict[str, ModelParameter] = {}

    def bound(text: str) -> Expression:
        def replaced(name: str) -> Expression | None:
            if name in local:
                tree = local[name]
                if tree is None:
                    raise InputError(f"{effect.name} needs a {WANTED[name][0]}", where=model.name,
                                     remedy=WANTED[name][1])  # fmt: skip
                return tree
            if name in ("value", "t", "pi"):
                return None
            if name.startswith("memory"):
                return Name(prefix + name)
            parameters[name] = ModelParameter(
                name=prefix + name,
                value=_value(effect, name, model),
                unit=effect.parameters[name].unit if name in effect.parameters else "",
                spread=EFFECT_SPREAD if name in effect.parameters else 0.0,
            )
            return Name(prefix + name)

        return substituted(parse(text, effect.name), replaced)

    tree = bound(text)
    states = tuple(
        State(name=prefix + name, derivative=bound(slope)) for name, slope in MEMORIES.get(effect.name, ())
        if effect.name not in ADDED or text == DELAYED[effect.name]
    )  # fmt: skip
    made = Extension(name=effect.name, states=states, parameters=tuple(parameters.values()))
    if effect.name in ADDED and not (effect.state or effect.port):
        whole = Call("+", (Name("value"), tree))
        return replace(made, input={effect.input: whole}) if effect.input else replace(made, output=whole)
    if effect.name in OUTPUTS:
        return replace(made, output=tree)
    if effect.name in INPUTS:
        return replace(made, input={effect.input or model.columns[0]: tree})
    if effect.port:
        return replace(made, port={effect.port: tree})
    if not effect.state:
        raise InputError(f"{effect.name} does not say where it acts", where=model.name,
                         remedy='add state = "NAME" or port = "NAME"')  # fmt: skip
    return replace(made, derivative={effect.state: tree})


def text_of(effect: Effect) -> str:
    """Return what an effect does, as text; a lag of what is added is left out where its parameters are."""
    if effect.name in ADDED:
        return (DELAYED if "time_constant" in effect.parameters else ADDED)[effect.name]
    return {**FORCES, **INPUTS, **OUTPUTS}[effect.name]


def _local(model: EquationModel, effect: Effect) -> dict[str, Expression | None]:
    """Return what names in an effect's text stand for that are no parameters of it; nothing for what is not there."""
    V, X = _speed_and_position(model, effect)
    return {"V": V, "X": X, "column": Name(effect.column) if effect.column in model.columns else None}


def _speed_and_position(model: EquationModel, effect: Effect) -> tuple[Expression | None, Expression | None]:
    """Return what an effect at a state or a port goes with: its speed (or difference), its position or level."""
    if effect.port:
        port = next((one for one in model.ports if one.name == effect.port), None)
        if port is None:
            raise InputError(f"no port {effect.port!r}", where=model.name, remedy="declare it with [[port]]")
        across = port.across
        position = position_under(model, across) if across is not None else None
        return across, position if position is not None else across
    name = effect.state or next((s.name for s in model.states if s.kind in ("position", "level", "temperature")), "")
    state = next((one for one in model.states if one.name == name), None)
    if state is None:
        if effect.state:
            raise InputError(f"no state {effect.state!r}", where=model.name, remedy="name a state of the model")
        return None, None
    return Name(name), Name(state.of) if state.of else Name(name)


def position_under(model: EquationModel, across: Expression) -> Expression | None:
    """Return the difference of positions whose speeds a port lies across, where every name in it is a speed."""
    of = {one.name: one.of for one in model.states if one.of}
    known = {one.name for one in model.states}
    lost: list[str] = []

    def position(name: str) -> Expression | None:
        if name in of:
            return Name(of[name])
        if name in known:
            lost.append(name)
        return None

    tree = substituted(across, position)
    return None if lost or tree == across else tree


def _acts_on(model: EquationModel, effect: Effect) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    column = effect.input or model.columns[0]
    if column not in model.columns:
        raise InputError(f"no input {column!r}", where=f"{model.name}: {effect.name}", remedy="name an input")
    return np.array([one == column for one in model.columns])


def _value(effect: Effect, key: str, model: EquationModel) -> float:
    if key in effect.parameters:
        return effect.parameters[key].value
    if key in DEFAULTS:
        return DEFAULTS[key]
    raise InputError(f"{effect.name} lacks {key}", where=model.name, remedy=f"add {key} to its parameters")


def with_values(effects: Sequence[Effect], values: Mapping[str, tuple[float, float]]) -> tuple[Effect, ...]:
    """Return effects with fitted values: ``values`` maps ``EFFECT_NUMBER_KEY`` to (value, standard deviation)."""
    found = []
    for number, effect in enumerate(effects):
        prefix = f"{effect.name.split('.')[1]}_{number}_"
        parameters = {}
        for key, old in effect.parameters.items():
            value, sd = values.get(prefix + key, (old.value, old.sd))
            parameters[key] = Parameter(value=value, unit=old.unit, sd=sd)
        found.append(replace(effect, parameters=parameters))
    return tuple(found)


def where_told(effect: Effect) -> str:
    """Return where an effect acts, for a reader."""
    place = effect.state or effect.port or effect.input or "the reading"
    return f"{place} from column {effect.column}" if effect.column else place


def equation_of(model: EquationModel, effect: Effect) -> str:
    """Return an effect's equation for a reader, with the names of its states and parameters."""
    if effect.name == "timing.dead_time":
        return f"{effect.input or model.columns[0]}(t - delay)"
    if effect.name not in {*FORCES, *INPUTS, *OUTPUTS, *ADDED}:
        return ""
    tree = substituted(parse(text_of(effect)), _local(model, effect).get)
    column = effect.input or model.columns[0]
    if effect.name in ADDED and not (effect.state or effect.port):
        return f"{effect.input or 'y'} -> {effect.input or 'y'} + {to_text(tree)}"
    if effect.name in INPUTS:
        text = to_text(substituted(tree, lambda name: Name(column) if name == "value" else None))
        return f"{column} -> {text}"
    if effect.name in OUTPUTS:
        return f"y -> {to_text(substituted(tree, lambda name: Name('y') if name == 'value' else None))}"
    return f"{effect.port} = {to_text(tree)}" if effect.port else f"d {effect.state}/dt: + {to_text(tree)}"
