"""What ``autotune init`` takes besides its questions: any register of the map, any key of the configuration."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from typing import Any

from autotune.errors import InputError

Table = dict[str, Any]

#: how a register is written
REGISTER = "TABLE:ADDRESS[:TYPE][,KEY=VALUE...]"


def register(answer: str) -> Table:
    """Return a register from what a person writes of it, e.g. ``holding:10:float32,word_order=little``.

    Raises
    ------
    InputError
        It is not of that form.
    """
    place, *keys = answer.split(",")
    parts = [part.strip() for part in place.split(":")]
    if not 2 <= len(parts) <= 3 or not parts[1].isdigit():
        raise InputError(
            f"{answer!r}: {REGISTER} is wanted", where="register", remedy="e.g. input:0:int16,scale=0.01 or coil:3"
        )
    found: Table = {"table": parts[0], "address": int(parts[1])}
    if len(parts) == 3:
        found["type"] = parts[2]
    for key in keys:
        name, value = _assignment(key, "register")
        found[name] = value
    return found


def add_registers(registers: Table, given: Iterable[str]) -> None:
    """Put ``NAME=REGISTER`` into a register map; ``gains.NAME`` is a setting in a maker's form.

    Parameters
    ----------
    registers : dict
        The map as far as it is written; changed in place.
    given : iterable of str
        The options, ``NAME=REGISTER``.

    Raises
    ------
    InputError
        One is not of that form, or names a signal twice.
    """
    for one in given:
        name, equals, place = one.partition("=")
        name = name.strip()
        if not equals or not name:
            raise InputError(f"{one!r}: NAME={REGISTER} is wanted", where="--register", remedy="e.g. enable=coil:0")
        at = registers
        if name.startswith("gains."):
            name = name.removeprefix("gains.")
            at = registers.setdefault("gains", {}).setdefault("settings", {})
        if name in at:
            raise InputError(f"{name} is given twice", where="--register", remedy="give each signal once")
        at[name] = register(place)


def set_keys(content: Table, given: Iterable[str]) -> None:
    """Set ``PATH.TO.KEY=VALUE`` in a configuration; what is no TOML value is taken as text.

    Parameters
    ----------
    content : dict
        The configuration as far as it is written; changed in place.
    given : iterable of str
        The options, ``PATH.TO.KEY=VALUE``.

    Raises
    ------
    InputError
        One is not of that form, or leads through a key that is no table.
    """
    for one in given:
        path, value = _assignment(one, "--set")
        *tables, key = path.split(".")
        at: Any = content
        for name in tables:
            at = at.setdefault(name, {})
            if not isinstance(at, dict):
                raise InputError(
                    f"{path!r}: {name} is no table", where="--set", remedy="autotune schema lists the keys"
                )
        at[key] = value


def _assignment(text: str, where: str) -> tuple[str, Any]:
    key, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not key or not value:
        raise InputError(f"{text!r}: KEY=VALUE is wanted", where=where, remedy="e.g. scale=0.1")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value
