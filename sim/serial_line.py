"""A serial line between two pseudo-terminals, with whatever a bad cable does to the frames on it."""

from __future__ import annotations

import heapq
import os
import pty
import select
import threading
import time
import tty
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Literal, TypeAlias

Direction = Literal["to device", "to host"]

#: What becomes of a frame on the line: (delay in s, bytes) each; empty where it is lost.
Tamper: TypeAlias = Callable[[bytes, Direction], Sequence[tuple[float, bytes]]]

_GATHER_S = 0.0015


class SerialLine:
    """Two pseudo-terminals joined by a thread; the host opens one, the device the other.

    Parameters
    ----------
    tamper : callable, optional
        What becomes of each frame; unharmed and at once where absent. Bytes that follow each other within 1.5 ms are
        a frame.

    Notes
    -----
    A pseudo-terminal has no baud rate: bytes take no time of their own.
    """

    def __init__(self, tamper: Tamper | None = None) -> None:
        self.tamper = tamper
        self._masters: list[int] = []
        self._slaves: list[int] = []
        for _ in range(2):
            master, slave = pty.openpty()
            tty.setraw(slave)  # no echo before somebody opens it
            self._masters.append(master)
            self._slaves.append(slave)
        self.host_device, self.rig_device = (os.ttyname(slave) for slave in self._slaves)
        self._is_cut = threading.Event()
        self._wake_read, self._wake_write = os.pipe()
        self._is_closed = False
        self._thread = threading.Thread(target=self._carry, name="serial line", daemon=True)
        self._thread.start()

    def __enter__(self) -> SerialLine:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def cut(self) -> None:
        """Cut the cable: from now on nothing arrives anywhere."""
        self._is_cut.set()

    def join(self) -> None:
        """Join the cable again."""
        self._is_cut.clear()

    def close(self) -> None:
        """End the line; may be called more than once."""
        if not self._is_closed:
            self._is_closed = True
            os.write(self._wake_write, b"x")
            self._thread.join()
            for descriptor in (*self._masters, *self._slaves, self._wake_read, self._wake_write):
                os.close(descriptor)

    def _carry(self) -> None:
        host, device = self._masters
        under_way: list[tuple[float, int, int, bytes]] = []
        last_due = {host: 0.0, device: 0.0}  # a line keeps the order: what follows a late frame is late too
        sent = 0
        while True:
            wait = max(0.0, under_way[0][0] - time.monotonic()) if under_way else None
            ready, _, _ = select.select([host, device, self._wake_read], [], [], wait)
            if self._wake_read in ready:
                return
            for source in ready:
                frame = self._gather(source)
                target = device if source == host else host
                for delay_s, data in self._fate(frame, "to device" if source == host else "to host"):
                    sent += 1  # keeps the order of frames that are due at the same time
                    last_due[target] = max(last_due[target], time.monotonic() + delay_s)
                    heapq.heappush(under_way, (last_due[target], sent, target, data))
            while under_way and under_way[0][0] <= time.monotonic():
                _, _, target, data = heapq.heappop(under_way)
                if not self._is_cut.is_set():
                    os.write(target, data)

    def _fate(self, frame: bytes, direction: Direction) -> Sequence[tuple[float, bytes]]:
        if self._is_cut.is_set():
            return ()
        return self.tamper(frame, direction) if self.tamper is not None else ((0.0, frame),)

    def _gather(self, source: int) -> bytes:
        frame = os.read(source, 1024)
        if self.tamper is not None:
            while select.select([source], [], [], _GATHER_S)[0]:
                frame += os.read(source, 1024)
        return frame
