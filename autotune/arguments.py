"""Arguments checked at the door: a word that is not known is refused with the nearest one, a number with its range."""

from __future__ import annotations

import inspect
import math
from collections import abc
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from difflib import get_close_matches
from functools import cache, wraps
from itertools import repeat
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from autotune.arrays import FloatArray, is_real
from autotune.errors import InputError

P = ParamSpec("P")
T = TypeVar("T")


def one_of(value: Any, allowed: Iterable[str], *, name: str, where: str) -> Any:
    """Return ``value`` if it is one of the allowed words, in whatever case it is written.

    Parameters
    ----------
    value : object
        What was given.
    allowed : iterable of str
        The words, in lower case.
    name, where : str
        The argument and the function, for the refusal.

    Raises
    ------
    InputError
        Another word; names the nearest one.
    """
    words = list(allowed)
    if isinstance(value, str) and value.lower() in words:
        return value.lower()
    raise InputError(f"{name} = {value!r}"[:200], where=where, remedy=_nearest(value, words))


def settings_of(
    function: Callable[..., Any], settings: Mapping[str, Any], *, where: str, of: Iterable[str] = ()
) -> dict[str, Any]:
    """Return settings that all are keyword arguments of a function, each of the type that the function says.

    Parameters
    ----------
    function : callable
        Its annotations are what is asked for: numbers are finite where the default is.
    settings : mapping
        What was given.
    where : str
        For the refusal.
    of : iterable of str
        The names that may be given, where they are not the keyword-only ones.

    Raises
    ------
    InputError
        One that the function does not take; names the nearest one. A value of another kind.
    """
    parameters = inspect.signature(function).parameters
    known = list(of) or [name for name, one in parameters.items() if one.kind is inspect.Parameter.KEYWORD_ONLY]
    for name in settings:
        if name not in known:
            raise InputError(f"no setting {name!r}", where=where, remedy=_nearest(name, known))
    hints = _hints(function)
    return {
        name: _of_type(
            value, hints.get(name, Any), name=name, where=where, endless=parameters[name].default == math.inf
        )
        for name, value in settings.items()
    }


def check_arguments(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function that refuses arguments which are not of the type that it says."""
    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        given = signature.bind(*args, **kwargs)
        hints = _hints(function)
        for name, value in given.arguments.items():
            if name in hints:
                endless = signature.parameters[name].default in (math.inf, -math.inf)
                given.arguments[name] = _of_type(
                    value, hints[name], name=name, where=function.__name__, endless=endless
                )
        return function(*given.args, **given.kwargs)

    return call


@cache
def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the types of the arguments; what a function returns may be known to type checkers only."""
    if isinstance(function, type):
        return get_type_hints(function)
    function = inspect.unwrap(function)
    given = {name: hint for name, hint in function.__annotations__.items() if name != "return"}
    return get_type_hints(SimpleNamespace(__annotations__=given), globalns=getattr(function, "__globals__", None))


def _of_type(value: Any, hint: Any, *, name: str, where: str, endless: bool = False) -> Any:
    """Return a value as the type that an annotation asks for: numbers as float or int, sequences element by element.

    Raises
    ------
    InputError
        Something else.
    """
    # an alias of its own kind (PEP 695), as numpy's NDArray is from 2.5 on, stands for its value
    hint = getattr(get_origin(hint) or hint, "__value__", hint)
    origin, inner = get_origin(hint), get_args(hint)

    def each(values: Iterable[Any], hints: Iterable[Any]) -> Iterator[Any]:
        return (_of_type(one, wanted, name=name, where=where) for one, wanted in zip(values, hints, strict=False))

    if hint is Any:
        return value
    if origin in (Union, UnionType):
        if value is None and NoneType in inner:
            return None
        return _of_one(value, [one for one in inner if one is not NoneType], name=name, where=where, endless=endless)
    if origin is Literal:
        return one_of(value, inner, name=name, where=where)
    if hint in (float, int):
        if endless and is_real(value) and math.isinf(value):
            return float(value)
        result = number(value, name=name, where=where, whole=hint is int)
        return int(result) if hint is int else result
    if origin is np.ndarray:
        return _array(value, name=name, where=where)
    kind = origin or hint
    if getattr(hint, "_is_protocol", False) or kind is abc.Callable:
        fits = callable(value)
    else:
        fits = isinstance(value, kind) and not (kind is not str and isinstance(value, str | bytes))
    if fits and kind is tuple and inner and inner[-1] is not Ellipsis:
        fits = len(value) == len(inner)
    if not fits:
        remedy = f"it must be {_WORDS.get(kind, f'a {kind.__name__}')}"
        raise InputError(f"{name} = {value!r}"[:200], where=where, remedy=remedy)
    if kind is tuple:
        return tuple(each(value, inner if inner[-1] is not Ellipsis else repeat(inner[0])))
    if kind is abc.Mapping and inner:
        return dict(zip(each(value, repeat(inner[0])), each(value.values(), repeat(inner[1])), strict=True))
    return list(each(value, repeat(inner[0]))) if kind in (abc.Sequence, abc.Iterable) and inner else value


#: how a refusal names a type that people know by another word
_WORDS = {
    bool: "True or False",
    str: "a text",
    tuple: "as many values as it has",
    abc.Sequence: "a list",
    abc.Iterable: "a list",
    abc.Mapping: "a mapping",
    abc.Callable: "a function",
}


def _of_one(value: Any, hints: list[Any], *, name: str, where: str, endless: bool) -> Any:
    """Return a value as the first of some types that it fits."""
    for hint in hints[:-1]:
        with suppress(InputError):
            return _of_type(value, hint, name=name, where=where, endless=endless)
    return _of_type(value, hints[-1], name=name, where=where, endless=endless)


def _array(value: Any, *, name: str, where: str) -> FloatArray:
    try:
        result = np.atleast_1d(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError, OverflowError):
        result = np.empty(0)
    if result.size == 0 or result.ndim > 1 or not np.all(np.isfinite(result)):
        raise InputError(f"{name} = {value!r}"[:200], where=where, remedy="it must be finite numbers in a row")
    return result


def number(value: Any, *, name: str, where: str, above: float = -math.inf, whole: bool = False) -> float:
    """Return a finite number above a bound.

    Parameters
    ----------
    value : object
        What was given; a bool or a text is no number.
    name, where : str
        The argument and the function, for the refusal.
    above : float
        The bound, itself not allowed; in the value's unit.
    whole : bool
        Whether it must be a whole number.

    Raises
    ------
    InputError
        Something else; names what is allowed.
    """
    try:
        result = float(value)
    except (TypeError, ValueError, OverflowError):
        result = math.nan
    if isinstance(value, bool | str | bytes) or not (math.isfinite(result) and above < result):
        low = "" if above == -math.inf else f" above {above:g}"
        raise InputError(f"{name} = {value!r}"[:200], where=where, remedy=f"it must be a finite number{low}")
    if whole and result != int(result):
        raise InputError(f"{name} = {value!r}", where=where, remedy="it must be a whole number")
    return result


def _nearest(value: Any, words: list[str]) -> str:
    near = get_close_matches(str(value), words, n=1, cutoff=0.5)
    listed = ", ".join(words) if words else "none"
    return f"did you mean {near[0]!r}? known are {listed}" if near else f"known are {listed}"
