"""Ends connections that ask nothing: whoever opens one and sends half a request keeps neither it nor the page."""

from __future__ import annotations

import asyncio
import itertools
from typing import ClassVar

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

_NUMBERS = itertools.count()


class BoundedConnection(HttpToolsProtocol):
    """An HTTP connection that ends when it is owed no answer and brings no whole request in time.

    A server has a time for connections that rest between two requests, but none for one that never asks or that stops
    in the middle of a request. Where there are too many such connections the oldest makes room, so that nobody is
    locked out by them.

    Attributes
    ----------
    patience_s : float
        After this time without a whole request a connection is ended, at the latest after twice as long [s].
    most : int
        Connections that may wait for a request at once.
    """

    patience_s: ClassVar[float] = 10.0
    most: ClassVar[int] = 200

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override] # as its base has it
        """Begin to wait for a request."""
        super().connection_made(transport)
        self._seen: RequestResponseCycle | None = self.cycle
        self._number = next(_NUMBERS)  # several connections come within one tick of the loop's clock
        self._look_again = self.loop.call_later(self.patience_s, self._look)
        waiting = [c for c in self.connections if isinstance(c, BoundedConnection) and c.is_waiting]
        if len(waiting) > self.most:
            min(waiting, key=lambda connection: connection._number).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Look no more."""
        self._look_again.cancel()
        super().connection_lost(exc)

    @property
    def is_waiting(self) -> bool:
        """Whether the next that must come is from the other side: a request, or the rest of one."""
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    def _look(self) -> None:
        if self.transport.get_protocol() is not self:  # a web socket now, which has pings of its own
            return
        if self.is_waiting and self.cycle is self._seen:
            self.transport.abort()
            return
        self._seen = self.cycle if self.is_waiting else None
        self._look_again = self.loop.call_later(self.patience_s, self._look)
