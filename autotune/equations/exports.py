"""Equations for other tools: readable text, Modelica, a Python function, and how other languages spell them.

Every export is of the flattened model: effects are written out, so that nothing of this project is needed to run it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import reduce

from autotune.equations.expressions import Call, Expression, Name, Number, to_text
from autotune.equations.flatten import flatten
from autotune.equations.model import EquationModel


def as_text(model: EquationModel) -> str:
    """Return the equations as a person writes them on paper, with their numbers below."""
    flat = flatten(model)
    lines = [flat.name, ""]
    lines += [f"{name} = {to_text(tree)}" for name, tree in flat.defines]
    lines += [f"d{one.name}/dt = {to_text(one.derivative)}{_unit(one.unit)}" for one in flat.states]
    lines += [f"y = {to_text(flat.output)}{_unit(flat.output_unit)}", ""]
    for one in flat.inputs:
        late = f", {one.delay_s:g} s late" if one.delay_s else ""
        lines.append(f"{one.column}: {'command' if one == flat.inputs[0] else 'measured'}, "
                     f"{'held' if one.hold == 'zero' else 'straight between rows'}{late}{_unit(one.unit)}")  # fmt: skip
    lines += [f"{one.name} = {one.value:.6g}{f' {one.unit}' if one.unit else ''}" for one in flat.parameters]
    return "\n".join(lines) + "\n"


def _unit(unit: str) -> str:
    return f"   [{unit}]" if unit else ""


def as_modelica(model: EquationModel) -> str:
    """Return a Modelica model with the inputs as ``RealInput``, y as ``RealOutput``, parameters with their values.

    Switched terms stay as they are written: Modelica locates their events itself. Dead times become ``delay(u, d)``.
    """
    flat = flatten(model)
    names = safe_names(flat, _MODELICA_WORDS)
    arrives = {one.column: f"{names[one.column]}_late" if one.delay_s else names[one.column] for one in flat.inputs}
    said = names | arrives
    title = re.sub(r"\W", "_", flat.name).strip("_") or "Rig"
    title = title if title[0].isalpha() else f"Rig_{title}"
    lines = [f"model {title}"]
    lines += [f"  parameter Real {names[p.name]} = {p.value!r};{_comment(p.unit)}" for p in flat.parameters]
    lines += [f"  input Real {names[one.column]};{_comment(one.unit)}" for one in flat.inputs]
    lines += [f"  Real {names[one.column]}_late;" for one in flat.inputs if one.delay_s]
    lines += [f"  Real {names[name]};" for name, _ in flat.defines]
    lines += [
        f"  Real {names[one.name]}(start = {one.start or 0.0!r}, fixed = true);{_comment(one.unit)}"
        for one in flat.states
    ]
    lines += [f"  output Real y;{_comment(flat.output_unit)}", "equation"]
    lines += [f"  {names[one.column]}_late = delay({names[one.column]}, {one.delay_s!r});"
              for one in flat.inputs if one.delay_s]  # fmt: skip
    lines += [f"  {names[name]} = {_MODELICA.spell(tree, said)};" for name, tree in flat.defines]
    lines += [f"  der({names[one.name]}) = {_MODELICA.spell(one.derivative, said)};" for one in flat.states]
    lines += [f"  y = {_MODELICA.spell(flat.output, said)};", f"end {title};"]
    return "\n".join(lines) + "\n"


def _comment(unit: str) -> str:
    return f"  // {unit}" if unit else ""


_MODELICA_TAKEN = (
    "algorithm and annotation block break class connect connector constant der discrete each else end equation final "
    "for function if import in initial inner input loop model not or outer output package parameter record stream then "
    "time true false type when while y Real Integer delay "
)
_MODELICA_WORDS = frozenset(_MODELICA_TAKEN.split())


def safe_names(model: EquationModel, taken: frozenset[str]) -> dict[str, str]:
    """Return for every name of a model one that another language lets through.

    Parameters
    ----------
    model : EquationModel
        Whose inputs, states, parameters and helper expressions are named.
    taken : frozenset of str
        What a name there cannot be.
    """
    names = [*model.columns, *model.state_names, *model.parameter_names, *(name for name, _ in model.defines)]
    found: dict[str, str] = {}
    for name in names:
        safe = name
        while safe in taken or safe in found.values() or (safe != name and safe in names):
            safe += "_"
        found[name] = safe
    return found


@dataclass(frozen=True, kw_only=True)
class Language:
    """How another language spells what an expression says.

    Attributes
    ----------
    constants : mapping of str to str
        Its names of pi and of the time.
    conditional, power : str
        Its forms, with ``{condition} {then} {otherwise}`` and ``{base} {exponent}``.
    functions : mapping of str to str
        Names of its functions, where they differ from the expression's.
    prefix : str
        What stands before the name of any other function.
    """

    constants: Mapping[str, str]
    conditional: str
    power: str
    functions: Mapping[str, str] = field(default_factory=dict)
    prefix: str = ""

    def spell(self, tree: Expression, names: Mapping[str, str]) -> str:
        """Return an expression in this language.

        Parameters
        ----------
        tree : Expression
            What is spelled.
        names : mapping of str to str
            The names that this language lets through, of the model's own.
        """
        match tree:
            case Number(value):
                return repr(value) if value >= 0.0 else f"({value!r})"
            case Name(name):
                return self.constants.get(name) or names[name]
        assert isinstance(tree, Call)
        said = [self.spell(one, names) for one in tree.arguments]
        match tree.function:
            case "neg":
                return f"(-{said[0]})"
            case "if":
                return self.conditional.format(condition=said[0], then=said[1], otherwise=said[2])
            case "^":
                return self.power.format(base=said[0], exponent=said[1])
            case "+" | "-" | "*" | "/" | "<" | "<=" | ">" | ">=" as sign:
                return f"({said[0]} {sign} {said[1]})"
            case "min" | "max" as function:
                name = self.functions.get(function, function)
                return reduce(lambda nested, other: f"{name}({nested}, {other})", said)
        return f"{self.functions.get(tree.function, self.prefix + tree.function)}({', '.join(said)})"


_MODELICA = Language(
    constants={"pi": repr(math.pi), "t": "time"},
    conditional="(if {condition} then {then} else {otherwise})",
    power="({base} ^ {exponent})",
)
_PYTHON = Language(
    constants={"pi": "math.pi", "t": "t"},
    conditional="({then} if {condition} else {otherwise})",
    power="({base} ** {exponent})",
    functions={"min": "min", "max": "max", "abs": "abs", "sign": "_sign"},
    prefix="math.",
)


def as_python(model: EquationModel) -> str:
    """Return a Python module with ``derivatives(t, x, inputs, p)``, ``output(t, x, inputs, p)`` and ``PARAMETERS``.

    It needs the standard library alone. ``x`` is a sequence in the order of ``STATES``, ``inputs`` in the order of
    ``INPUTS`` (those of ``DELAYS`` that many seconds ago), ``p`` a mapping, by default ``PARAMETERS``.
    """
    flat = flatten(model)
    names = safe_names(flat, _PYTHON_WORDS)
    unpack = [f"    {', '.join(names[s] for s in flat.state_names)}, = x"]
    unpack += [f"    {', '.join(names[c] for c in flat.columns)}, = inputs"]
    unpack += [f"    {names[p]} = p[{p!r}]" for p in flat.parameter_names]
    unpack += [f"    {names[name]} = {_PYTHON.spell(tree, names)}" for name, tree in flat.defines]
    slopes = [f"        {_PYTHON.spell(one.derivative, names)}," for one in flat.states]
    lines = [
        f'"""{flat.name}: dx/dt = derivatives(t, x, inputs), y = output(t, x, inputs)."""', "", "import math", "",
        f"STATES = {flat.state_names!r}", f"INPUTS = {flat.columns!r}",
        f"DELAYS = {({one.column: one.delay_s for one in flat.inputs if one.delay_s})!r}",
        f"PARAMETERS = {({p.name: p.value for p in flat.parameters})!r}", "", "",
        "def _sign(value):", "    return (value > 0) - (value < 0)", "", "",
        "def derivatives(t, x, inputs, p=PARAMETERS):", *unpack, "    return [", *slopes, "    ]", "", "",
        "def output(t, x, inputs, p=PARAMETERS):", *unpack, f"    return {_PYTHON.spell(flat.output, names)}",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


_PYTHON_TAKEN = (
    "False None True and as assert async await break class continue def del elif else except finally for from global "
    "if import in is lambda nonlocal not or pass raise return try while with yield x p t inputs math derivatives "
    "output min max abs _sign STATES INPUTS DELAYS PARAMETERS "
)
_PYTHON_WORDS = frozenset(_PYTHON_TAKEN.split())
