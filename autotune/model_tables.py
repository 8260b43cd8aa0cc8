"""Model files of chains of blocks: tables in, a :class:`autotune.models.Model` out, and back."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args

import numpy as np
import tomli_w

from autotune.errors import InputError
from autotune.models import (
    LARGEST,
    MOST_BLOCKS,
    MOST_COEFFICIENTS,
    SMALLEST,
    Block,
    Effect,
    Hold,
    Model,
    Parameter,
    Place,
    Port,
    TransferFunction,
)
from autotune.text_files import read_toml
from autotune.whole_files import write_whole


def read_model(path: str | os.PathLike[str]) -> Model:
    """Read a model file.

    Raises
    ------
    InputError
        No such file, not TOML, an unknown key or place, or a block that is not proper; names the table and the key.
    """
    return model_of(read_toml(path), str(path))


def model_of(content: Mapping[str, Any], where: str) -> Model:
    """Return the chain that a TOML content states.

    Parameters
    ----------
    content : mapping
        The decoded TOML.
    where : str
        Names it in messages.

    Raises
    ------
    InputError
        A key that is not known, or a value that no model has; names it.
    """
    if "num" in content or "den" in content:  # what everybody writes first
        raise InputError(
            "num and den stand outside of a table",
            where=where,
            remedy="write [[block]] above them, and the dead time [s] as delay",
        )
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
        raise InputError(f"{key} = {_as_text(tables)}", where=where, remedy=f"write tables [[{key}]]")
    if len(tables) > MOST_BLOCKS:
        raise InputError(f"{len(tables)} [[{key}]]", where=where, remedy=f"give at most {MOST_BLOCKS}")
    return tables


def _text(table: Mapping[str, Any], key: str, default: str, where: str) -> str:
    value = table.get(key, default)
    if not isinstance(value, str) or len(value) > 200:
        raise InputError(f"{key} = {_as_text(value)}", where=where, remedy="write a text of at most 200 characters")
    return value


def _as_text(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def require_keys(table: Any, keys: set[str], where: str) -> None:
    """Refuse what is no table, and a table with a key that is none of those known.

    Parameters
    ----------
    table : object
        What a file states.
    keys : set of str
        Those that are known.
    where : str
        Names the file and the table in messages.

    Raises
    ------
    InputError
        Names the key.
    """
    if not isinstance(table, Mapping):
        raise InputError(f"{_as_text(table)} is no table", where=where, remedy=f"write keys: {', '.join(sorted(keys))}")
    for key in table:
        if key not in keys:
            raise InputError(f"unknown key {_as_text(key)}", where=where, remedy=f"known are {', '.join(sorted(keys))}")


def _real(value: Any, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise InputError(f"{key} = {_as_text(value)}", where=where, remedy=f"write a number within +-{LARGEST:g}")
    if 0.0 < abs(value) < SMALLEST:
        raise InputError(f"{key} = {value!r}", where=where, remedy=f"write 0, or a size of at least {SMALLEST:g}")
    return float(value)


def _port(table: Mapping[str, Any], where: str) -> Port:
    require_keys(table, {"unit", "offset", "hold", "recorded"}, where)
    hold = table.get("hold", "zero")
    if hold not in get_args(Hold):
        raise InputError(f"hold = {_as_text(hold)}", where=where, remedy='write "zero" (held command) or "linear"')
    return Port(
        unit=_text(table, "unit", "", where),
        offset=_real(table.get("offset", 0.0), "offset", where),
        hold=hold,
        recorded=_range(table["recorded"], where) if "recorded" in table else None,
    )


def _range(values: Any, where: str) -> tuple[float, float]:
    if not isinstance(values, list) or len(values) != 2:
        raise InputError(f"recorded = {_as_text(values)}", where=where, remedy="write [lowest, highest]")
    low, high = (_real(value, "recorded", where) for value in values)
    if low > high:
        raise InputError(f"recorded = {_as_text(values)}", where=where, remedy="write [lowest, highest]")
    return low, high


def _block(table: Mapping[str, Any], where: str) -> Block:
    require_keys(table, {"name", "place", "num", "den", "delay", "output", "unit"}, where)
    place = table.get("place", "plant")
    if place not in get_args(Place):
        raise InputError(f"place = {_as_text(place)}", where=where, remedy=f"write one of {', '.join(get_args(Place))}")
    coefficients = {}
    for key in ("num", "den"):
        values = table.get(key, [1.0])
        if not isinstance(values, list) or not 0 < len(values) <= MOST_COEFFICIENTS:
            raise InputError(
                f"{key} = {_as_text(values)}",
                where=where,
                remedy=f"write a list of 1 to {MOST_COEFFICIENTS} numbers in descending powers of s",
            )
        coefficients[key] = tuple(_real(value, key, where) for value in values)
    try:
        dynamics = TransferFunction(**coefficients, delay_s=_real(table.get("delay", 0.0), "delay", where))
    except InputError as error:
        raise InputError(error.what, where=where) from None
    if not any(dynamics.num):
        raise InputError("num is 0: nothing comes through this block", where=where, remedy="write its gain")
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
    """Return the effect that an ``[[effect]]`` table states.

    Parameters
    ----------
    table : mapping
        The decoded TOML.
    where : str
        Names it in messages.

    Raises
    ------
    InputError
        A key that is not known, or a value that no effect has; names it.
    """
    acts = ("at", "state", "input", "port", "column")
    require_keys(table, {"name", "parameters", "equation", *acts}, where)
    name = _text(table, "name", "", where)
    if "." not in name:
        raise InputError(f"name = {_as_text(name)}", where=where, remedy="write PLACE.EFFECT of the catalogue")
    parameters = {}
    written = table.get("parameters", {})
    if not isinstance(written, dict):
        raise InputError(f"parameters = {_as_text(written)}", where=where, remedy="write a table of parameters")
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
    """Return the tables of a model file, as :func:`write_model` writes them.

    Parameters
    ----------
    model : Model
        The chain.
    equations : mapping of str to str, optional
        For the reader, the equation of an effect by its name.
    """
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
    """Return the ``[[effect]]`` table of an effect, with its equation for the reader.

    Parameters
    ----------
    effect : Effect
        With its parameters; a standard deviation that is not known is left out.
    equation : str or None
        For the reader alone.
    """
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
