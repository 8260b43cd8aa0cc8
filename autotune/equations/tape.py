"""From a model to a tape: a list of elementary operations on numbered registers, run by one compiled kernel.

The kernel is compiled once per installation and not per model, so that a model (or a model with one more effect in
it) is ready within a millisecond. Common subexpressions are computed once; what depends on parameters alone, once
per simulation.

Switched terms (``if sign abs min max``) become a choice between two registers. Where the condition depends on states
or time the choice is a *mode* that the integrator holds fixed within a step and changes at the located crossing;
else it is decided at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.equations import opcodes as op
from autotune.equations.expressions import Call, Expression, Name, Number, parse, substitute
from autotune.equations.model import EquationModel, Extension
from autotune.equations.work import Tape
from autotune.errors import InputError

#: What an operation waits for: nothing but parameters, held inputs too, states or time or inputs that run.
_STILL, _HELD, _MOVING = 0, 1, 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Program:
    """A model translated for the kernel.

    Attributes
    ----------
    code : (K, 5) int array
        Operation, target register, and three operands; in the order in which they are run.
    still, dynamic : int
        Operations before ``still`` depend on parameters alone; those before ``dynamic`` are all that derivatives and
        switches need, the rest serves outputs.
    registers : (R,) array
        Template of the registers: constants are in it.
    states, inputs, parameters : tuple of str
        Names, in the order of their registers: time is register 0, then states, inputs, parameters.
    slopes, outputs : (n,), (q,) int array
        Registers of the derivatives and of the outputs.
    switches, modes, ties : (s,) int arrays
        Registers of the switching functions and of their modes, and the mode where one stays at zero.
    linear : (m,) int array
        1 where the input runs straight between rows.
    speeds : (S, 5) int array
        The operations that switching functions depend on, which tell how fast these run.
    """

    code: IntArray
    still: int
    dynamic: int
    registers: FloatArray
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: tuple[str, ...]
    slopes: IntArray
    outputs: IntArray
    switches: IntArray
    modes: IntArray
    ties: IntArray
    linear: IntArray
    speeds: IntArray

    def tape(self, native: int = 0) -> Tape:
        """Return the arrays that the kernel takes; ``native`` is the address of the derivatives' machine code."""
        return Tape(
            self.code, self.still, self.dynamic, self.slopes, self.outputs, self.switches, self.modes, self.ties,
            self.linear, self.speeds, self.slopes.size, native,
        )  # fmt: skip


def translate(model: EquationModel, extensions: Sequence[Extension] = (), signals: Sequence[str] = ()) -> Program:
    """Translate a model with its extensions.

    Parameters
    ----------
    model : EquationModel
        What to translate; its ``effects`` are not looked at, give them as extensions.
    extensions : sequence of Extension
        What is added, in the order in which a signal meets it: the first is nearest to the column, or to the output.
    signals : sequence of str
        Further outputs, as expressions of states, inputs, parameters, ports, defines and ``output``.

    Returns
    -------
    Program
        States, parameters of the model first, then those of the extensions in order; outputs: y, then the signals.

    Raises
    ------
    InputError
        An extension that acts where the model has nothing, or uses a name that is not known.
    """
    return _Translation(model, extensions).program(signals)


@dataclass(kw_only=True)
class _Tape:
    """Operations that were written so far; equal ones share a register."""

    registers: list[float] = field(default_factory=list)
    waits: list[int] = field(default_factory=list)
    constants: dict[float, int] = field(default_factory=dict)
    known: dict[tuple[int, ...], int] = field(default_factory=dict)
    code: list[tuple[int, int, int, int, int]] = field(default_factory=list)
    switches: list[int] = field(default_factory=list)
    ties: list[int] = field(default_factory=list)
    modes: list[int] = field(default_factory=list)

    def register(self, value: float, waits: int) -> int:
        self.registers.append(value)
        self.waits.append(waits)
        return len(self.registers) - 1

    def constant(self, value: float) -> int:
        key = math.copysign(1.0, value) * math.inf if math.isinf(value) else value
        if key not in self.constants:
            self.constants[key] = self.register(value, _STILL)
        return self.constants[key]

    def write(self, operation: int, a: int, b: int = 0, c: int = 0) -> int:
        if operation in (op.ADD, op.MUL) and b < a:
            a, b = b, a
        key = (operation, a, b, c)
        if key not in self.known:
            three, one = operation in (op.SELECT, op.CHOOSE), operation in (*op.UNARY.values(), op.SQUARE)
            operands = (a, b, c)[: 3 if three else 1 if one else 2]
            waits = max(self.waits[each] for each in operands)
            if operation == op.SELECT:
                waits = _MOVING
            self.known[key] = self.register(0.0, waits)
            self.code.append((operation, self.known[key], a, b, c))
        return self.known[key]

    def switch(self, g: int, tie: int) -> int:
        """Return the register of the mode of a located switch on register g."""
        for one, same, mode in zip(self.switches, self.ties, self.modes, strict=True):
            if one == g and same == tie:
                return mode
        self.switches.append(g)
        self.ties.append(tie)
        self.modes.append(self.register(0.0, _MOVING))
        return self.modes[-1]


class _Translation:
    """One model on its way to a tape."""

    def __init__(self, model: EquationModel, extensions: Sequence[Extension]) -> None:
        self._model, self._extensions = model, extensions
        self._tape = _Tape()
        self._states = [*model.states, *(s for e in extensions for s in e.states)]
        parameters = [*model.parameters, *(p for e in extensions for p in e.parameters)]
        self._parameters = tuple(p.name for p in parameters)
        names = [*(s.name for s in self._states), *model.columns, *self._parameters]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"an extension brings {twice[0]!r} a second time", where=model.name)
        linear = {one.column: one.hold == "linear" for one in model.inputs}
        self._registers = {"t": self._tape.register(0.0, _MOVING)}
        for name in names:
            held = (_MOVING if linear[name] else _HELD) if name in linear else _MOVING
            self._registers[name] = self._tape.register(0.0, _STILL if name in self._parameters else held)
        self._slopes = {state.name: state.derivative for state in model.states}
        self._reading: Expression = model.output
        self._trees = self._definitions()
        self._done: dict[tuple[Expression, bool], int] = {}
        self._open: set[str] = set()
        self._locates = True

    def _definitions(self) -> dict[str, Expression]:
        """Return what stands for a name: defines, ports with what acts there, inputs and output as extended."""
        model = self._model
        trees: dict[str, Expression] = {"pi": Number(math.pi), **dict(model.defines), "output": model.output}
        trees |= {port.name: Number(0.0) for port in model.ports}
        now: dict[str, Expression] = {one.column: Name(f"column:{one.column}") for one in model.inputs}
        now["output"] = Name("output")
        for one in model.inputs:
            raw: Expression = Name(f"raw:{one.column}")
            trees[f"column:{one.column}"] = Call("-", (raw, Number(one.offset))) if one.offset else raw
            self._registers[f"raw:{one.column}"] = self._registers.pop(one.column)
        for number, extension in enumerate(self._extensions):
            changed = dict(extension.input) | ({} if extension.output is None else {"output": extension.output})
            for place in changed:
                if place not in now:
                    raise InputError(f"no input {place!r}", where=extension.name, remedy="name an input of the model")
            before = now[next(iter(changed))] if len(changed) == 1 else None
            self._slopes |= {one.name: _insert_value(one.derivative, before) for one in extension.states}
            for place, tree in changed.items():
                trees[f"{place}|{number}"] = _insert_value(tree, now[place])
                now[place] = Name(f"{place}|{number}")
            for port, tree in extension.port.items():
                if port not in trees:
                    raise InputError(f"no port {port!r}", where=extension.name, remedy="declare it with [[port]]")
                trees[port] = Call("+", (trees[port], tree))
        self._reading = now.pop("output")
        return trees | now

    def _extended_slopes(self) -> dict[str, Expression]:
        """Return the derivatives with what extensions add to them."""
        slopes = dict(self._slopes)
        for extension in self._extensions:
            for name, tree in extension.derivative.items():
                if name not in slopes:
                    raise InputError(f"no state {name!r}", where=extension.name, remedy="name a state of the model")
                slopes[name] = Call("+", (slopes[name], tree))
        return slopes

    def program(self, signals: Sequence[str]) -> Program:
        """Return the tape of everything."""
        slopes = [self._of(tree) for tree in self._extended_slopes().values()]
        needed = len(self._tape.code)
        self._locates = False  # what only outputs need is decided at once
        outputs = [self._of(self._reading), *(self._of(parse(text, "signal")) for text in signals)]
        return self._program(slopes, outputs, needed)

    def _program(self, slopes: Sequence[int], outputs: Sequence[int], needed: int) -> Program:
        tape = self._tape
        still = [row for row in tape.code if tape.waits[row[1]] == _STILL]
        dynamic = [row for row in tape.code[:needed] if tape.waits[row[1]] != _STILL]
        rest = [row for row in tape.code[needed:] if tape.waits[row[1]] != _STILL]
        code = np.array([*still, *dynamic, *rest], dtype=np.int64).reshape(-1, 5)
        return Program(
            code=code,
            still=len(still),
            dynamic=len(still) + len(dynamic),
            registers=np.array(tape.registers, dtype=np.float64),
            states=tuple(state.name for state in self._states),
            inputs=self._model.columns,
            parameters=self._parameters,
            slopes=np.array(slopes, dtype=np.int64),
            outputs=np.array(outputs, dtype=np.int64),
            switches=np.array(tape.switches, dtype=np.int64),
            modes=np.array(tape.modes, dtype=np.int64),
            ties=np.array(tape.ties, dtype=np.int64),
            linear=np.array([one.hold == "linear" for one in self._model.inputs], dtype=np.int64),
            speeds=_needed_operations(dynamic, tape.switches),
        )

    def _of(self, tree: Expression) -> int:
        """Return the register that holds an expression."""
        if isinstance(tree, Name) and tree.name in self._open:
            raise InputError(f"algebraic loop through {tree.name!r}", where=self._model.name)
        key = (tree, True)  # an output takes over what the derivatives located
        if not self._locates and key not in self._done:
            key = (tree, False)
        if key not in self._done:
            match tree:
                case Number(value):
                    register = self._tape.constant(value)
                case Name(name) if name in self._registers:
                    register = self._registers[name]
                case Name(name):
                    self._open.add(name)
                    register = self._of(self._tree(name))
                    self._open.discard(name)
                case Call(function, arguments):
                    register = self._operation(function, arguments)
            self._done[key] = register
        return self._done[key]

    def _tree(self, name: str) -> Expression:
        if name not in self._trees:
            raise InputError(
                f"unknown name {name!r}", where=self._model.name, remedy="a signal or an extension uses it"
            )
        return self._trees[name]

    def _operation(self, function: str, arguments: tuple[Expression, ...]) -> int:
        tape = self._tape
        if function == "if":
            condition, then, otherwise = arguments
            assert isinstance(condition, Call)
            left, right = (self._of(one) for one in condition.arguments)
            tie = 1 if condition.function in ("<=", ">=") else -1
            g = tape.write(op.SUB, *((right, left) if condition.function in ("<", "<=") else (left, right)))
            return self._choice(g, tie, self._of(then), self._of(otherwise))
        if function in ("min", "max"):
            best = self._of(arguments[0])
            for one in arguments[1:]:
                other = self._of(one)
                g = tape.write(op.SUB, best, other)
                best = self._choice(g, 1, best, other) if function == "max" else self._choice(g, 1, other, best)
            return best
        a = self._of(arguments[0])
        if function == "abs":
            return self._choice(a, 1, a, tape.write(op.NEG, a))
        if function == "sign":
            return self._choice(a, 0, tape.constant(1.0), tape.constant(-1.0))
        if function in op.UNARY:
            return self._fold(op.UNARY[function], a)
        if function == "^" and arguments[1] == Number(2.0):
            return self._fold(op.SQUARE, a)
        return self._fold(op.BINARY[function], a, self._of(arguments[1]))

    def _fold(self, operation: int, a: int, b: int = 0) -> int:
        """Write an operation, leaving out what a constant 0 or 1 makes idle."""
        zero, one = self._tape.constants.get(0.0, -1), self._tape.constants.get(1.0, -1)
        if operation == op.ADD and zero in (a, b):
            return b if a == zero else a
        if operation == op.SUB and b == zero and b >= 0:
            return a
        if operation == op.MUL and one in (a, b):
            return b if a == one else a
        return self._tape.write(operation, a, b)

    def _choice(self, g: int, tie: int, above: int, below: int) -> int:
        """Return the register of a choice by the sign of g; tie says which side zero belongs to."""
        tape = self._tape
        if self._locates and tape.waits[g] == _MOVING:
            return tape.write(op.SELECT, above, below, tape.switch(g, tie))
        register = tape.write(op.CHOOSE, above, below, g)
        if tie == 1:
            return register
        # zero belongs below (a > b), or half way (sign): written as a choice of the opposite sign
        mirrored = tape.write(op.CHOOSE, below, above, tape.write(op.NEG, g))
        if tie == -1:
            return mirrored
        return tape.write(op.MUL, tape.constant(0.5), tape.write(op.ADD, register, mirrored))


def _needed_operations(code: Sequence[tuple[int, ...]], registers: Sequence[int]) -> IntArray:
    """Return the operations that registers depend on, in their order."""
    wanted, found = set(registers), []
    for row in reversed(code):
        if row[1] in wanted:
            wanted.update(row[2:])
            found.append(row)
    return np.array(found[::-1], dtype=np.int64).reshape(-1, 5)


def _insert_value(tree: Expression, value: Expression | None) -> Expression:
    """Return an expression of an extension, ``value`` replaced by what would be there without it."""
    return substitute(tree, lambda name: value if name == "value" else None)
