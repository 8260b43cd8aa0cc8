"""A chain of blocks as equations, with a transfer function per input; and back where a model is such a chain."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

from autotune.equations.expressions import Call, Expression, Name, Number
from autotune.equations.model import EquationModel, InputColumn, ModelParameter, State, StateKind
from autotune.errors import InputError
from autotune.model_tables import model_of, require_keys
from autotune.models import Block, Model, TransferFunction


def from_chain(model: Model) -> EquationModel:
    """Return a chain of blocks as equations.

    Parameters
    ----------
    model : Model
        Blocks in series; its dead times act at the input, which is the same for linear blocks.

    Returns
    -------
    EquationModel
        A state per pole, gains and time constants as parameters. Effects of the chain are not taken along: they
        say where they act in words of a chain.
    """
    return _assemble(model, _Chain(["u"]), [_command(model, "u")])


def chain_with_inputs(content: Mapping[str, Any], where: str) -> EquationModel:
    """Return the equations of a chain whose ``[[input]]`` tables name measured disturbances.

    Parameters
    ----------
    content : mapping
        The file's content: ``[[block]]`` tables, the first ``[[input]]`` the command, each further one with
        ``column, num, den, delay`` and ``acts`` on the plant (before its first block of place plant) or the output.
    where : str
        The file, for messages.

    Raises
    ------
    InputError
        As :func:`autotune.model_tables.read_model`, and an input that does not say what it does.
    """
    inputs = content.get("input")
    if not isinstance(inputs, list) or not inputs or not all(isinstance(one, dict) for one in inputs):
        raise InputError("no [[input]]", where=where, remedy='name the command: [[input]] column = "u"')
    command = {key: value for key, value in inputs[0].items() if key != "column"}
    chain = model_of({**content, "input": command}, where)
    made = _Chain([str(one.get("column", "u")) for one in inputs])
    columns = [_command(chain, str(inputs[0].get("column", "u")))]
    at_plant: list[Expression] = []
    at_output: list[Expression] = []
    for number, table in enumerate(inputs[1:], 2):
        one, path, acts = _disturbance(table, f"{where} [[input]] {number}")
        columns.append(one)
        (at_plant if acts == "plant" else at_output).append(made.block(one.column, path, Name(one.column)))
    return replace(_assemble(chain, made, columns, at_plant, at_output), effects=chain.effects)


def _command(chain: Model, column: str) -> InputColumn:
    return InputColumn(
        column=column, unit=chain.input.unit, hold=chain.input.hold, offset=chain.input.offset,
        delay_s=chain.delay_s,
    )  # fmt: skip


def _assemble(
    chain: Model, made: _Chain, inputs: Sequence[InputColumn], at_plant: Sequence[Expression] = (),
    at_output: Sequence[Expression] = (),
) -> EquationModel:  # fmt: skip
    """Return a chain's equations, with what enters before its first plant block and what is added to its output."""
    signal: Expression = Name(inputs[0].column)
    entered = False
    for block in chain.blocks:
        if block.place == "plant" and not entered:
            entered, signal = True, sum_of([signal, *at_plant])
        signal = made.block(block.name, block.dynamics, signal, kind_of(block), block.unit)
    output = sum_of([signal, *at_output, *([Number(chain.output.offset)] if chain.output.offset else [])])
    return EquationModel(
        name=chain.name, inputs=tuple(inputs), output=output, output_unit=chain.output.unit,
        states=with_speeds(made.states), parameters=tuple(made.parameters),
    )  # fmt: skip


def kind_of(block: Block) -> StateKind:
    """Return what the states of a block are, as far as it says so itself: a speed, or a level where a plant stores."""
    if block.is_speed:
        return "speed"
    return "level" if block.place == "plant" else "other"


def with_speeds(states: Sequence[State]) -> tuple[State, ...]:
    """Return states that say which are positions and which the speeds of them: a position moves by a state alone."""
    names = {one.name for one in states}
    of = {tree.name: one.name for one in states if isinstance(tree := one.derivative, Name) and tree.name in names}
    found = []
    for one in states:
        if one.name in of:
            one = replace(one, kind="speed", of=of[one.name])
        elif one.name in of.values():
            one = replace(one, kind="position")
        found.append(one)
    return tuple(found)


def _disturbance(table: Mapping[str, Any], where: str) -> tuple[InputColumn, TransferFunction, str]:
    require_keys(table, {"column", "num", "den", "delay", "acts", "unit", "hold", "offset"}, where)
    if not isinstance(table.get("column"), str):
        raise InputError("column is missing", where=where, remedy='add column = "NAME" of the recording')
    acts = table.get("acts", "plant")
    if acts not in ("plant", "output"):
        raise InputError(f"acts = {acts!r}", where=where, remedy='write "plant" or "output"')
    path = TransferFunction(
        num=tuple(table.get("num", [1.0])), den=tuple(table.get("den", [1.0])), delay_s=float(table.get("delay", 0.0))
    )
    if not path.is_proper:
        raise InputError("num has a higher degree than den", where=where, remedy="a transfer function must be proper")
    column = InputColumn(
        column=table["column"], unit=str(table.get("unit", "")), hold=table.get("hold", "zero"),
        delay_s=path.delay_s, offset=float(table.get("offset", 0.0)),
    )  # fmt: skip
    return column, replace(path, delay_s=0.0), acts


def sum_of(parts: Sequence[Expression]) -> Expression:
    """Return the sum of expressions, 0 of none."""
    return reduce(lambda a, b: Call("+", (a, b)), parts) if parts else Number(0.0)


class _Chain:
    """States and parameters of blocks, one after the other."""

    def __init__(self, columns: Sequence[str]) -> None:
        self.states: list[State] = []
        self.parameters: list[ModelParameter] = []
        self._names = {"t", "pi", *columns}

    def block(
        self, name: str, dynamics: TransferFunction, signal: Expression, kind: StateKind = "other", unit: str = ""
    ) -> Expression:
        """Add a block that is driven by a signal, in controllable form, and return its output.

        Where a state is the output itself it has the output's unit.
        """
        label = self._label(name)
        lead = dynamics.den[0]
        den = [value / lead for value in dynamics.den[1:]]
        num = [value / lead for value in dynamics.num]
        order = len(den)
        num = [0.0] * (order + 1 - len(num)) + num
        if order == 1 and num[0] == 0.0 and den[0] != 0.0:
            return self._lag(
                label, num[1] / den[0], 1.0 / den[0], signal, State(name=label, derivative=signal, kind=kind, unit=unit)
            )
        a = [self._number(f"{label}_a{order - 1 - i}", value, keep=(0.0,)) for i, value in enumerate(den)]
        b = [self._number(f"{label}_b{order - i}", value) for i, value in enumerate(num)]
        x = [f"{label}_{i + 1}" if order > 1 else label for i in range(order)]
        unit = unit if order == 1 and num == [0.0, 1.0] else ""
        feed = signal
        for i, coefficient in enumerate(a):  # highest derivative = signal - a_(n-1) x_n - ... - a_0 x_1
            feed = _minus(feed, _times(coefficient, Name(x[order - 1 - i])))
        for i in range(order):
            self.states.append(
                State(name=x[i], derivative=Name(x[i + 1]) if i + 1 < order else feed, kind=kind, unit=unit)
            )
        parts = [_times(b[order - i], Name(x[i])) for i in range(order)]
        if num[0] != 0.0:  # direct: the highest derivative itself
            parts.append(_times(b[0], feed))
        used = [part for part in parts if part != Number(0.0)]
        return sum_of(used)

    def _lag(self, label: str, gain: float, time_constant: float, signal: Expression, state: State) -> Expression:
        K, T = self._number(f"{label}_K", gain), self._number(f"{label}_T", time_constant, keep=())
        slope = Call("/", (Call("-", (_times(K, signal), Name(label))), T))
        self.states.append(replace(state, derivative=slope))
        return Name(label)

    def _number(self, name: str, value: float, keep: Sequence[float] = (0.0, 1.0)) -> Expression:
        """Return a parameter; 0 and a gain of 1 are structure, a time constant of 1 s is a number like any other."""
        if value in keep:
            return Number(value)
        self.parameters.append(ModelParameter(name=name, value=value))
        return Name(name)

    def _label(self, name: str) -> str:
        label = re.sub(r"\W+", "_", name.strip()).strip("_") or "block"
        label = label if label[0].isalpha() else f"block_{label}"
        unique, k = f"{label}_state" if label in self._names else label, 2
        while unique in self._names:
            unique, k = f"{label}_{k}", k + 1
        self._names.add(unique)
        return unique


def _times(a: Expression, b: Expression) -> Expression:
    if Number(0.0) in (a, b):
        return Number(0.0)
    if a == Number(1.0):
        return b
    return a if b == Number(1.0) else Call("*", (a, b))


def _minus(a: Expression, b: Expression) -> Expression:
    return a if b == Number(0.0) else Call("-", (a, b))
