"""The text of a configuration that ``autotune init`` writes: every key with its description, defaults as comments."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from autotune.cli.init_keys import Table

if TYPE_CHECKING:
    from pydantic import BaseModel


def text_of(content: Table, path: Path) -> str:
    """Return the text of a configuration: every key with its description, those left at their defaults as comments.

    Parameters
    ----------
    content : dict
        The configuration.
    path : Path
        The file, for its first line.
    """
    from autotune.config import Config

    lines = [f"# {path.name}: what autotune run does, and on what. A line that begins with #: is a default."]
    lines += ["# autotune schema --out config.schema.json lets editors complete the keys.", ""]
    plain = {name: field for name, field in Config.model_fields.items() if _model(field.annotation, {}) is None}
    lines += [f"{name} = {_value(content[name])}" for name in plain if name in content]
    for name, field in Config.model_fields.items():
        if name in plain:
            continue
        model = _model(field.annotation, content.get(name, {}))
        if model is not None:
            lines += _section(name, model, content.get(name))
    return "\n".join(lines) + "\n"


def _model(annotation: Any, given: Mapping[str, Any]) -> type[BaseModel] | None:
    """Return the settings that a key holds: of the kinds of a union the one that was given."""
    from pydantic import BaseModel

    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        kinds = annotation.model_fields.get("kind")
        return None if kinds and "kind" in given and given["kind"] not in get_args(kinds.annotation) else annotation
    models = (_model(part, given) for part in get_args(annotation))
    return next((model for model in models if model is not None), None)


def _section(path: str, model: type[BaseModel], given: Mapping[str, Any] | None) -> list[str]:
    """Return a table and the tables in it; a table that was not given stays a comment."""
    given_here = given or {}
    written, after = [], []
    for name, field in sorted(model.model_fields.items(), key=lambda named: named[0] != "kind"):
        inner = None if path.endswith(("registers", "nodes", "rig.signals")) else _model(field.annotation, {})
        if inner is not None and not isinstance(given_here.get(name), list | tuple):
            if name in given_here:
                after += _section(f"{path}.{name}", inner, given_here[name])
            continue
        value = given_here.get(name, field.default)
        shown = "" if value is None or (field.is_required() and name not in given_here) else f" {_value(value)}"
        mark = "" if name in given_here else "#: "
        written.append((f"{mark}{name} ={shown}", field.description or "how the rig is reached"))
    head = f"[{path}]" if given is not None else f"#: [{path}]"
    width = min(max((len(line) for line, _ in written), default=0), 44)
    says = " ".join((model.__doc__ or "").replace("``", "").split())
    return ["", f"# {says}", head, *(f"{line:<{width}}  # {text}".rstrip(" #") for line, text in written), *after]


def _value(value: Any) -> str:
    """Return a value as TOML writes it, on one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(one)}" for key, one in value.items()) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_value(one) for one in value) + "]"
    return json.dumps(value, ensure_ascii=False)
