"""Other minima of a fit with dry friction: where a plant that rests begins to move or not, levels lie between them.

Each rest that holds, or does not, is another piece of the squared error over the level: a descent ends in the piece
where it began, and the curvature there says nothing of the next.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

#: From one level to the next, and in each direction so many at most.
FACTOR, LEVELS = 1.5, 4
#: Times the least squared error, from which on a direction is left.
TOO_FAR = 1.2
_T = TypeVar("_T")


def sweep(first: _T, fitted_at: Callable[[_T, float], _T | None], cost: Callable[[_T], float]) -> list[_T]:
    """Return a fit with dry friction and those from levels above and below it, each from the one before.

    Parameters
    ----------
    first
        Where to begin.
    fitted_at : callable
        Gives a fit begun at another one's level times a factor; nothing where it runs away.
    cost : callable
        Squared error of a fit.

    Returns
    -------
    list
        The one given first; what runs away, or leaves far more than the best, ends a direction.
    """
    found = [first]
    for factor in (FACTOR, 1.0 / FACTOR):
        at = min(found, key=cost)
        for _ in range(LEVELS):
            there = fitted_at(at, factor)
            if there is None or cost(there) > TOO_FAR * min(map(cost, found)):
                break
            found.append(there)
            at = there
    return found
