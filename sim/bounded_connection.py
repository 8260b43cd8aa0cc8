"""Ends Modbus connections that ask nothing: whoever leaves half-open ones neither keeps nor blocks the device."""

from __future__ import annotations

import asyncio
import itertools
import socket
from typing import Any, ClassVar

from pymodbus.server.base import ModbusBaseServer
from pymodbus.server.requesthandler import ServerRequestHandler

_NUMBERS = itertools.count()
#: Rest after which a peer is asked whether it is still there, time between two such questions, questions [s, s, 1].
_KEEPALIVE = {"TCP_KEEPIDLE": 20, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}


class BoundedConnection(ServerRequestHandler):
    """A connection to a Modbus server that ends where no whole request comes.

    One that never asks, or that stops in the middle of a request, is ended; of too many such ones the oldest makes
    room. One that rests after a whole request stays, as a master may ask seldom; whether its peer is still there is
    asked by TCP's keep-alive, which ends it within a minute where it is not. A TLS handshake has a time of its own.

    Parameters
    ----------
    server : ModbusBaseServer
        That accepted it.

    Attributes
    ----------
    patience_s : float
        After this time without a whole request a connection is ended, at the latest after twice as long [s].
    most : int
        Connections that may wait for a request at once.
    """

    patience_s: ClassVar[float] = 10.0
    most: ClassVar[int] = 200

    def __init__(self, server: ModbusBaseServer) -> None:
        # the library leaves the request handler's arguments untyped
        super().__init__(server, server.trace_packet, server.trace_pdu, server.trace_connect)  # type: ignore[no-untyped-call]
        self._number, self._requests, self._requests_seen = next(_NUMBERS), 0, 0
        self._look_again: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to wait for a request."""
        super().connection_made(transport)
        _keep_alive(transport.get_extra_info("socket"))
        self._look_again = self.loop.call_later(self.patience_s, self._look)
        others = self.server.active_connections.values()
        waiting = [one for one in others if isinstance(one, BoundedConnection) and one.is_waiting]
        if len(waiting) > self.most:
            min(waiting, key=lambda one: one._number).end()

    def callback_data(self, data: bytes, addr: tuple[Any, ...] | None = None) -> int:
        """Count the requests that are whole.

        Parameters
        ----------
        data : bytes
            What has arrived and was not used yet.
        addr : tuple, optional
            Where it came from.

        Returns
        -------
        int
            How much of it is used [bytes].
        """
        used = int(super().callback_data(data, addr))
        self._requests += self.last_pdu is not None
        return used

    def callback_disconnected(self, exc: Exception | None) -> None:
        """Look no more."""
        if self._look_again is not None:
            self._look_again.cancel()
        super().callback_disconnected(exc)

    @property
    def is_waiting(self) -> bool:
        """Whether a request, or the rest of one, is owed by the other side."""
        return not self._requests or bool(self.recv_buffer)

    def end(self) -> None:
        """End the connection without a farewell that the other side could leave unread."""
        if isinstance(self.transport, asyncio.WriteTransport):
            self.transport.abort()

    def _look(self) -> None:
        if self.is_waiting and self._requests == self._requests_seen:
            self.end()
            return
        self._requests_seen = self._requests if self.is_waiting else -1
        self._look_again = self.loop.call_later(self.patience_s, self._look)


def _keep_alive(accepted: Any) -> None:
    """Have the system ask whether the peer is still there; systems differ in what of it can be set."""
    accepted.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        if hasattr(socket, name):
            accepted.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
