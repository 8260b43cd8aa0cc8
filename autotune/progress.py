"""How a computation tells how far it is: one form for every search, fit and campaign."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """A listener of a computation; called in its thread, often, so it returns at once."""

    def __call__(self, what: str, share: float, /) -> None:
        """Take note.

        Parameters
        ----------
        what : str
            What is being done, for a person.
        share : float
            Part of the whole that is done, 0 to 1; NaN where nobody can know.
        """


def quiet(what: str, share: float, /) -> None:
    """Tell nobody.

    Parameters
    ----------
    what : str
        As of :class:`Progress`.
    share : float
        As of :class:`Progress`.
    """
