"""Arguments checked at the door: a word that is not known is refused with the nearest one, a number with its range."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from typing import Any

from autotune.errors import InputError


def one_of(value: Any, allowed: Iterable[str], *, name: str, where: str, default: str | None = None) -> Any:
    """Return ``value`` if it is one of the allowed words, in whatever case it is written.

    Raises
    ------
    InputError
        Another word; names the nearest one.
    """
    words = list(allowed)
    if isinstance(value, str) and value.lower() in words:
        return value.lower()
    if value is None and default is not None:
        return default
    raise InputError(f"{name} = {value!r}", where=where, remedy=_nearest(value, words))


def settings_of(function: Callable[..., Any], settings: Mapping[str, Any], *, where: str) -> dict[str, Any]:
    """Return settings that all are keyword arguments of a function.

    Raises
    ------
    InputError
        One that the function does not take; names the nearest one.
    """
    known = [
        parameter.name
        for parameter in inspect.signature(function).parameters.values()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY
    ]
    for name in settings:
        if name not in known:
            raise InputError(f"no setting {name!r}", where=where, remedy=_nearest(name, known))
    return dict(settings)


def number(
    value: Any, *, name: str, where: str, above: float = -math.inf, below: float = math.inf, whole: bool = False
) -> float:
    """Return a finite number strictly between two bounds.

    Raises
    ------
    InputError
        Something else; names what is allowed.
    """
    try:
        found = float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if isinstance(value, bool | str | bytes) or not (math.isfinite(found) and above < found < below):
        low = "" if above == -math.inf else f" above {above:g}"
        high = "" if below == math.inf else f" below {below:g}"
        raise InputError(f"{name} = {value!r}", where=where, remedy=f"it must be a finite number{low}{high}")
    if whole and found != int(found):
        raise InputError(f"{name} = {value!r}", where=where, remedy="it must be a whole number")
    return found


def _nearest(value: Any, words: list[str]) -> str:
    near = get_close_matches(str(value), words, n=1, cutoff=0.5)
    listed = ", ".join(words) if words else "none"
    return f"did you mean {near[0]!r}? known are {listed}" if near else f"known are {listed}"
