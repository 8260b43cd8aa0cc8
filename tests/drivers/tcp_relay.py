"""A TCP line between host and rig that does to frames what bad networks and gateways do."""

from __future__ import annotations

import contextlib
import heapq
import os
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Literal, TypeAlias

Direction = Literal["to device", "to host"]

#: What becomes of a frame: (delay in s, bytes) each; empty where it is lost.
Tamper: TypeAlias = Callable[[bytes, Direction], Sequence[tuple[float, bytes]]]


def run_before_others() -> None:
    """Let this thread, or the process that it becomes, run before all others: a device and a line have no other work.

    Beside a busy computer they would be late otherwise, which on a plant they are not. The system may refuse it.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))


def unharmed(frame: bytes, direction: Direction) -> Sequence[tuple[float, bytes]]:
    """Pass a frame on at once."""
    return ((0.0, frame),)


def refuses(code: int, while_: Callable[[], bool] = lambda: True) -> Tamper:
    """Return a Modbus device that takes no request and answers each with an exception, while that holds."""
    refused: dict[bytes, int] = {}

    def tamper(frame: bytes, direction: Direction) -> Sequence[tuple[float, bytes]]:
        if direction == "to device":
            if not while_():
                return ((0.0, frame),)
            refused[frame[:2]] = frame[7]
            return ((0.0, frame[:4] + bytes((0, 6, frame[6], 3, 0, 0, 0, 1))),)  # a reading changes nothing
        function = refused.pop(frame[:2], None)
        return ((0.0, frame if function is None else frame[:4] + bytes((0, 3, frame[6], function | 0x80, code))),)

    return tamper


def modbus_length(head: bytes) -> int:
    """Return the length of the Modbus frame that begins so."""
    return 6 + int.from_bytes(head[4:6], "big")


def tpkt_length(head: bytes) -> int:
    """Return the length of the TPKT packet (RFC 1006) that begins so."""
    return int.from_bytes(head[2:4], "big")


class TcpRelay:
    """Accepts connections on ``port`` and carries whole frames to and from the device, through ``tamper``."""

    def __init__(
        self, device_port: int, tamper: Tamper = unharmed, length_of: Callable[[bytes], int] = modbus_length
    ) -> None:
        self.tamper, self._length_of = tamper, length_of
        self._device_port = device_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._selector = selectors.DefaultSelector()
        self._wake_read, self._wake_write = socket.socketpair()
        self._peers: dict[socket.socket, tuple[socket.socket, Direction]] = {}
        self._partial: dict[socket.socket, bytes] = {}
        self._orders: list[str] = []
        self._done = threading.Condition()
        self._thread = threading.Thread(target=self._carry, name="tcp relay", daemon=True)

    def __enter__(self) -> TcpRelay:
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._wake_read, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._order("end")
        self._thread.join()
        for each in (*self._peers, self._listener, self._wake_read, self._wake_write):
            each.close()
        self._selector.close()

    def reset(self) -> None:
        """Reset every connection, as a crashed device or firewall does; new ones are accepted."""
        self._order("reset")

    def _order(self, what: str) -> None:
        with self._done:
            self._orders.append(what)
            self._wake_write.send(b"x")
            if what != "end":
                self._done.wait_for(lambda: not self._orders, timeout=10.0)

    def _carry(self) -> None:
        run_before_others()
        under_way: list[tuple[float, int, socket.socket, bytes]] = []
        sent = 0
        while True:
            wait = max(0.0, under_way[0][0] - time.monotonic()) if under_way else None
            for key, _ in self._selector.select(wait):
                source = key.fileobj
                assert isinstance(source, socket.socket)
                if source is self._listener:
                    self._accept()
                elif source is self._wake_read:
                    self._wake_read.recv(64)
                    if self._obey():
                        return
                else:
                    for delay_s, target, data in self._read(source):
                        sent += 1
                        heapq.heappush(under_way, (time.monotonic() + delay_s, sent, target, data))
            while under_way and under_way[0][0] <= time.monotonic():
                _, _, target, data = heapq.heappop(under_way)
                with contextlib.suppress(OSError):  # closed in the meantime
                    target.sendall(data)

    def _accept(self) -> None:
        host, _ = self._listener.accept()
        device = socket.create_connection(("127.0.0.1", self._device_port))
        for each in (host, device):
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._selector.register(each, selectors.EVENT_READ)
            self._partial[each] = b""
        self._peers[host] = (device, "to device")
        self._peers[device] = (host, "to host")

    def _read(self, source: socket.socket) -> list[tuple[float, socket.socket, bytes]]:
        if source not in self._peers:
            return []
        target, direction = self._peers[source]
        try:
            data = source.recv(4096)
        except OSError:
            data = b""
        if not data:
            self._drop(source)
            self._drop(target)
            return []
        data = self._partial[source] + data
        fates: list[tuple[float, socket.socket, bytes]] = []
        while len(data) >= 6 and len(data) >= (length := self._length_of(data)):
            frame, data = data[:length], data[length:]
            fates += [(delay_s, target, piece) for delay_s, piece in self.tamper(frame, direction)]
        self._partial[source] = data
        return fates

    def _obey(self) -> bool:
        with self._done:
            orders, self._orders = self._orders, []
            if "reset" in orders:
                for each in list(self._peers):
                    each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    self._drop(each)
            self._done.notify_all()
            return "end" in orders

    def _drop(self, each: socket.socket) -> None:
        if each in self._peers:
            del self._peers[each]
            self._selector.unregister(each)
            each.close()
