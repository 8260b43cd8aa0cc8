"""TOML to validated settings; a refused key is named by its path, its allowed range and its nearest known name."""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from autotune.config.procedure import (
    ControllerSettings,
    DesignSettings,
    ExperimentSettings,
    LimitSettings,
    OperatingPointSettings,
    Section,
    SignalSettings,
    VerificationSettings,
)
from autotune.config.rig import RigSettings
from autotune.errors import InputError

Root = TypeVar("Root", bound=BaseModel)


class Config(Section):
    """One complete file per rig and per use."""

    name: str
    rig: RigSettings
    signals: SignalSettings
    limits: LimitSettings
    operating_point: OperatingPointSettings
    experiment: ExperimentSettings = ExperimentSettings()
    design: DesignSettings = DesignSettings()
    controller: ControllerSettings | None = None
    verification: VerificationSettings = VerificationSettings()


def load_config(path: str | os.PathLike[str]) -> Config:
    """Read and validate a configuration file.

    Raises
    ------
    InputError
        No such file, not TOML, or the first key that was refused: its path, the allowed range, the nearest known key.
    """
    where = str(path)
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=where, remedy="check the path") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"not TOML: {error}", where=where) from None
    return validated(Config, content, where)


def validated(root: type[Root], content: Mapping[str, Any], where: str) -> Root:
    """Return the settings that a table of keys holds.

    Parameters
    ----------
    root : type
        The settings asked for.
    content : mapping
        Keys and values, as TOML gives them.
    where : str
        The file, for messages.

    Raises
    ------
    InputError
        The first key that was refused: its path, the allowed range, the nearest known key.
    """
    try:
        return root.model_validate(content)
    except ValidationError as error:
        raise _refusal(error, root, where) from None


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the configuration, for editors that complete keys."""
    return Config.model_json_schema() | {"$schema": "https://json-schema.org/draft/2020-12/schema"}


def _refusal(error: ValidationError, root: type[BaseModel], where: str) -> InputError:
    details = error.errors(include_url=False)
    first = next((d for d in details if d["type"] == "extra_forbidden"), details[0])
    path = ".".join(str(part) for part in _key_path(first))
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    if first["type"] == "extra_forbidden":
        key = str(first["loc"][-1])
        known = _known_keys(root, _key_path(first)[:-1])
        near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
        remedy = f"did you mean {near[0]!r}?" if near else f"known keys here: {', '.join(known)}"
        return InputError(f"unknown key {path!r}{more}", where=where, remedy=remedy)
    if first["type"] == "missing":
        return InputError(f"{path!r} is missing{more}", where=where, remedy=_describe(root, _key_path(first)))
    value = first.get("input")
    shown = f" = {value!r}" if isinstance(value, str | int | float | bool) else ""
    reason = first["msg"].removeprefix("Value error, ")
    key = f"{path}{shown}: " if path else ""  # what holds between keys of the whole file has no path
    return InputError(f"{key}{reason}{more}", where=where, remedy=_describe(root, _key_path(first)))


def _key_path(detail: ErrorDetails) -> tuple[str | int, ...]:
    """Drop the tags that pydantic puts into a path for the kinds of a union."""
    from autotune.config.rig import RIG_KINDS

    return tuple(part for i, part in enumerate(detail["loc"]) if not (i == 1 and part in RIG_KINDS))


def _section(root: type[BaseModel], path: tuple[str | int, ...]) -> list[type[BaseModel]]:
    """Return the models that a path can lead to: one, or the kinds of a union."""
    models: list[type[BaseModel]] = [root]
    for part in path:
        if isinstance(part, int):
            continue
        found = []
        for model in models:
            field = model.model_fields.get(part)
            if field is not None:
                found += _models_in(field.annotation)
        models = found
    return models


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in _models_in(part)]


def _known_keys(root: type[BaseModel], path: tuple[str | int, ...]) -> list[str]:
    return sorted({key for model in _section(root, path) for key in model.model_fields})


def _describe(root: type[BaseModel], path: tuple[str | int, ...]) -> str:
    for model in _section(root, path[:-1]) if path else []:
        field = model.model_fields.get(str(path[-1]))
        if field is not None and field.description:
            return field.description
    return ""
