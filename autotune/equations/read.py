"""Model files of equations: read with every key checked, and written back."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import tomli_w

from autotune.equations.expressions import Expression, parse, to_text
from autotune.equations.model import (
    INPUT_KINDS,
    PORT_KINDS,
    SPREAD,
    STATE_KINDS,
    EquationModel,
    InputColumn,
    ModelParameter,
    ModelPort,
    State,
)
from autotune.equations.units import check_units
from autotune.errors import InputError
from autotune.model_tables import effect_of, effect_table, require_keys
from autotune.models import Hold
from autotune.text_files import read_toml
from autotune.whole_files import write_whole

_TOP = {"name", "input", "output", "state", "parameters", "define", "port", "horizon_s", "effect"}


def read_equations(path: str | os.PathLike[str]) -> EquationModel:
    """Read a model file of equations.

    Parameters
    ----------
    path : path
        TOML with ``[[state]]`` tables.

    Returns
    -------
    EquationModel
        With names, loops and units checked.

    Raises
    ------
    InputError
        What is wrong, in which table, and how to fix it.
    """
    return equations_of(read_toml(path), str(path))


def equations_of(content: Mapping[str, Any], where: str) -> EquationModel:
    """Return the model that a TOML content states.

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
    require_keys(content, _TOP, where)
    states = _tables(content, "state", where)
    if not states:
        raise InputError("no [[state]]", where=where, remedy="equations need at least one state with its derivative")
    inputs = _tables(content, "input", where)
    if not inputs:
        raise InputError("no [[input]]", where=where, remedy='name the command: [[input]] column = "u"')
    output = _table(content, "output", where)
    require_keys(output, {"value", "unit"}, f"{where} [output]")
    horizon = content.get("horizon_s")
    model = EquationModel(
        name=str(content.get("name", Path(where).stem)),
        inputs=tuple(input_of(one, f"{where} [[input]] {i + 1}") for i, one in enumerate(inputs)),
        output=_expression(output, "value", f"{where} [output]"),
        output_unit=_text(output, "unit", f"{where} [output]"),
        states=tuple(_state(one, f"{where} [[state]] {i + 1}") for i, one in enumerate(states)),
        parameters=tuple(parameter_of(n, one, where) for n, one in _table(content, "parameters", where).items()),
        defines=tuple(
            (name, parse(_scalar(text, f"{where} [define] {name}"), f"{where} [define] {name}"))
            for name, text in _table(content, "define", where).items()
        ),
        ports=tuple(_port(one, f"{where} [[port]] {i + 1}") for i, one in enumerate(_tables(content, "port", where))),
        horizon_s=None if horizon is None else _positive(horizon, "horizon_s", where),
        effects=tuple(
            effect_of(one, f"{where} [[effect]] {i + 1}") for i, one in enumerate(_tables(content, "effect", where))
        ),
    )
    check_units(model)
    return model


def _tables(content: Mapping[str, Any], key: str, where: str) -> list[Mapping[str, Any]]:
    given = content.get(key, [])
    if not isinstance(given, list) or not all(isinstance(one, dict) for one in given):
        raise InputError(f"[{key}] is one table", where=where, remedy=f"write [[{key}]] for each of them")
    return given


def _table(content: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    given = content.get(key, {})
    if not isinstance(given, dict):
        raise InputError(f"{key} is no table", where=where, remedy=f"write [{key}]")
    return given


def _scalar(value: Any, where: str) -> str:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise InputError(f"{value!r} is no expression", where=where, remedy='write it as text: "a*x + b"')
    return str(value)


def _expression(table: Mapping[str, Any], key: str, where: str) -> Expression:
    if key not in table:
        raise InputError(f"{key} is missing", where=where, remedy=f'add {key} = "expression"')
    return parse(_scalar(table[key], f"{where} {key}"), f"{where} {key}")


def _text(table: Mapping[str, Any], key: str, where: str, default: str = "") -> str:
    value = table.get(key, default)
    if not isinstance(value, str):
        raise InputError(f"{key} = {value!r}", where=where, remedy="write a text")
    return value


def _name(table: Mapping[str, Any], key: str, where: str) -> str:
    if not table.get(key):
        raise InputError(f"{key} is missing", where=where, remedy=f'add {key} = "..."')
    return _text(table, key, where)


def _one_of(table: Mapping[str, Any], key: str, known: tuple[str, ...], default: str, where: str) -> Any:
    value = table.get(key, default)
    if value not in known:
        raise InputError(f"{key} = {value!r}", where=where, remedy=f"write one of {', '.join(k for k in known if k)}")
    return value


def _real(value: Any, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < float("inf"):
        raise InputError(f"{key} = {value!r}", where=where, remedy="write a finite number")
    return float(value)


def _positive(value: Any, key: str, where: str) -> float:
    if not _real(value, key, where) > 0.0:
        raise InputError(f"{key} = {value!r}", where=where, remedy="write a positive number")
    return float(value)


def input_of(table: Mapping[str, Any], where: str) -> InputColumn:
    """Return the input that an ``[[input]]`` table states.

    Parameters
    ----------
    table : mapping
        The decoded TOML.
    where : str
        Names it in messages.

    Raises
    ------
    InputError
        A key that is not known, or a value that no input has; names it.
    """
    require_keys(table, {"column", "unit", "hold", "kind", "delay", "offset"}, where)
    delay = _real(table.get("delay", 0.0), "delay", where)
    if delay < 0.0:
        raise InputError(f"delay = {delay:g} s is negative", where=where, remedy="write seconds, 0 or more")
    return InputColumn(
        column=_name(table, "column", where),
        unit=_text(table, "unit", where),
        hold=_one_of(table, "hold", get_args(Hold), "zero", where),
        kind=_one_of(table, "kind", INPUT_KINDS, "", where),
        delay_s=delay,
        offset=_real(table.get("offset", 0.0), "offset", where),
    )


def _state(table: Mapping[str, Any], where: str) -> State:
    require_keys(table, {"name", "unit", "kind", "of", "derivative", "start"}, where)
    return State(
        name=_name(table, "name", where),
        derivative=_expression(table, "derivative", where),
        unit=_text(table, "unit", where),
        kind=_one_of(table, "kind", STATE_KINDS, "other", where),
        of=_text(table, "of", where),
        start=None if "start" not in table else _real(table["start"], "start", where),
    )


def parameter_of(name: str, given: Any, where: str) -> ModelParameter:
    """Return the parameter that a ``[parameters.NAME]`` table, or a number alone, states.

    Parameters
    ----------
    name : str
        Of the parameter.
    given : object
        The table, or the number.
    where : str
        Names the file in messages.

    Raises
    ------
    InputError
        A key that is not known, or a value that no parameter has; names it.
    """
    where = f"{where} [parameters.{name}]"
    table = given if isinstance(given, dict) else {"value": given}
    require_keys(table, {"value", "unit", "spread", "fixed", "sd"}, where)
    if "value" not in table:
        raise InputError("value is missing", where=where, remedy="add value = NUMBER")
    fixed = table.get("fixed", False)
    if not isinstance(fixed, bool):
        raise InputError(f"fixed = {fixed!r}", where=where, remedy="write true or false")
    spread = _real(table.get("spread", SPREAD), "spread", where)
    if spread < 0.0:
        raise InputError(f"spread = {spread:g}", where=where, remedy="write a relative standard deviation, 0 or more")
    return ModelParameter(
        name=name,
        value=_real(table["value"], "value", where),
        unit=_text(table, "unit", where),
        spread=0.0 if fixed else spread,
    )


def _port(table: Mapping[str, Any], where: str) -> ModelPort:
    require_keys(table, {"name", "kind", "across", "unit"}, where)
    return ModelPort(
        name=_name(table, "name", where),
        kind=_one_of(table, "kind", PORT_KINDS, "", where),
        across=_expression(table, "across", where) if "across" in table else None,
        unit=_text(table, "unit", where),
    )


def write_equations(
    model: EquationModel, path: str | os.PathLike[str], equations: Mapping[str, str] | None = None
) -> None:
    """Write a model file that :func:`read_equations` reads back to an equal model.

    Parameters
    ----------
    model : EquationModel
        What to write.
    path : path
        Where to.
    equations : mapping of effect name to equation, optional
        Written into the ``[[effect]]`` tables for the reader; not read back.
    """
    write_whole(path, tomli_w.dumps(content_of(model, equations)))


def content_of(model: EquationModel, equations: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the TOML content of a model.

    Parameters
    ----------
    model : EquationModel
        What is written.
    equations : mapping of str to str, optional
        For the reader, the equation of an effect by its name.
    """
    content: dict[str, Any] = {"name": model.name}
    if model.horizon_s is not None:
        content["horizon_s"] = model.horizon_s
    content["input"] = [_input_table(one) for one in model.inputs]
    content["output"] = {"value": to_text(model.output)} | _drop_empty(unit=model.output_unit)
    if model.defines:
        content["define"] = {name: to_text(tree) for name, tree in model.defines}
    content["state"] = [_state_table(one) for one in model.states]
    if model.ports:
        content["port"] = [
            {"name": one.name, "kind": one.kind}
            | ({} if one.across is None else {"across": to_text(one.across)})
            | _drop_empty(unit=one.unit)
            for one in model.ports
        ]
    if model.parameters:
        content["parameters"] = {
            one.name: {"value": one.value}
            | _drop_empty(unit=one.unit)
            | ({"fixed": True} if one.spread == 0.0 else {} if one.spread == SPREAD else {"spread": one.spread})
            for one in model.parameters
        }
    if model.effects:
        content["effect"] = [effect_table(one, (equations or {}).get(one.name)) for one in model.effects]
    return content


def _drop_empty(**entries: Any) -> dict[str, Any]:
    return {key: value for key, value in entries.items() if value}


def _input_table(one: InputColumn) -> dict[str, Any]:
    hold = "" if one.hold == "zero" else one.hold
    return {"column": one.column} | _drop_empty(
        unit=one.unit, hold=hold, kind=one.kind, delay=one.delay_s, offset=one.offset
    )


def _state_table(one: State) -> dict[str, Any]:
    kind = "" if one.kind == "other" else one.kind
    table = {"name": one.name, "derivative": to_text(one.derivative)} | _drop_empty(unit=one.unit, kind=kind, of=one.of)
    return table | ({} if one.start is None else {"start": one.start})
