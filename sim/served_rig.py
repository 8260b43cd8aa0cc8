"""A simulated device served in a thread of its own, in real time, until its context ends."""

from __future__ import annotations

import asyncio
import threading
import time
from types import TracebackType
from typing import Self

from sim.register_device import RegisterDevice

#: cycle in which the device lives while nobody asks [s]
CYCLE_S = 0.02


class ServedRig:
    """What servers of a simulated device have in common; a server says what ``_serve`` does.

    Parameters
    ----------
    device : RegisterDevice
        The device; its time runs with the wall clock from the start of the service.
    where : object
        What it is served on, for messages.
    name : str
        Of the thread.
    """

    #: longest wait for the server to listen, and for it to end [s]
    start_s = 10.0
    #: how late the device was at most [s]: requests waited for as long, and the plant ran on under its last command
    late_s = 0.0

    def __init__(self, device: RegisterDevice, where: object, name: str) -> None:
        self.device = device
        self._where = where
        self._ready = threading.Event()
        self._failure: BaseException | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self._start_s = 0.0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> Self:
        self.device.live(1e-9)  # the plant's first step may have to be compiled: before a port is waited for
        self._thread.start()
        if not self._ready.wait(self.start_s):
            self.__exit__(None, None, None)
            raise ConnectionError(f"cannot serve on {self._where}: nothing listens after {self.start_s:g} s")
        if self._failure is not None:
            raise ConnectionError(f"cannot serve on {self._where}: {self._failure}") from self._failure
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._loop is not None and self._stop is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(self.start_s)

    @property
    def now_s(self) -> float:
        """Device time [s]."""
        return time.perf_counter() - self._start_s

    def _run(self) -> None:
        try:
            asyncio.run(self._serve_until_stopped())
        except Exception as failure:  # whatever it is, the thread that waits raises it
            self._failure = failure
        finally:
            self._ready.set()

    async def _serve_until_stopped(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        await self._serve(self._stop)

    async def _serve(self, stop: asyncio.Event) -> None:
        """Serve until told to stop; set ``_start_s`` when time begins and ``_ready`` when the port listens."""
        raise NotImplementedError

    async def _live(self) -> None:
        """Keep the plant close to the wall clock also while nobody asks."""
        while True:
            due_s = self.now_s + CYCLE_S
            self._refresh()
            await asyncio.sleep(CYCLE_S)
            self.late_s = max(self.late_s, self.now_s - due_s)

    def _refresh(self) -> None:
        """Let the plant live until now."""
        self.device.live(self.now_s)
