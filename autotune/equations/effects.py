"""Effects of the catalogue in models of equations, as their records state them (:mod:`autotune.effects`).

Where it acts is said by the effect itself: ``state`` (added to its derivative, in the derivative's unit, and to those
of other states as they share a force of the model there, see :mod:`autotune.equations.shared_forces`), ``port`` (a
force, torque, flow or heat of the port's unit), ``input`` (a column), or nothing for the output and the first input. In
the expressions below ``V`` is the speed (``across`` of the port, or the state), ``X`` the position, level or
temperature that goes with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.effects import KINDS
from autotune.effects.in_equations import InEquations
from autotune.equations.expressions import Call, Expression, Name, parse, substitute, to_text
from autotune.equations.model import EquationModel, Extension, ModelParameter, State
from autotune.equations.samples import OPERATIONS, quantise
from autotune.equations.shared_forces import joint_at
from autotune.equations.simulate import Compiled, Drive, Held, compile_model
from autotune.errors import InputError
from autotune.models import Effect, Parameter

#: What a name in the expressions stands for that a model may lack, and how to add it.
WANTED: Mapping[str, tuple[str, str]] = {
    "V": ("speed", 'say of the states what they are: kind = "position", "speed" with of, "level"'),
    "X": ("position", 'say of the states what they are: kind = "position", "speed" with of, "level"'),
    "column": ("column", 'name a column of the recording that is a further [[input]]: column = "NAME"'),
}
#: A number that nothing reaches, in place of one that expressions cannot hold.
FARTHEST = 1e300

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
        match form_of(effect, model).acts:
            case "delay":
                delays = delays + np.where(_acts_on(model, effect), _value(effect, _key(effect), model), 0.0)
            case "held":
                before.append((int(np.argmax(_acts_on(model, effect))), effect))
            case "converter":
                steps.append(_value(effect, _key(effect), model))
            case "nothing":
                pass
            case _:
                extensions.append(_extension_of(model, effect, number))
    if np.any(delays < 0.0):
        raise InputError("the dead time is negative", where=model.name, remedy="check inputs and effects")

    def on_drive(drive: Drive) -> Drive:
        inputs = drive.inputs.copy()
        for column, effect in before:
            transform = OPERATIONS[form_of(effect, model).samples]
            inputs[:, column] = transform(drive.t, inputs[:, column], _value(effect, _key(effect), model))
        return replace(drive, inputs=inputs)

    def on_reading(y: FloatArray) -> FloatArray:
        for step in steps:
            y = quantise(y, step)
        return y

    return Applied(extensions=tuple(extensions), delays=delays, before=on_drive, after=on_reading)


def compile_with(
    model: EquationModel, effects: Sequence[Effect], signals: Sequence[str] = (), further: Sequence[Extension] = ()
) -> Compiled:
    """Translate a model with effects, every number of theirs among its parameters; takes about a millisecond.

    Parameters
    ----------
    model : EquationModel
        The model; its own ``effects`` are not looked at.
    effects : sequence of Effect
        What acts, in the order in which a signal meets it; a converter of the reading is left to :func:`apply`.
    signals : sequence of str
        Expressions that are wanted at the rows beside y.
    further : sequence of Extension
        What is added beside the effects.

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
        form = form_of(effect, model)
        if form.acts not in ("held", "delay"):
            continue
        key = _key(effect)
        unit = effect.parameters[key].unit if key in effect.parameters else ""
        parameter = ModelParameter(
            name=prefix_of(effect, number) + key, value=_value(effect, key, model), unit=unit, spread=EFFECT_SPREAD
        )
        column = int(np.argmax(_acts_on(model, effect)))
        held.append(Held(column=column, parameter=parameter, transform=OPERATIONS.get(form.samples)))
    return compile_model(model, (*apply(model, effects).extensions, *further), signals, held)


def _extension_of(model: EquationModel, effect: Effect, number: int = 0) -> Extension:
    """Return an effect in the model's language; its parameters are named ``EFFECT_NUMBER_KEY``.

    Raises
    ------
    InputError
        Nowhere to act, or a parameter that is missing.
    """
    form, prefix = form_of(effect, model), prefix_of(effect, number)
    text = text_of(form, effect)
    local = local_names(model, effect)
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

        return substitute(parse(text, effect.name), replaced)

    tree = bound(text)
    memory = form.memory if form.remembers(effect.parameters) else ()
    states = tuple(State(name=prefix + name, derivative=bound(slope)) for name, slope in memory)
    made = Extension(name=effect.name, states=states, parameters=tuple(parameters.values()))
    if form.acts == "anywhere" and not (effect.state or effect.port):
        whole = Call("+", (Name("value"), tree))
        return replace(made, input={effect.input: whole}) if effect.input else replace(made, output=whole)
    if form.acts == "reading":
        return replace(made, output=tree)
    if form.acts == "input":
        return replace(made, input={effect.input or model.columns[0]: tree})
    if effect.port:
        return replace(made, port={effect.port: tree})
    if not effect.state:
        raise InputError(f"{effect.name} does not say where it acts", where=model.name,
                         remedy='add state = "NAME" or port = "NAME"')  # fmt: skip
    return replace(made, derivative=at_state(model, effect.state, tree))


def at_state(model: EquationModel, state: str, tree: Expression) -> dict[str, Expression]:
    """Return what a force on a state adds to derivatives: to its own, and to those that share the model's force there.

    Parameters
    ----------
    model : EquationModel
        The model.
    state : str
        Where the force acts.
    tree : Expression
        What it adds to that state's derivative.
    """
    shares = joint_at(model, state).shares
    return {state: tree, **{name: Call("*", (tree, share)) for name, share in shares.items()}}


def form_of(effect: Effect, model: EquationModel) -> InEquations:
    """Return how an effect acts in a model of equations.

    Parameters
    ----------
    effect : Effect
        Of a model or a hypothesis.
    model : EquationModel
        Names itself in the refusal.

    Raises
    ------
    InputError
        An effect that does not act there.
    """
    form = KINDS[effect.name].in_equations if effect.name in KINDS else None
    if form is None:
        there = (name for name, kind in KINDS.items() if kind.in_equations is not None)
        raise InputError(
            f"effect {effect.name!r} cannot be simulated in equations", where=model.name,
            remedy=f"use one of {', '.join(sorted(there))}",
        )  # fmt: skip
    return form


def at_reading(model: EquationModel, effects: Sequence[Effect]) -> list[Effect]:
    """Return those of the effects that act on the reading.

    Parameters
    ----------
    model : EquationModel
        Names itself in refusals.
    effects : sequence of Effect
        Those to choose from.
    """
    acts = ((e, form_of(e, model).acts) for e in effects)
    return [e for e, how in acts if how == "reading" or (how == "anywhere" and not where_of(e))]


def where_of(effect: Effect) -> str:
    """Return the state, port or input that an effect acts on; nothing for the reading."""
    return effect.state or effect.port or effect.input


def prefix_of(effect: Effect, number: int) -> str:
    """Return what the names of an effect's parameters and states begin with.

    Parameters
    ----------
    effect : Effect
        PLACE.EFFECT.
    number : int
        Its place among the model's effects.
    """
    return f"{effect.name.split('.')[1]}_{number}_"


def _key(effect: Effect) -> str:
    """Return the one number of an effect on samples or of a dead time."""
    return KINDS[effect.name].parameters[0].name


def text_of(form: InEquations, effect: Effect) -> str:
    """Return what an effect adds, or puts in the place of ``value``, with the numbers that it has.

    Parameters
    ----------
    form : InEquations
        How the effect acts.
    effect : Effect
        With its parameters.
    """
    return form.text if not form.at_once or form.remembers(effect.parameters) else form.at_once


def local_names(model: EquationModel, effect: Effect) -> dict[str, Expression | None]:
    """Return what names in an effect's text stand for that are no parameters of it; nothing for what is not there.

    Parameters
    ----------
    model : EquationModel
        Where it acts.
    effect : Effect
        Says at which state, port or column.
    """
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
    joint = joint_at(model, name)
    return joint.speed, joint.position


def position_under(model: EquationModel, across: Expression) -> Expression | None:
    """Return the difference of positions whose speeds a port lies across, where every name in it is a speed.

    Parameters
    ----------
    model : EquationModel
        Says of which position a speed is the derivative.
    across : Expression
        The difference of speeds.
    """
    of = {one.name: one.of for one in model.states if one.of}
    known = {one.name for one in model.states}
    lost: list[str] = []

    def position(name: str) -> Expression | None:
        if name in of:
            return Name(of[name])
        if name in known:
            lost.append(name)
        return None

    tree = substitute(across, position)
    return None if lost or tree == across else tree


def _acts_on(model: EquationModel, effect: Effect) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    column = effect.input or model.columns[0]
    if column not in model.columns:
        raise InputError(f"no input {column!r}", where=f"{model.name}: {effect.name}", remedy="name an input")
    return np.array([one == column for one in model.columns])


def _value(effect: Effect, key: str, model: EquationModel) -> float:
    if key in effect.parameters:
        return effect.parameters[key].value
    quantity, neutral = KINDS[effect.name].quantity(key), form_of(effect, model).defaults.get(key)
    if neutral is None and quantity is not None:
        neutral = quantity.neutral
    if neutral is None:
        raise InputError(f"{effect.name} lacks {key}", where=model.name, remedy=f"add {key} to its parameters")
    return min(max(neutral, -FARTHEST), FARTHEST)


def with_values(effects: Sequence[Effect], values: Mapping[str, tuple[float, float]]) -> tuple[Effect, ...]:
    """Return effects with fitted values.

    Parameters
    ----------
    effects : sequence of Effect
        In the model's order.
    values : mapping of str to (float, float)
        Value and standard deviation by ``EFFECT_NUMBER_KEY``, in the parameter's unit.
    """
    found = []
    for number, effect in enumerate(effects):
        prefix, parameters = prefix_of(effect, number), {}
        for key, old in effect.parameters.items():
            value, sd = values.get(prefix + key, (old.value, old.sd))
            parameters[key] = Parameter(value=value, unit=old.unit, sd=sd)
        found.append(replace(effect, parameters=parameters))
    return tuple(found)


def where_told(effect: Effect) -> str:
    """Return where an effect acts, for a reader."""
    place = where_of(effect) or "the reading"
    return f"{place} from column {effect.column}" if effect.column else place


def equation_of(model: EquationModel, effect: Effect) -> str:
    """Return an effect's equation for a reader, with the names of its states and parameters.

    Parameters
    ----------
    model : EquationModel
        Where it acts.
    effect : Effect
        Of the catalogue.
    """
    form, column = form_of(effect, model), effect.input or model.columns[0]
    if form.acts == "delay":
        return f"{column}(t - {_key(effect)})"
    if not form.text:
        return ""
    tree = substitute(parse(text_of(form, effect)), local_names(model, effect).get)
    if form.acts == "anywhere" and not (effect.state or effect.port):
        return f"{effect.input or 'y'} -> {effect.input or 'y'} + {to_text(tree)}"
    if form.acts in ("input", "reading"):
        signal = column if form.acts == "input" else "y"
        return f"{signal} -> {to_text(substitute(tree, lambda name: Name(signal) if name == 'value' else None))}"
    if effect.port:
        return f"{effect.port} = {to_text(tree)}"
    shares = joint_at(model, effect.state).shares.items()
    also = "".join(f"; d {name}/dt: that times {to_text(share)}" for name, share in shares)
    added = to_text(tree)
    return f"d {effect.state}/dt: {f'- {added[1:]}' if added.startswith('-') else f'+ {added}'}{also}"
