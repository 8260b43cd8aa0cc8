"""Linear algebra on one core: several add up in another order, and a search takes the last digit to the fourth.

Threads also spin longer on small matrices than they work.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

_P = ParamSpec("_P")
_R = TypeVar("_R")


def on_one_thread(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function, whose answer no longer hangs on how many cores there are."""

    @wraps(function)
    def limited(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with threadpool_limits(1):
            return function(*args, **kwargs)

    return limited
