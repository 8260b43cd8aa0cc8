"""Which page may act: one holds the controls, the others look on."""

from __future__ import annotations

from collections.abc import Callable, Collection


class Controls:
    """The controls of a run and the page that holds them.

    The first page that comes holds them. A page that is reloaded keeps them; when it is closed they are free, and a
    page takes them by its button.

    Parameters
    ----------
    act : callable or None
        Sends an action to the run: ``abort``, ``keep`` or ``restore``; None where no run listens.

    Attributes
    ----------
    holder : str or None
        The browser tab that holds the controls.
    aborted : bool
        Whether Abort was pressed.
    run_is_gone : bool
        Whether the run has gone without saying why.
    refused : int
        Requests and messages that were not of an open page of this run.
    """

    def __init__(self, act: Callable[[str], None] | None) -> None:
        self.act = act
        self.holder: str | None = None
        self.aborted = False
        self.run_is_gone = False
        self.refused = 0
        self._first = True

    def arrive(self, tab: str | None) -> None:
        """Give the controls to the first page that comes."""
        if self._first and tab is not None:
            self._first = False
            self.holder = tab

    def take(self, tab: str | None) -> None:
        """Give free controls to the page."""
        if self.holder is None:
            self.holder = tab

    def present(self, tabs: Collection[str]) -> None:
        """Free the controls where their page is no longer among the tabs that are there or on their way back."""
        if self.holder is not None and self.holder not in tabs:
            self.holder = None

    def ask(self, action: str) -> None:
        """Send an action to the run."""
        if self.act is not None:
            self.aborted = self.aborted or action == "abort"
            self.act(action)
