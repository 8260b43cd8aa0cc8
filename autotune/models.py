"""Models: transfer functions with exact dead time, and the chain of blocks that a person believes the rig to be.

The model file is TOML: ``[input]``, ``[output]``, a ``[[block]]`` for every link of the chain, ``[[effect]]`` tables
where a diagnosis added physics. ``y = last block's output + output.offset``, driven by ``u - input.offset``.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import tomli_w

from autotune.arrays import ComplexArray, FloatArray, is_real
from autotune.errors import InputError
from autotune.outputs import write_whole
from autotune.text_files import read_toml

Place: TypeAlias = Literal["actuator", "plant", "sensor"]
#: What a speed is called, and its units.
_SPEED = re.compile(r"speed|velocity|\brpm\b")
_SPEED_UNIT = re.compile(r"^(m|mm|cm|km|rad|deg|°|rev|turns?)/(s|min|h)$|^rpm$|^1/min$")
Hold: TypeAlias = Literal["zero", "linear"]

#: Most blocks of a chain and most coefficients of a polynomial: far beyond any plant, far before work becomes a wait.
MOST_BLOCKS, MOST_COEFFICIENTS = 50, 40
#: Largest size of a number in a model file; where arithmetic overflows, a result would be none.
LARGEST = 1e30
#: Smallest size other than 0.
SMALLEST = 1e-30


def _trimmed(coefficients: Sequence[float]) -> tuple[float, ...]:
    values = [float(value) for value in coefficients]
    while len(values) > 1 and values[0] == 0.0:
        values.pop(0)
    return tuple(values)


@dataclass(frozen=True, kw_only=True)
class TransferFunction:
    """num(s)/den(s) exp(-s delay): rational with an exact dead time.

    Attributes
    ----------
    num, den : tuple of float
        Coefficients in descending powers of s; leading zeros are dropped.
    delay_s : float
        Dead time [s], evaluated exactly as exp(-j omega L), never by a Pade approximation.

    Raises
    ------
    InputError
        A denominator that is zero, coefficients that are not finite, or a negative dead time.
    """

    num: tuple[float, ...]
    den: tuple[float, ...]
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        lists = all(isinstance(one, tuple | list | np.ndarray) and len(one) for one in (self.num, self.den))
        if not lists or not all(is_real(v) and math.isfinite(v) for v in (*self.num, *self.den, self.delay_s)):
            raise InputError("num, den and delay must be finite numbers", where="transfer function")
        object.__setattr__(self, "num", _trimmed(self.num))
        object.__setattr__(self, "den", _trimmed(self.den))
        if self.den == (0.0,):
            raise InputError("the denominator is zero", where="transfer function")
        if self.delay_s < 0.0:
            raise InputError(f"delay = {self.delay_s:g} s is negative", where="transfer function")

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return the complex gain at the angular frequencies, same shape as ``omega_rad_s``."""
        s = 1j * np.asarray(omega_rad_s, dtype=np.float64)
        rational = np.polyval(self.num, s) / np.polyval(self.den, s)
        return np.asarray(rational * np.exp(-s * self.delay_s), dtype=np.complex128)

    def __mul__(self, other: TransferFunction) -> TransferFunction:
        return TransferFunction(
            num=tuple(np.polymul(self.num, other.num)),
            den=tuple(np.polymul(self.den, other.den)),
            delay_s=self.delay_s + other.delay_s,
        )

    @property
    def poles(self) -> ComplexArray:
        """Roots of the denominator [rad/s]."""
        return np.asarray(np.roots(self.den), dtype=np.complex128)

    @property
    def zeros(self) -> ComplexArray:
        """Roots of the numerator [rad/s]."""
        return np.asarray(np.roots(self.num), dtype=np.complex128)

    @property
    def integrators(self) -> int:
        """Number of poles at s = 0 that the numerator does not cancel."""

        def at_origin(coefficients: tuple[float, ...]) -> int:
            return len(coefficients) - len(np.trim_zeros(np.array(coefficients), "b"))

        return max(0, at_origin(self.den) - at_origin(self.num))

    @property
    def is_proper(self) -> bool:
        """Whether the numerator's degree is at most the denominator's."""
        return len(self.num) <= len(self.den)


@dataclass(frozen=True, kw_only=True)
class Port:
    """The chain's input or output.

    Attributes
    ----------
    unit : str
        Unit of the signal.
    offset : float
        Operating point.
    hold : {"zero", "linear"}
        At the input, how u runs between samples.
    recorded : (float, float), optional
        Lowest and highest value of the recordings that the model was fitted to: its range of validity. Beyond it laws
        are extrapolated.
    """

    unit: str = ""
    offset: float = 0.0
    hold: Hold = "zero"
    recorded: tuple[float, float] | None = None

    def beyond(self, values: FloatArray) -> tuple[float, float]:
        """Return how far values leave the recorded range, in its spans, and which share of them does; 0 without one."""
        if self.recorded is None or not np.isfinite(values).any():
            return 0.0, 0.0
        low, high = self.recorded
        known = values[np.isfinite(values)]
        slack = np.maximum(low - known, known - high)
        span = max(high - low, 1e-9 * max(abs(low), abs(high)), 1e-300)
        return max(float(np.max(slack)) / span, 0.0), float(np.mean(slack > 0.0))


@dataclass(frozen=True, kw_only=True)
class Block:
    """One link of the chain.

    Attributes
    ----------
    name : str
        What it is, in the reader's terms.
    place : {"actuator", "plant", "sensor"}
        Where in the rig it sits.
    dynamics : TransferFunction
        Proper transfer function with its dead time.
    output, unit : str
        Name and unit of the block's output signal, empty where not given.
    """

    name: str
    place: Place
    dynamics: TransferFunction
    output: str = ""
    unit: str = ""

    @property
    def is_speed(self) -> bool:
        """Whether the output of a first-order block is a speed, by its name or unit."""
        said = f"{self.name} {self.output}".lower()
        return len(self.dynamics.den) == 2 and bool(_SPEED.search(said) or _SPEED_UNIT.search(self.unit.lower()))


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A value with its standard deviation and unit; the standard deviation is NaN where it is not known."""

    value: float
    unit: str = ""
    sd: float = float("nan")


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Physics added to a model: an entry ``PLACE.EFFECT`` of the catalogue, where it acts, its parameters.

    Attributes
    ----------
    name, at : str
        The catalogue's name, and where in a chain it acts.
    parameters : mapping of str to Parameter
        Its parameters.
    state, input, port, column : str
        The state, input, port or recorded column that it acts on, in models of equations or with several inputs.
    """

    name: str
    at: str = ""
    parameters: Mapping[str, Parameter] = field(default_factory=lambda: MappingProxyType({}))
    state: str = ""
    input: str = ""
    port: str = ""
    column: str = ""

    @property
    def values(self) -> dict[str, float]:
        """Its parameters as numbers."""
        return {key: q.value for key, q in self.parameters.items()}

    def with_values(self, values: Mapping[str, float]) -> Effect:
        """Return it with other values of some parameters, whose units and standard deviations stay."""
        if not values:
            return self
        new = {key: replace(self.parameters[key], value=value) for key, value in values.items()}
        return replace(self, parameters=MappingProxyType({**self.parameters, **new}))


@dataclass(frozen=True, kw_only=True)
class Model:
    """A chain of blocks in series, with the effects that were added to it."""

    name: str
    input: Port
    output: Port
    blocks: tuple[Block, ...]
    effects: tuple[Effect, ...] = ()

    def transfer_function(self) -> TransferFunction:
        """Return the product of the blocks: the small-signal model, without the effects."""
        product = TransferFunction(num=(1.0,), den=(1.0,))
        for block in self.blocks:
            product = product * block.dynamics
        return product

    @property
    def plant_input_unit(self) -> str:
        """Unit of the plant's input: an actuator's output as far as one is stated, else the command's."""
        return next((b.unit for b in self.blocks if b.place == "actuator" and b.unit), self.input.unit)

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return the complex gain from u to y, effects left out, same shape as ``omega_rad_s``."""
        product = np.ones_like(np.asarray(omega_rad_s), dtype=np.complex128)
        for block in self.blocks:
            product = product * block.dynamics.response(omega_rad_s)
        return product


def read_model(path: str | os.PathLike[str]) -> Model:
    """Read a model file.

    Raises
    ------
    InputError
        No such file, not TOML, an unknown key or place, or a block that is not proper; names the table and the key.
    """
    return model_of(read_toml(path), str(path))


def model_of(content: Mapping[str, Any], where: str) -> Model:
    """Return the chain that a TOML content states; ``where`` names it in messages."""
    require_keys(content, {"name", "input", "output", "block", "effect", "reduced"}, where)
    blocks, effects = _tables(content, "block", where), _tables(content, "effect", where)
    if not blocks:
        raise InputError("no [[block]]", where=where, remedy="a model needs at least one block")
    return Model(
        name=_text(content, "name", Path(where).stem, where),
        input=_port(content.get("input", {}), f"{where} [input]"),
        output=_port(content.get("output", {}), f"{where} [output]"),
        blocks=tuple(_block(table, f"{where} [[block]] {i + 1}") for i, table in enumerate(blocks)),
        effects=tuple(effect_of(table, f"{where} [[effect]] {i + 1}") for i, table in enumerate(effects)),
    )


def _tables(content: Mapping[str, Any], key: str, where: str) -> list[Any]:
    tables = content.get(key, [])
    if not isinstance(tables, list):
        raise InputError(f"{key} = {_shown(tables)}", where=where, remedy=f"write tables [[{key}]]")
    if len(tables) > MOST_BLOCKS:
        raise InputError(f"{len(tables)} [[{key}]]", where=where, remedy=f"give at most {MOST_BLOCKS}")
    return tables


def _text(table: Mapping[str, Any], key: str, default: str, where: str) -> str:
    value = table.get(key, default)
    if not isinstance(value, str) or len(value) > 200:
        raise InputError(f"{key} = {_shown(value)}", where=where, remedy="write a text of at most 200 characters")
    return value


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def require_keys(table: Any, keys: set[str], where: str) -> None:
    """Refuse what is no table, and a table with a key that is none of those known."""
    if not isinstance(table, Mapping):
        raise InputError(f"{_shown(table)} is no table", where=where, remedy=f"write keys: {', '.join(sorted(keys))}")
    for key in table:
        if key not in keys:
            raise InputError(f"unknown key {_shown(key)}", where=where, remedy=f"known are {', '.join(sorted(keys))}")


def _real(value: Any, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise InputError(f"{key} = {_shown(value)}", where=where, remedy=f"write a number within +-{LARGEST:g}")
    if 0.0 < abs(value) < SMALLEST:
        raise InputError(f"{key} = {value!r}", where=where, remedy=f"write 0, or a size of at least {SMALLEST:g}")
    return float(value)


def _port(table: Mapping[str, Any], where: str) -> Port:
    require_keys(table, {"unit", "offset", "hold", "recorded"}, where)
    hold = table.get("hold", "zero")
    if hold not in get_args(Hold):
        raise InputError(f"hold = {_shown(hold)}", where=where, remedy='write "zero" (held command) or "linear"')
    return Port(
        unit=_text(table, "unit", "", where),
        offset=_real(table.get("offset", 0.0), "offset", where),
        hold=hold,
        recorded=_range(table["recorded"], where) if "recorded" in table else None,
    )


def _range(values: Any, where: str) -> tuple[float, float]:
    if not isinstance(values, list) or len(values) != 2:
        raise InputError(f"recorded = {_shown(values)}", where=where, remedy="write [lowest, highest]")
    low, high = (_real(value, "recorded", where) for value in values)
    if low > high:
        raise InputError(f"recorded = {_shown(values)}", where=where, remedy="write [lowest, highest]")
    return low, high


def _block(table: Mapping[str, Any], where: str) -> Block:
    require_keys(table, {"name", "place", "num", "den", "delay", "output", "unit"}, where)
    place = table.get("place", "plant")
    if place not in get_args(Place):
        raise InputError(f"place = {_shown(place)}", where=where, remedy=f"write one of {', '.join(get_args(Place))}")
    coefficients = {}
    for key in ("num", "den"):
        values = table.get(key, [1.0])
        if not isinstance(values, list) or not 0 < len(values) <= MOST_COEFFICIENTS:
            raise InputError(
                f"{key} = {_shown(values)}",
                where=where,
                remedy=f"write a list of 1 to {MOST_COEFFICIENTS} numbers in descending powers of s",
            )
        coefficients[key] = tuple(_real(value, key, where) for value in values)
    try:
        dynamics = TransferFunction(**coefficients, delay_s=_real(table.get("delay", 0.0), "delay", where))
    except InputError as error:
        raise InputError(error.what, where=where) from None
    if not dynamics.is_proper:
        raise InputError("num has a higher degree than den", where=where, remedy="a block must be proper")
    return Block(
        name=_text(table, "name", place, where),
        place=place,
        dynamics=dynamics,
        output=_text(table, "output", "", where),
        unit=_text(table, "unit", "", where),
    )


def effect_of(table: Mapping[str, Any], where: str) -> Effect:
    """Return the effect that an ``[[effect]]`` table states; ``where`` names it in messages."""
    acts = ("at", "state", "input", "port", "column")
    require_keys(table, {"name", "parameters", "equation", *acts}, where)
    name = _text(table, "name", "", where)
    if "." not in name:
        raise InputError(f"name = {_shown(name)}", where=where, remedy="write PLACE.EFFECT of the catalogue")
    parameters = {}
    written = table.get("parameters", {})
    if not isinstance(written, dict):
        raise InputError(f"parameters = {_shown(written)}", where=where, remedy="write a table of parameters")
    for key, entry in written.items():
        given = entry if isinstance(entry, dict) else {"value": entry}
        sd = _real(given["sd"], f"{key}.sd", where) if "sd" in given else float("nan")
        parameters[key] = Parameter(
            value=_real(given.get("value"), key, where), unit=_text(given, "unit", "", where), sd=sd
        )
    places = {key: _text(table, key, "", where) for key in acts if key in table}
    return Effect(name=name, parameters=MappingProxyType(parameters), **places)


def write_model(model: Model, path: str | os.PathLike[str], equations: Mapping[str, str] | None = None) -> None:
    """Write a model file that :func:`read_model` reads back to an equal model.

    Parameters
    ----------
    model : Model
        What to write.
    path : path
        Where to.
    equations : mapping of effect name to equation, optional
        Written into the ``[[effect]]`` tables for the reader; not read back.
    """
    write_whole(path, tomli_w.dumps(model_content(model, equations)))


def model_content(model: Model, equations: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the tables of a model file, as :func:`write_model` writes them."""
    content: dict[str, Any] = {
        "name": model.name,
        "input": _port_table(model.input),
        "output": _port_table(model.output),
        "block": [_block_table(block) for block in model.blocks],
    }
    if model.effects:
        content["effect"] = [effect_table(effect, (equations or {}).get(effect.name)) for effect in model.effects]
    return content


def _port_table(port: Port) -> dict[str, Any]:
    table: dict[str, Any] = {"unit": port.unit, "offset": port.offset}
    table |= {"hold": port.hold} if port.hold != "zero" else {}
    return table | ({"recorded": list(port.recorded)} if port.recorded is not None else {})


def _block_table(block: Block) -> dict[str, Any]:
    table: dict[str, Any] = {
        "name": block.name,
        "place": block.place,
        "num": list(block.dynamics.num),
        "den": list(block.dynamics.den),
    }
    optional = {"delay": block.dynamics.delay_s, "output": block.output, "unit": block.unit}
    return table | {key: value for key, value in optional.items() if value}


def effect_table(effect: Effect, equation: str | None) -> dict[str, Any]:
    """Return the ``[[effect]]`` table of an effect, with its equation for the reader."""
    table: dict[str, Any] = {"name": effect.name}
    places = {key: getattr(effect, key) for key in ("at", "state", "input", "port", "column")}
    table |= {key: value for key, value in places.items() if value}
    if equation:
        table["equation"] = equation
    table["parameters"] = {
        key: {"value": parameter.value, "unit": parameter.unit}
        | ({"sd": parameter.sd} if np.isfinite(parameter.sd) else {})
        for key, parameter in effect.parameters.items()
    }
    return table
