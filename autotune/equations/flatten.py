"""Equations with everything that was added to them written out: what leaves the project carries no extensions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from autotune.equations.effects import apply, form_of
from autotune.equations.expressions import Call, Expression, Name, Number, substitute
from autotune.equations.model import EquationModel
from autotune.errors import InputError


def flatten(model: EquationModel) -> EquationModel:
    """Return a model whose effects, offsets and ports have become part of its equations.

    Parameters
    ----------
    model : EquationModel
        With effects.

    Returns
    -------
    EquationModel
        Without effects, ports and offsets; dead times are left at the inputs.

    Raises
    ------
    InputError
        An effect on samples (play, a converter's steps), which no differential equation says.
    """
    for effect in model.effects:
        if form_of(effect, model).acts in ("held", "converter"):
            raise InputError(
                f"{effect.name} acts on samples and is no differential equation", where=model.name,
                remedy="take it out of the file for the export",
            )  # fmt: skip
    acting = [effect for effect in model.effects if form_of(effect, model).acts != "nothing"]
    applied = apply(model, acting)
    now: dict[str, Expression] = {
        one.column: Call("-", (Name(one.column), Number(one.offset))) if one.offset else Name(one.column)
        for one in model.inputs
    }
    ports: dict[str, Expression] = {port.name: Number(0.0) for port in model.ports}
    slopes = {state.name: state.derivative for state in model.states}
    states, parameters, defines = list(model.states), list(model.parameters), list(model.defines)
    output = model.output
    memories: dict[str, Expression] = {}
    for extension in applied.extensions:
        before = now[next(iter(extension.input))] if extension.input else output
        value = _replacing({"value": before})
        for state in extension.states:
            memories[state.name] = substitute(state.derivative, value)
            states.append(state)
        parameters += extension.parameters
        for column, tree in extension.input.items():
            now[column] = substitute(tree, value)
        if extension.output is not None:
            output = substitute(extension.output, value)
        for port, tree in extension.port.items():
            ports[port] = tree if ports[port] == Number(0.0) else Call("+", (ports[port], tree))
        for name, tree in extension.derivative.items():
            slopes[name] = Call("+", (slopes[name], tree))
    # a memory's own value is the column as it comes; everything else sees what arrives
    at_ports, arrives = _replacing(ports), _replacing(now)
    slopes = {name: substitute(substitute(tree, at_ports), arrives) for name, tree in slopes.items()}
    slopes |= {name: substitute(tree, at_ports) for name, tree in memories.items()}
    return replace(
        model,
        inputs=tuple(
            replace(one, offset=0.0, delay_s=float(delay))
            for one, delay in zip(model.inputs, applied.delays, strict=True)
        ),
        states=tuple(replace(state, derivative=slopes[state.name]) for state in states),
        parameters=tuple(parameters),
        defines=tuple((name, substitute(substitute(tree, at_ports), arrives)) for name, tree in defines),
        output=substitute(output, arrives),
        ports=(),
        effects=(),
    )


def _replacing(table: dict[str, Expression]) -> Callable[[str], Expression | None]:
    return table.get
