"""Tables of keys to validated settings: a refused key is named by its path, its range and its nearest known name.

Every file that can reach a rig goes through here: configurations, campaigns, controllers, designs.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from autotune.errors import InputError
from autotune.text_files import printable

Root = TypeVar("Root", bound=BaseModel)

#: Largest size of a gain or signal value, far beyond every unit and far below where arithmetic overflows.
LARGEST = 1e15
#: keys that are named beside the first one that is wrong
_MOST_NAMED = 3
#: what pydantic puts before a refusal of the project's own
_OWN = "Value error, "
#: Shortest and longest time [s]: a microsecond, thirty years.
SHORTEST_S, LONGEST_S = 1e-6, 1e9


class Section(BaseModel):
    """A table of settings: frozen; a key it does not know is refused, NaN and infinity, and a value of another type."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


#: A signal's value or a gain, finite and of a size that arithmetic can hold.
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
#: A length of time [s].
Time = Annotated[float, Field(ge=SHORTEST_S, le=LONGEST_S)]
#: What people read: at most 200 characters.
Text = Annotated[str, Field(max_length=200)]


def validate(root: type[Root], content: Mapping[str, Any], where: str, *, texts: bool = False) -> Root:
    """Return the settings that a table of keys holds.

    Parameters
    ----------
    root : type
        The settings asked for.
    content : mapping
        Keys and values, as TOML gives them.
    where : str
        The file, for messages.
    texts : bool
        Whether all values are texts, as the cells of a table are, and numbers are to be read from them.

    Raises
    ------
    InputError
        The first key that was refused: its path, the allowed range, the nearest known key.
    """
    try:
        # strict as of JSON: an array is a tuple, and a whole number is a number; a text or true is none
        if texts:
            return root.model_validate(content)
        return root.model_validate_json(json.dumps(content, default=str), strict=True)
    except ValidationError as error:
        raise _refusal(error, root, where) from None


def _refusal(error: ValidationError, root: type[BaseModel], where: str) -> InputError:
    details = _without_misspelt(error.errors(include_url=False), root)
    first = next((d for d in details if d["type"] == "extra_forbidden"), details[0])
    what, remedy = _what_is_wrong(first, root)
    others = [_named(_key_path(one, root)) or one["msg"].removeprefix(_OWN) for one in details if one is not first]
    if others:
        rest = f" and {len(others) - _MOST_NAMED} more" if len(others) > _MOST_NAMED else ""
        what += f" (also wrong: {', '.join(others[:_MOST_NAMED])}{rest})"
    return InputError(what, where=where, remedy=remedy)


def _without_misspelt(details: list[ErrorDetails], root: type[BaseModel]) -> list[ErrorDetails]:
    """Leave out keys that are missing because they are misspelt: they are said once, as the unknown key."""
    meant = set()
    for detail in details:
        if detail["type"] == "extra_forbidden":
            *table, key = _key_path(detail, root)
            meant |= {(*table, near) for near in _nearest(str(key), _known_keys(root, tuple(table)))}
    return [one for one in details if one["type"] != "missing" or _key_path(one, root) not in meant]


def _what_is_wrong(detail: ErrorDetails, root: type[BaseModel]) -> tuple[str, str]:
    """Return what is wrong with a key, and the remedy."""
    at, given = _key_path(detail, root), detail.get("ctx", {})
    match detail["type"]:
        case "extra_forbidden":
            known = _known_keys(root, at[:-1])
            near = _nearest(str(detail["loc"][-1]), known)
            remedy = f"did you mean {near[0]!r}?" if near else f"known keys here: {', '.join(known)}"
            return f"unknown key {_named(at)!r}", remedy
        case "union_tag_invalid":
            kinds = str(given["expected_tags"]).replace("'", "")
            near = _nearest(str(given["tag"]), kinds.split(", "))
            remedy = f"did you mean {near[0]!r}?" if near else _describe(root, at[:-1])
            return f"{_named(at)} = {shorten(repr(given['tag']))} is none of {kinds}", remedy
        case "union_tag_not_found":
            return f"{_named(at)!r} is missing", _describe(root, at[:-1])
        case "missing":
            return f"{_named(at)!r} is missing", _describe(root, at)
    value = detail.get("input")
    shown = f" = {shorten(repr(value))}" if isinstance(value, str | int | float | bool) else ""
    key = f"{_named(at)}{shown}: " if at else ""  # what holds between keys of the whole file has no path
    return f"{key}{detail['msg'].removeprefix(_OWN)}", _describe(root, at)


def _named(path: tuple[str | int, ...]) -> str:
    return shorten(".".join(str(part) for part in path))


def _nearest(key: str, known: Sequence[str]) -> list[str]:
    return difflib.get_close_matches(key, known, n=1, cutoff=0.5)


def shorten(text: str) -> str:
    """Return a text for a message: printable, and at most 80 characters of it."""
    text = printable(text)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _key_path(detail: ErrorDetails, root: type[BaseModel]) -> tuple[str | int, ...]:
    """Drop the tags that pydantic puts into a path for the kinds of a union."""
    path: list[str | int] = []
    for i, part in enumerate(detail["loc"]):
        known = {key for model in _section(root, tuple(path)) for key in model.model_fields}
        last = i == len(detail["loc"]) - 1
        if isinstance(part, int) or part in known or not known or (last and detail["type"] == "extra_forbidden"):
            path.append(part)
    if detail["type"].startswith("union_tag_"):
        path.append(str(detail["ctx"]["discriminator"]).strip("'"))
    return tuple(path)


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
