"""Runs the few statements of Structured Text that the function blocks use, from the tree that blark parses."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from blark import transform as tree
from blark.parse import parse_source_code

_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "MIN": min,
    "MAX": max,
    "LIMIT": lambda low, value, high: min(max(value, low), high),
    "INT_TO_LREAL": float,
}
_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "MOD": lambda a, b: a - b * int(a / b),
    "<": lambda a, b: a < b,
    ">": lambda a, b: a > b,
    "<=": lambda a, b: a <= b,
    ">=": lambda a, b: a >= b,
    "=": lambda a, b: a == b,
    "<>": lambda a, b: a != b,
    "AND": lambda a, b: a and b,
    "OR": lambda a, b: a or b,
}
_ZERO: dict[str, Any] = {"LREAL": 0.0, "INT": 0, "DINT": 0, "BOOL": False}


def function_blocks(paths: Iterable[Path]) -> dict[str, Any]:
    """Return the parsed function blocks by name."""
    found = {}
    for path in paths:
        for item in parse_source_code(path.read_text()).transform().items:
            assert isinstance(item, tree.FunctionBlock), item
            found[str(item.name)] = item
    return found


class Instance:
    """An instance of a function block: ``value`` holds its variables.

    An assignment to a variable of another type than its own is refused, as a compiler does.
    """

    def __init__(self, name: str, blocks: dict[str, Any]) -> None:
        self._body = blocks[name].body
        self.value: dict[str, Any] = {}
        for section in blocks[name].declarations:
            for item in section.items:
                for variable in item.variables:
                    self.value[str(variable.variable.name)] = self._initial(item.init, blocks)

    def __call__(self, **inputs: Any) -> Instance:
        """Set inputs and run one cycle."""
        for name, value in inputs.items():
            self._store(name, value)
        self._run(self._body)
        return self

    def _initial(self, init: Any, blocks: dict[str, Any]) -> Any:
        if isinstance(init, tree.ArrayTypeInitialization):
            (span,) = init.spec.subranges
            assert int(str(span.start.value)) == 0
            return [_ZERO[str(init.spec.type.type_name)]] * (int(str(span.stop.value)) + 1)
        kind = str(init.spec.type)
        if kind in blocks:
            return Instance(kind, blocks)
        return _ZERO[kind] if init.value is None else type(_ZERO[kind])(self._evaluate(init.value))

    def _store(self, name: str, value: Any) -> None:
        held = self.value[name]
        assert type(value) is type(held), f"{name} := {value!r}"
        if isinstance(value, int):
            assert abs(value) < 2**31
        self.value[name] = value

    def _run(self, statements: Any) -> None:
        for statement in statements.statements if statements is not None else ():
            self._step(statement)

    def _step(self, statement: Any) -> None:
        match statement:
            case tree.AssignmentStatement(variables=[target], expression=expression):
                value = self._evaluate(expression)
                if isinstance(target, tree.SimpleVariable):
                    self._store(str(target.name), value)
                else:
                    array, at = self._element(target)
                    assert type(value) is type(array[at])
                    array[at] = value
            case tree.IfStatement():
                arms = [(statement.if_expression, statement.statements)]
                arms += [(arm.if_expression, arm.statements) for arm in statement.else_ifs]
                for condition, body in arms:
                    if self._evaluate(condition):
                        return self._run(body)
                if statement.else_clause is not None:
                    self._run(statement.else_clause.statements)
            case tree.ForStatement(control=control, from_=first, to=last, step=None, statements=body):
                for i in range(self._evaluate(first), self._evaluate(last) + 1):
                    self._store(str(control.name), i)
                    self._run(body)
            case tree.FunctionCallStatement(name=name, parameters=parameters):
                inputs = {str(given.name.name): self._evaluate(given.value) for given in parameters}
                self.value[str(name.name)](**inputs)
            case _:
                raise AssertionError(f"not a statement that is used here: {statement}")
        return None

    def _element(self, variable: Any) -> tuple[list[Any], int]:
        (subscripts,) = variable.elements
        (at,) = subscripts.subscripts
        index = self._evaluate(at)
        array = self.value[str(variable.name.name)]
        assert 0 <= index < len(array), f"{variable} at {index}"  # Python would count from the end
        return array, index

    def _evaluate(self, expression: Any) -> Any:
        match expression:
            case tree.SimpleVariable(name=name):
                return {"TRUE": True, "FALSE": False}.get(str(name), self.value.get(str(name)))
            case tree.MultiElementVariable(name=name, elements=[tree.FieldSelector(field=field)]):
                return self.value[str(name.name)].value[str(field.name)]
            case tree.MultiElementVariable():
                array, at = self._element(expression)
                return array[at]
            case tree.Boolean(value=value):
                return str(value).upper() == "TRUE"
            case tree.Integer(value=value):
                return int(str(value))
            case tree.Real(value=value):
                return float(str(value))
            case tree.ParenthesizedExpression(expr=inner):
                return self._evaluate(inner)
            case tree.UnaryOperation(op=op, expr=inner):
                value = self._evaluate(inner)
                return not value if str(op).upper() == "NOT" else -value
            case tree.BinaryOperation(left=left, op=op, right=right):
                a, b = self._evaluate(left), self._evaluate(right)
                assert type(a) is type(b), expression  # the standard converts nothing by itself
                return _OPERATORS[str(op).upper()](a, b)
            case tree.FunctionCall(name=name, parameters=parameters):
                return _FUNCTIONS[str(name.name).upper()](*(self._evaluate(given.value) for given in parameters))
        raise AssertionError(f"not an expression that is used here: {expression}")
