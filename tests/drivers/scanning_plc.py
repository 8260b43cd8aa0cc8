"""A PLC as plants have them, over plain sockets: its program runs in scans and its Modbus server shows an earlier one.

Nothing of the project is in it, nor of a Modbus library: frames are cut by hand as the Modbus/TCP specification draws
them. Holding registers: 0 u, 1 heartbeat, 2 enable, 3 automatic, 4 set-point, 5 safe; input registers: 0 y, 1 u
applied, 2 heartbeat echo, 3 in command, 4 guard door; one count is 1e-3 of a unit, but for heartbeat and flags.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Any

from autotune.config.registers import RegisterMap

REGISTERS = RegisterMap.model_validate(
    {
        "y": {"table": "input", "address": 0, "scale": 1e-3},
        "u_applied": {"table": "input", "address": 1, "scale": 1e-3},
        "heartbeat_echo": {"table": "input", "address": 2, "type": "uint16"},
        "in_command": {"table": "input", "address": 3},
        "u": {"address": 0, "scale": 1e-3},
        "heartbeat": {"address": 1, "type": "uint16"},
        "enable": {"address": 2},
        "automatic": {"address": 3},
        "setpoint": {"address": 4, "scale": 1e-3},
        "safe": {"address": 5, "scale": 1e-3},
    }
)
DOOR = {"name": "guard door", "table": "input", "address": 4}


class ScanningPlc:
    """A PLC whose status is some scans late, which accepts now and then, and has few sockets.

    Parameters
    ----------
    scan_s : float
        Cycle of its program [s].
    late : int
        Scans by which its status is late.
    accept_s : float
        Time between two looks for a new connection [s].
    sockets : int
        Connections at a time; a further one is reset.
    safe : float
        Safe output that it starts with [u unit].
    deadman_s : float
        Time without a new heartbeat after which it trips, until it has seen enable at 0 in a scan [s].
    """

    def __init__(
        self,
        *,
        scan_s: float = 0.01,
        late: int = 1,
        accept_s: float = 0.0,
        sockets: int = 4,
        deadman_s: float = 1.0,
        safe: float = 0.0,
        port: int = 0,
    ) -> None:
        self.holding = [0] * 5 + [round(1e3 * safe) & 0xFFFF]
        self.history: list[tuple[float, float, str]] = []
        self.u, self.y, self.door = safe, 0.0, 1
        self.mode = "nobody"
        self.tripped = False
        self.commands: list[float] = []
        self.accepted = 0
        self.reset_at: Callable[[bytes], str] = lambda request: ""
        self._scan_s, self._accept_s, self._sockets, self._deadman_s = scan_s, accept_s, sockets, deadman_s
        self._status: deque[list[int]] = deque([[0, 0, 0, 0, 1]] * (late + 1), maxlen=late + 1)
        self._beat, self._beat_s = -1, 0.0
        self._open: list[socket.socket] = []
        self._stop = threading.Event()
        self._lock = threading.Condition()
        self._scans = 0
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.settimeout(0.05)
        self.port = int(self._listener.getsockname()[1])
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._run_program, self._accept)]

    def __enter__(self) -> ScanningPlc:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self.cut()
        self._listener.close()

    def cut(self) -> None:
        """Reset every connection (SO_LINGER 0), as a PLC does that restarts."""
        for each in list(self._open):
            _reset(each)

    def _run_program(self) -> None:
        next_s = time.monotonic()
        while not self._stop.is_set():
            next_s += self._scan_s
            time.sleep(max(0.0, next_s - time.monotonic()))
            with self._lock:
                self._scan()
                self._scans += 1
                self._lock.notify_all()

    def settle(self) -> None:
        """Wait until the program has seen what was written."""
        seen = self._scans + 2
        self.wait_for(lambda: self._scans >= seen)

    def wait_for(self, condition: Callable[[], bool]) -> None:
        """Wait until the program has brought something about."""
        with self._lock:
            assert self._lock.wait_for(condition, timeout=10.0)

    def _scan(self) -> None:
        u, beat, enable, automatic, setpoint, safe = (self._signed(word) for word in self.holding)
        now_s = time.monotonic()
        is_fed, before = beat != self._beat, (self.u, self.mode)
        if is_fed or not enable:
            self._beat, self._beat_s = beat, now_s
        self.tripped = bool(enable) and (self.tripped or now_s - self._beat_s > self._deadman_s)
        if self.tripped or not (enable or automatic):
            self.mode, self.u = "nobody", 1e-3 * safe
        elif enable:
            self.mode, self.u = "host", 1e-3 * u
            self.commands.append(self.u)
        else:  # its own controller: an integrator, bumpless from whatever was applied before
            self.mode = "controller"
            self.u += 0.5 * self._scan_s * (1e-3 * setpoint - self.y)
        if (self.u, self.mode) != before or (is_fed and self.mode == "host"):
            self.history.append((now_s, self.u, self.mode))
        self.y += self._scan_s / 0.2 * (self.u - self.y)
        status = [self.y * 1e3, self.u * 1e3, self.holding[1], self.mode == "host", self.door]
        self._status.append([round(value) & 0xFFFF for value in status])

    @staticmethod
    def _signed(word: int) -> int:
        return word - 0x10000 if word & 0x8000 else word

    def _accept(self) -> None:
        while not self._stop.is_set():
            if self._stop.wait(self._accept_s):
                return
            try:
                peer, _ = self._listener.accept()
            except OSError:  # nobody came
                continue
            if len(self._open) >= self._sockets:
                _reset(peer)
                continue
            self.accepted += 1
            self._open.append(peer)
            threading.Thread(target=self._serve, args=(peer,), daemon=True).start()

    def _serve(self, peer: socket.socket) -> None:
        with contextlib.suppress(OSError):
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while True:
                head = _exactly(peer, 6)
                request = _exactly(peer, int.from_bytes(head[4:6], "big"))
                order = self.reset_at(request)
                if order == "before":
                    _reset(peer)
                    break
                body = self._answer(request)
                if order == "after":
                    _reset(peer)
                    break
                peer.sendall(head[:4] + struct.pack(">H", len(body)) + body)
        with contextlib.suppress(ValueError):
            self._open.remove(peer)
        peer.close()

    def _answer(self, request: bytes) -> bytes:
        unit, function, address, value = struct.unpack(">BBHH", request[:6])
        with self._lock:
            if function in (3, 4):
                words = (self.holding if function == 3 else self._status[0])[address : address + value]
                return struct.pack(f">BBB{len(words)}H", unit, function, 2 * len(words), *words)
            if function == 6:
                self.holding[address] = value
            elif function == 16:
                self.holding[address : address + value] = struct.unpack_from(f">{value}H", request, 7)
            else:
                return bytes((unit, function | 0x80, 1))
            return request[:6]


def _exactly(peer: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        piece = peer.recv(size - len(data))
        if not piece:
            raise ConnectionError
        data += piece
    return data


def _reset(peer: socket.socket) -> None:
    with contextlib.suppress(OSError):
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        # closing alone does not end a recv() of another thread
        peer.shutdown(socket.SHUT_RD)
    peer.close()


def plc_settings(port: int, **changes: Any) -> Any:
    """Return the settings of a rig behind it."""
    from tests.drivers.bench import tcp_settings

    return tcp_settings(port, REGISTERS, **({"feed_s": 0.05, "timeout_s": 1.0} | changes))


def main() -> None:
    """Serve one until killed, ``OPTIONS HISTORY``: its port is printed, what moves the actuator written into the file.

    Lines on its standard input do to it what plants do: ``door 0``, ``reset MOMENT`` for good, ``once MOMENT``.
    """
    with open(sys.argv[2], "a", buffering=1) as file, ScanningPlc(**json.loads(sys.argv[1])) as plc:

        def write_down(entries: list[tuple[float, float, str]]) -> None:
            file.writelines(f"{t_s} {u} {mode}\n" for t_s, u, mode in entries)

        plc.history = _Written(write_down)
        sys.stdout.write(f"{plc.port}\n")
        sys.stdout.flush()
        for line in sys.stdin:
            what, value = line.split()
            if what == "door":
                plc.door = int(value)
                continue
            left = [1] if what == "once" else itertools.repeat(1)
            plc.reset_at = _resetting(value, left)


class _Written(list[tuple[float, float, str]]):
    """A history that is on the disk at once."""

    def __init__(self, write: Callable[[list[tuple[float, float, str]]], None]) -> None:
        super().__init__()
        self._write = write

    def append(self, entry: tuple[float, float, str]) -> None:
        self._write([entry])


def _resetting(moment: str, left: Any) -> Callable[[bytes], str]:
    orders = iter(list(left) if isinstance(left, list) else left)
    return lambda request: moment if next(orders, None) else ""


if __name__ == "__main__":
    main()
