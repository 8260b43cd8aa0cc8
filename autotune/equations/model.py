"""A model of equations: states with derivatives, inputs, an output, parameters; what a person wrote, checked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from types import MappingProxyType
from typing import Literal, TypeAlias, get_args

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.expressions import FUNCTIONS, RESERVED, Expression, names_in
from autotune.errors import InputError
from autotune.models import Effect, Hold

StateKind: TypeAlias = Literal["position", "speed", "level", "temperature", "current", "pressure", "other"]
PortKind: TypeAlias = Literal["force", "torque", "flow", "heat"]
InputKind: TypeAlias = Literal["", "force", "torque", "flow", "heat"]
STATE_KINDS, PORT_KINDS, INPUT_KINDS = get_args(StateKind), get_args(PortKind), get_args(InputKind)

#: Relative prior standard deviation of a parameter whose file says nothing about it.
SPREAD = 0.3


@dataclass(frozen=True, kw_only=True)
class InputColumn:
    """A column of the recording that drives the model.

    Attributes
    ----------
    column : str
        Its name in the recording and in the expressions; the first input is the command.
    unit : str
        Its unit; empty where not given.
    hold : {"zero", "linear"}
        Whether it holds from its row on, or runs straight to the next row's value.
    kind : str
        Of an FMU: what kind of force or flow it takes; empty for all others.
    delay_s : float
        Dead time between the column and the equations [s].
    offset : float
        The equations receive the column less this.
    """

    column: str
    unit: str = ""
    hold: Hold = "zero"
    kind: InputKind = ""
    delay_s: float = 0.0
    offset: float = 0.0


@dataclass(frozen=True, kw_only=True)
class State:
    """A state: its derivative, and what it is.

    Attributes
    ----------
    name, unit : str
        What the expressions call it, and its unit.
    derivative : Expression
        Its derivative with respect to time.
    kind : str
        position, speed, level, temperature, current, pressure or other.
    of : str
        The position that this is the speed of; empty where there is none.
    start : float, optional
        Its value at the first row of each recording; estimated where it is absent.
    """

    name: str
    derivative: Expression
    unit: str = ""
    kind: StateKind = "other"
    of: str = ""
    start: float | None = None


@dataclass(frozen=True, kw_only=True)
class ModelParameter:
    """A parameter with its prior.

    Attributes
    ----------
    name, unit : str
        What the expressions call it, and its unit.
    value : float
        Its nominal value.
    spread : float
        Relative prior standard deviation (absolute where the value is 0); 0: it is not retuned.
    linear: bool
        Whether it may change its sign: it is sought as ``value + spread z``, and the spread is absolute.
    least: float
        Magnitude below which a fit does not take it, where it keeps its sign.
    """

    name: str
    value: float
    unit: str = ""
    spread: float = SPREAD
    linear: bool = False
    least: float = 0.0


@dataclass(frozen=True, kw_only=True)
class ModelPort:
    """A place where something may act that the nominal model leaves at zero.

    Attributes
    ----------
    name, unit : str
        What the derivatives call it, and its unit.
    kind : {"force", "torque", "flow", "heat"}
        What acts there.
    across : Expression, optional
        The difference of speed, level or temperature that it acts on.
    """

    name: str
    kind: PortKind
    across: Expression | None = None
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class EquationModel:
    """A model of equations, as a person wrote it or a diagnosis extended it.

    Attributes
    ----------
    name : str
        What it is.
    inputs : tuple of InputColumn
        What drives it; the first is the command.
    output : Expression
        What the reading says; may depend on inputs.
    states : tuple of State
        Its states, in the order of every state vector.
    parameters : tuple of ModelParameter
        Its parameters, in the order of every parameter vector.
    defines : tuple of (name, Expression)
        Helper expressions, each using only those before it.
    ports : tuple of ModelPort
        Places where something may act.
    output_unit : str
        Unit of the output.
    horizon_s : float, optional
        The plant is compared as forecasts of that length [s]; absent: as one free run.
    effects : tuple of Effect
        Physics that a diagnosis added, by its name in the catalogue.

    Raises
    ------
    InputError
        A name given twice or not known, an algebraic loop, a state of an unknown kind; names the expression.
    """

    name: str
    inputs: tuple[InputColumn, ...]
    output: Expression
    states: tuple[State, ...]
    parameters: tuple[ModelParameter, ...] = ()
    defines: tuple[tuple[str, Expression], ...] = ()
    ports: tuple[ModelPort, ...] = ()
    output_unit: str = ""
    horizon_s: float | None = None
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        _names_once(self)
        _names_known(self)
        for state in self.states:
            if state.of and state.of not in self.state_names:
                raise InputError(
                    f"of = {state.of!r} is no state", where=f"{self.name}: state {state.name}", remedy="name a state"
                )

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in the order of every state vector."""
        return tuple(state.name for state in self.states)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of every parameter vector."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def has_given_start(self) -> bool:
        """Whether the value of a state at the first row of each recording is given."""
        return any(state.start is not None for state in self.states)

    @property
    def signal_units(self) -> dict[str, str]:
        """Units of the columns that drive it, and of y."""
        return {one.column: one.unit for one in self.inputs} | {"y": self.output_unit}

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the recording that drive the model, in the order of every input matrix."""
        return tuple(one.column for one in self.inputs)

    @property
    def parameter_vector(self) -> FloatArray:
        """Nominal values of the parameters."""
        return np.array([parameter.value for parameter in self.parameters], dtype=np.float64)

    def with_parameters(self, values: Mapping[str, float] | Iterable[float]) -> EquationModel:
        """Return the model with other nominal values, by name or as a whole vector."""
        given = dict(values) if isinstance(values, Mapping) else dict(zip(self.parameter_names, values, strict=True))
        new = tuple(replace(p, value=float(given.get(p.name, p.value))) for p in self.parameters)
        return replace(self, parameters=new)


@dataclass(frozen=True, kw_only=True)
class Extension:
    """What is added to a model: an effect in the model's own language.

    ``value`` in the expression of an input or of the output stands for what would be there without the extension; in
    an extension that acts on just one of them its states may use it too.

    Attributes
    ----------
    name : str
        What it is, for messages.
    states, parameters : tuples
        New states and parameters.
    derivative : mapping of state to Expression
        Added to the derivative of a state.
    port : mapping of port to Expression
        Added at a port.
    input : mapping of column to Expression
        What the equations receive in place of the column; the column itself is ``value``.
    output : Expression, optional
        The reading, the undisturbed output being ``value``.
    """

    name: str
    states: tuple[State, ...] = ()
    parameters: tuple[ModelParameter, ...] = ()
    derivative: Mapping[str, Expression] = field(default_factory=lambda: MappingProxyType({}))
    port: Mapping[str, Expression] = field(default_factory=lambda: MappingProxyType({}))
    input: Mapping[str, Expression] = field(default_factory=lambda: MappingProxyType({}))
    output: Expression | None = None


def expressions_of(model: EquationModel) -> list[tuple[str, Expression]]:
    """Return every expression of a model with the place where it stands, defines first."""
    found = [(f"[define] {name}", tree) for name, tree in model.defines]
    found += [(f"derivative of {state.name}", state.derivative) for state in model.states]
    found += [(f"across of port {port.name}", port.across) for port in model.ports if port.across is not None]
    return [*found, ("[output] value", model.output)]


def _names_once(model: EquationModel) -> None:
    seen: dict[str, str] = {}
    groups = {
        "input": model.columns,
        "state": model.state_names,
        "parameter": model.parameter_names,
        "port": tuple(port.name for port in model.ports),
        "define": tuple(name for name, _ in model.defines),
    }
    for group, names in groups.items():
        for name in names:
            if name in FUNCTIONS or name in RESERVED:
                raise InputError(
                    f"the {group} {name!r} has the name of a {'function' if name in FUNCTIONS else 'constant or time'}",
                    where=model.name,
                    remedy="give it another name",
                )
            if not name.isidentifier():
                raise InputError(
                    f"the {group} {name!r} is no name for an expression",
                    where=model.name,
                    remedy="use letters, digits and _, a letter first",
                )
            if name in seen:
                raise InputError(
                    f"{name!r} is both {seen[name]} and {group}" if seen[name] != group else f"two {group}s {name!r}",
                    where=model.name,
                    remedy="give every input, state, parameter, port and define its own name",
                )
            seen[name] = group


def _names_known(model: EquationModel) -> None:
    later = {name for name, _ in model.defines}
    ports = {port.name for port in model.ports}
    known = {*RESERVED, *model.columns, *model.state_names, *model.parameter_names, *ports}
    uses = {name: names_in(tree) & later for name, tree in model.defines}
    for place, tree in expressions_of(model):
        used = names_in(tree)
        name = place.removeprefix("[define] ") if place.startswith("[define] ") else ""
        _no_loop(name, uses, model.name)
        for one in sorted(used - known):
            where = f"{model.name}: {place}"
            if one in later:
                remedy = f"put {one!r} before {name!r} in [define]"
                raise InputError(f"uses {one!r}, which is defined after it", where=where, remedy=remedy)
            near = get_close_matches(one, known | later, 1)
            hint = (
                f"did you mean {near[0]!r}?" if near else "declare it as state, input, parameter, port or in [define]"
            )
            raise InputError(f"unknown name {one!r}", where=where, remedy=hint)
        if place.startswith("across") and used & ports:
            port = sorted(used & ports)[0]
            raise InputError(f"algebraic loop through port {port!r}", where=f"{model.name}: {place}",
                             remedy="a difference across a port is made of states and inputs")  # fmt: skip
        if name:
            known.add(name)
            later.discard(name)


def _no_loop(name: str, uses: Mapping[str, set[str]], where: str) -> None:
    """Refuse a defined expression that leads back to itself."""
    path, seen = [name], set()

    def follow(one: str) -> None:
        for nxt in sorted(uses.get(one, ())):
            if nxt == name:
                loop = " -> ".join([*path, name])
                raise InputError(f"algebraic loop {loop}", where=f"{where}: [define]",
                                 remedy="make one of them a state, or solve for it by hand")  # fmt: skip
            if nxt not in seen:
                seen.add(nxt)
                path.append(nxt)
                follow(nxt)
                path.pop()

    follow(name)
