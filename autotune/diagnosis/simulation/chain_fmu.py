"""A chain with its effects as an FMU: C source whose y is that of the project's own simulation.

The lines of the effects and the stages that call them are translated from the source that the simulation is compiled
from; the sums around them stand in ``chain_run.c``, which follows the kernel step by step.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.simulation import kernel
from autotune.diagnosis.simulation.assembly import assemble
from autotune.diagnosis.simulation.compiled import layout_of, source_of
from autotune.diagnosis.simulation.simulator import FASTEST, MOST_PIECES, Simulator, layout
from autotune.effects import kind_of
from autotune.effects.base import EffectKind
from autotune.effects.stages import STAGES
from autotune.equations.fmu_export import Description, Variable, pack_fmu, whole_source
from autotune.errors import InputError
from autotune.models import Model

#: what is written out of the simulation's source: the stages, and lines, which begin with their file's name
_STAGES = (*STAGES, "begin")
_FUNCTIONS = {"abs": "fabs", "min": "fmin", "max": "fmax", "float": ""}
_OPERATORS: dict[type[ast.AST], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=",
    ast.Eq: "==", ast.NotEq: "!=", ast.And: "&&", ast.Or: "||",
}  # fmt: skip


def chain_as_fmu(model: Model) -> tuple[bytes, str]:
    """Return an FMU of a chain with its effects, and the platform that it brings a library for, empty where none.

    Parameters
    ----------
    model : Model
        Chain and effects. What a fit can move of effects that have lines are its parameters; states begin at the
        operating point, and may be set.

    Raises
    ------
    InputError
        A command that runs straight to a value that is not known yet, or a clock of another rate, by which commands
        would act before they are given.

    Notes
    -----
    Effects that no simulation has (those of samples and stamps) are left out, as ``simulate`` leaves them out.
    """
    sim = assemble(model)
    if sim.linear_hold:
        raise InputError(
            "u runs straight from row to row, and an FMU does not know the next one", where=f"{model.name}: input.hold",
            remedy='leave hold = "linear" out; the model then holds each command until the next',
        )  # fmt: skip
    for kind in sim.kinds:
        if "clock" in kind.stages:
            raise InputError(
                f"{kind.name}: commands would act before they are given, which an FMU cannot", where=model.name,
                remedy="leave that effect out: it is of the recording's clock and not of the plant",
            )  # fmt: skip
    kinds = tuple(kind for kind in sim.kinds if kind.lines)
    ordered = tuple(kind for kind in layout().kinds if kind in kinds)
    parameters = [
        Variable(name=f"{kind.name}.{q.name}", unit=_unit(q.unit, model), start=_value(sim, kind, q.name))
        for kind in ordered
        for q in kind.parameters
    ]
    source = whole_source(f"{_declared(sim, ordered, parameters)}\n{_run()}")
    return pack_fmu(
        source,
        Description(
            name=model.name,
            inputs=(Variable(name="u", unit=model.input.unit, start=sim.u_offset),),
            states=tuple(Variable(name=f"x{i + 1}", unit="", start=0.0) for i in range(sim.order)),
            output_unit=model.output.unit,
            parameters=tuple(parameters),
        ),
    )


def left_out_of_fmu(model: Model) -> tuple[str, ...]:
    """Return the effects of a chain that no simulation has, and an FMU neither."""
    return tuple(one.name for one in model.effects if not kind_of(one.name, model.name).is_simulated)


def _unit(unit: str, model: Model) -> str:
    return unit.format(u=model.input.unit, f=model.force_unit, v=model.speed_unit, y=model.output.unit)


def _value(sim: Simulator, kind: EffectKind, name: str) -> float:
    return float(sim.values[layout().slots[kind.name, name]])


def _run() -> str:
    return Path(__file__).with_name("chain_run.c").read_text(encoding="utf-8")


def _declared(sim: Simulator, kinds: tuple[EffectKind, ...], parameters: Sequence[Variable]) -> str:
    """Return the chain's numbers, and the effects' lines and stages in C."""
    chain, flags = sim.chain, sim.flags
    numbers = np.concatenate([sim.numbers[: kernel.NUMBERS], [one.start for one in parameters]])
    pieces, is_forced = sim.pieces
    told = {
        "STATES": sim.order, "PARAMETERS": len(parameters), "NUMBERS": kernel.NUMBERS,
        "MEMORIES": len(layout_of(kinds).memories), "PIECES": pieces, "MOST_PIECES": MOST_PIECES,
        "IS_FORCED": int(is_forced),
    }  # fmt: skip
    names = ("DIRECTIONAL", "ACTUATOR", "SPEED_STATE", "POSITION_STATE", "FORCED", "SMOOTH", "RUBBING", "DRAINING",
             "STOPPED", "REPLAYED")  # fmt: skip
    told |= {name: int(flags[getattr(kernel, name)]) for name in names}
    reals = ("DELAY", "U_OFFSET", "Y_OFFSET", "LAW", "DIRECT_IN", "DIRECT_OUT")
    fixed = {name: float(numbers[getattr(kernel, name)]) for name in reals}
    fixed |= {"FASTEST": float(chain.fastest_of_plant) if is_forced else 0.0, "LONGEST": FASTEST}
    lines = [f"enum {{ {', '.join(f'{name} = {value}' for name, value in told.items())} }};"]
    lines += [f"#define {name} ({value!r})" for name, value in fixed.items()]
    lines += [
        _vector("X_0", np.zeros(sim.order)), _vector("P_0", numbers[kernel.NUMBERS :]), _vector("NUMBERS_0", numbers),
        _matrix("A", chain.A, sim.order + 1), _matrix("B", chain.B, 3), _matrix("TAPS", chain.taps, sim.order + 1),
        _matrix("A_FALLING", sim.falling.A, sim.order + 1), _matrix("B_FALLING", sim.falling.B, 3),
        "typedef struct { double first, second; } Pair;",
        f"typedef struct {{ double numbers[{numbers.size + 1}], memory[MEMORIES + 1]; }} Effects;",
        *_translated(source_of(kinds)),
    ]  # fmt: skip
    return "\n".join(lines)


def _vector(name: str, values: FloatArray) -> str:
    return f"static const double {name}[] = {{{', '.join(map(_number, [*values, 0.0]))}}};"


def _matrix(name: str, values: FloatArray, columns: int) -> str:
    rows = [*values, np.zeros(0)]  # one row at least, for a chain without states
    written = ", ".join("{" + ", ".join(map(_number, [*row, 0.0][:columns])) + "}" for row in rows)
    return f"static double {name}[][{columns}] = {{{written}}};"


def _number(value: float) -> str:
    return repr(float(value)).replace("inf", "HUGE_VAL")


def _translated(source: str) -> Iterator[str]:
    """Return the stages and the effects' lines of the simulation's source as C functions."""
    mine = set(_names_of(kernel.__file__))
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef) and node.name not in mine:
            yield _Translated(node).text


def _names_of(path: str) -> Iterator[str]:
    for node in ast.parse(Path(path).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            yield node.name


class _Translated:
    """A function of scalars in C; what a line of an effect may use (``math``, branches, pairs) and no more."""

    def __init__(self, node: ast.FunctionDef) -> None:
        self._arguments = [one.arg for one in node.args.args]
        self._local = {
            one.id for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)
        } - set(self._arguments)  # fmt: skip
        self._pairs = 0
        returned = [one.value for one in ast.walk(node) if isinstance(one, ast.Return)]
        is_pair = any(isinstance(one, ast.Tuple) for one in returned)
        kind = "Pair" if is_pair else "double" if any(not _is_none(one) for one in returned) else "void"
        given = ", ".join({"effects": "Effects *effects", "carried": "const double *carried"}.get(one, f"double {one}")
                          for one in self._arguments)  # fmt: skip
        local = [f"    double {', '.join(sorted(self._local))};"] if self._local else []
        body = [line for one in node.body for line in self._statement(one)]
        self.text = "\n".join(
            (f"static {kind} {node.name}({given})", "{", *local, *(f"    {one}" for one in body), "}")
        )

    def _statement(self, node: ast.stmt) -> Iterator[str]:
        match node:
            case ast.Expr(value=ast.Constant()):
                return
            case ast.Return(value=value):
                yield "return;" if value is None or _is_none(value) else f"return {self._value(value)};"
            case ast.Assign(targets=[ast.Tuple(elts=[first, second])], value=value):
                self._pairs += 1
                yield f"Pair pair{self._pairs} = {self._value(value)};"
                yield f"{self._value(first)} = pair{self._pairs}.first;"
                yield f"{self._value(second)} = pair{self._pairs}.second;"
            case ast.Assign(targets=[target], value=value):
                yield f"{self._value(target)} = {self._value(value)};"
            case ast.AugAssign(target=target, op=op, value=value):
                yield f"{self._value(target)} {_OPERATORS[type(op)]}= {self._value(value)};"
            case ast.If(test=test, body=body, orelse=orelse):
                yield f"if ({self._value(test)}) {{"
                yield from (f"    {line}" for one in body for line in self._statement(one))
                yield "}"
                if orelse:
                    yield "else {"
                    yield from (f"    {line}" for one in orelse for line in self._statement(one))
                    yield "}"
            case _:
                raise _untranslated(node)

    def _value(self, node: ast.expr) -> str:
        match node:
            case ast.Name(id=name):
                return name
            case ast.Tuple(elts=[first, second]):
                return f"(Pair){{{self._value(first)}, {self._value(second)}}}"
            case ast.Constant(value=bool(value)):
                return str(int(value))
            case ast.Constant(value=float() | int() as value):
                return repr(float(value))
            case ast.Subscript(value=ast.Attribute(attr="acts")):
                return "1"  # only what acts is written
            case ast.Subscript(value=ast.Attribute(attr=name), slice=ast.Constant() as place):
                return f"effects->{name}[{ast.unparse(place)}]"
            case ast.Subscript(value=ast.Name(id=name), slice=ast.Constant() as place):
                return f"{name}[{ast.unparse(place)}]"
            case ast.Attribute(value=ast.Name(id="math"), attr="pi"):
                return repr(np.pi)
            case ast.UnaryOp(op=op, operand=operand):
                return f"({'!' if isinstance(op, ast.Not) else '-'}{self._value(operand)})"
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                return f"pow({self._value(left)}, {self._value(right)})"
            case ast.BinOp(left=left, op=op, right=right):
                return f"({self._value(left)} {_OPERATORS[type(op)]} {self._value(right)})"
            case ast.BoolOp(op=op, values=values):
                return "(" + f" {_OPERATORS[type(op)]} ".join(map(self._value, values)) + ")"
            case ast.Compare(left=left, ops=ops, comparators=others):
                sides = [self._value(one) for one in (left, *others)]
                each = [f"{sides[i]} {_OPERATORS[type(op)]} {sides[i + 1]}" for i, op in enumerate(ops)]
                return "(" + " && ".join(each) + ")"
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return f"({self._value(test)} ? {self._value(body)} : {self._value(orelse)})"
            case ast.Call(func=ast.Name(id=name), args=args):
                return f"{_FUNCTIONS.get(name, name)}({', '.join(map(self._value, args))})"
            case ast.Call(func=ast.Attribute(value=ast.Name(id="math"), attr=name), args=args):
                return f"{name}({', '.join(map(self._value, args))})"
        raise _untranslated(node)


def _is_none(node: ast.expr | None) -> bool:
    return node is None or (isinstance(node, ast.Constant) and node.value is None)


def _untranslated(node: ast.AST) -> InputError:
    return InputError(
        f"'{ast.unparse(node)}' has no translation to C",
        where="a line of an effect",
        remedy="report this, it is a defect",
    )
