"""A tape's derivatives as machine code of their own, for a model that is simulated often.

The kernel reads a tape operation by operation, ready at once for any model; most of its time goes into finding out what
each operation is. Where a tape is run over many rows (a fit simulates each some hundred times) its operations are
translated once, by the compiler that Numba brings, into straight machine code: the same operations in the same order,
so that the results are the same to the last bit.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from autotune.arrays import IntArray
from autotune.equations import opcodes as op

#: Rows over which a tape is read before it is translated, which takes as long as reading some ten thousand rows; and
#: how many tapes are remembered.
WORTH_TRANSLATING, REMEMBERED = 10_000, 512

_DOUBLE = ir.DoubleType()
_TYPE = ir.FunctionType(ir.VoidType(), [_DOUBLE.as_pointer(), ir.IntType(8)])
_BY_NAME = {
    op.SIN: "llvm.sin.f64", op.COS: "llvm.cos.f64", op.EXP: "llvm.exp.f64", op.LOG: "llvm.log.f64",
    op.SQRT: "llvm.sqrt.f64", op.TAN: "tan", op.ASIN: "asin", op.ACOS: "acos", op.ATAN: "atan", op.SINH: "sinh",
    op.COSH: "cosh", op.TANH: "tanh", op.ATAN2: "atan2", op.POW: "llvm.pow.f64",
}  # fmt: skip


class Native:
    """Machine code of the operations ``first`` to ``last`` of a tape; it lives as long as this object."""

    def __init__(self, code: IntArray, first: int, last: int) -> None:
        module = llvm.parse_assembly(str(_Assembly(code[first:last]).module))
        module.verify()
        self._engine = llvm.create_mcjit_compiler(module, _machine())
        self._engine.finalize_object()
        self.address = int(self._engine.get_function_address("field"))


class Translator:
    """Counts how often tapes are run, and translates those that are worth it; several threads may ask."""

    def __init__(self, worth: int = WORTH_TRANSLATING, remembered: int = REMEMBERED) -> None:
        self._worth, self._remembered = worth, remembered
        self._rows: OrderedDict[bytes, int] = OrderedDict()
        self._known: OrderedDict[bytes, Native] = OrderedDict()
        self._lock = threading.Lock()

    def native(self, code: IntArray, first: int, last: int, rows: int) -> Native | None:
        """Return the machine code of a tape that is about to be run over some rows; nothing where it is run seldom.

        The caller keeps what is returned until its run has ended: what is forgotten here is freed with its last use.

        Parameters
        ----------
        code : (K, 5) array of int
            The tape.
        first, last : int
            Its operations that are run.
        rows : int
            Over how many rows.
        """
        key = np.array([first, last]).tobytes() + code[first:last].tobytes()
        with self._lock:
            if key in self._known:
                self._known.move_to_end(key)
                return self._known[key]
            self._rows[key] = self._rows.pop(key, 0) + rows
            if len(self._rows) > self._remembered:
                self._rows.popitem(last=False)
            if self._rows[key] <= self._worth:
                return None
            del self._rows[key]
            self._known[key] = Native(code, first, last)
            if len(self._known) > self._remembered:
                self._known.popitem(last=False)
            return self._known[key]


@intrinsic
def call(typing: Any, address: Any, r: Any, extended: Any) -> Any:
    """Run machine code at an address on registers.

    Parameters
    ----------
    typing : object
        Of numba's compiler.
    address : int64
        Of the machine code.
    r : array
        The registers.
    extended : bool
        As of :func:`autotune.equations.tape_ops.evaluate`.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        function = builder.inttoptr(arguments[0], _TYPE.as_pointer())
        registers = context.make_array(signature.args[1])(context, builder, arguments[1]).data
        builder.call(function, [registers, builder.zext(arguments[2], ir.IntType(8))])
        return context.get_dummy_value()

    return types.void(types.int64, r, types.boolean), generate


class _Assembly:
    """The operations of a tape as a function ``field(registers, extended)``."""

    def __init__(self, code: IntArray) -> None:
        self.module = ir.Module(name="tape")
        self._functions: dict[str, Any] = {}
        self._field = ir.Function(self.module, _TYPE, name="field")
        self._b = ir.IRBuilder(self._field.append_basic_block())
        self._extended = self._b.icmp_unsigned("!=", self._field.args[1], ir.Constant(ir.IntType(8), 0))
        self._values: dict[int, Any] = {}
        for operation, target, *operands in code.tolist():
            value = self._value(operation, *operands)
            self._values[target] = value
            self._b.store(value, self._at(target))
        self._b.ret_void()

    def _at(self, register: int) -> Any:
        return self._b.gep(self._field.args[0], [ir.Constant(ir.IntType(64), register)], inbounds=True)

    def _register(self, register: int) -> Any:
        if register not in self._values:
            self._values[register] = self._b.load(self._at(register))
        return self._values[register]

    def _call(self, name: str, *arguments: Any) -> Any:
        if name not in self._functions:
            kind = ir.FunctionType(_DOUBLE, [_DOUBLE] * len(arguments))
            self._functions[name] = ir.Function(self.module, kind, name=name)
        return self._b.call(self._functions[name], arguments)

    def _value(self, operation: int, first: int, second: int, third: int) -> Any:
        """Return what :func:`autotune.equations.tape_ops.evaluate` computes."""
        b, a = self._b, self._register(first)
        simple: dict[int, Callable[..., Any]] = {op.ADD: b.fadd, op.SUB: b.fsub, op.MUL: b.fmul, op.DIV: b.fdiv}
        if operation in simple:
            return simple[operation](a, self._register(second))
        match operation:
            case op.NEG:
                return b.fneg(a)
            case op.SQUARE:
                return b.fmul(a, a)
            case op.SELECT:
                return self._select_side(a, self._register(second), self._register(third))
            case op.CHOOSE:
                above = b.fcmp_ordered(">=", self._register(third), _number(0.0))
                return b.select(above, a, self._register(second))
            case op.POW:
                return self._power(a, self._register(second))
            case op.EXP:
                a = b.select(b.fcmp_ordered(">", a, _number(709.0)), _number(709.0), a)
            case op.LOG:
                small = b.and_(self._extended, b.fcmp_ordered("<", a, _number(1e-300)))
                a = b.select(small, _number(1e-300), a)
            case op.SQRT:
                beyond = b.and_(self._extended, b.fcmp_ordered("<", a, _number(0.0)))
                root = self._call(_BY_NAME[op.SQRT], b.select(beyond, b.fneg(a), a))
                return b.select(beyond, b.fneg(root), root)
            case op.ATAN2:
                return self._call(_BY_NAME[op.ATAN2], a, self._register(second))
        return self._call(_BY_NAME[operation], a)

    def _select_side(self, above: Any, below: Any, mode: Any) -> Any:
        b, one = self._b, _number(1.0)
        mixed = b.fadd(b.fmul(b.fadd(one, mode), above), b.fmul(b.fsub(one, mode), below))
        is_below = b.fcmp_ordered("==", mode, _number(-1.0))
        rest = b.select(is_below, below, b.fmul(_number(0.5), mixed))
        return b.select(b.fcmp_ordered("==", mode, one), above, rest)

    def _power(self, a: Any, exponent: Any) -> Any:
        b = self._b
        whole = b.fcmp_ordered("==", exponent, self._call("llvm.floor.f64", exponent))
        known = b.or_(b.fcmp_ordered(">=", a, _number(0.0)), whole)
        power = self._call(_BY_NAME[op.POW], b.select(known, a, b.fneg(a)), exponent)
        beyond = b.select(self._extended, b.fneg(power), _number(float("nan")))
        return b.select(known, power, beyond)


def _number(value: float) -> Any:
    return ir.Constant(_DOUBLE, value)


def _machine() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), opt=2, jit=True)
