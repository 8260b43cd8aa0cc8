"""Compiled functions that own nothing: they read and write arrays which their caller keeps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

_F = TypeVar("_F", bound=Callable[..., Any])

#: How the compiled code of simulations is made; without the interpreter's lock several run at a time.
COMPILED = {"cache": True, "error_model": "numpy", "nogil": True}


def in_place(function: _F | None = None, *, inline: str = "never") -> Any:
    """Compile a function that allocates nothing.

    Numba counts references to every array that is taken out of a tuple, by operations that wait for the other
    processors: more than an operation of a tape costs, and shared between all simulations that run at a time. A
    function whose arrays are kept by its caller needs none, and a simulation takes less than half the time without.
    A Numba that no longer offers that compiles it as any other.

    Parameters
    ----------
    function : callable, optional
        May make no array, not by slices either.
    inline : str
        As for :func:`numba.njit`.

    Returns
    -------
    callable
        The compiled function, or a decorator.
    """

    def compiled(one: _F) -> Any:
        try:
            return njit(**COMPILED, inline=inline, _nrt=False)(one)
        except (KeyError, TypeError):
            return njit(**COMPILED, inline=inline)(one)

    return compiled if function is None else compiled(function)
