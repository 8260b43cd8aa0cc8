"""A simulated device on a serial line: the microcontroller's protocol, spoken by a codec of its own.

Requests and answers are those of drivers/firmware/README.md. Of the device's own laws only the PI is simulated here;
the firmware itself can be executed.
"""

from __future__ import annotations

import os
import select
import struct
import threading
import time
import tty
from types import TracebackType

from sim.plant import Plant
from sim.register_device import RegisterDevice
from sim.registers import RegisterSpec, to_words

_VERSION = 2
_LIVE_S = 0.002
_SIGNALS = ("u", "heartbeat", "safe", "enable", "automatic", "setpoint", "K", "Ti")
_WORDS = {name: RegisterSpec(table="holding", address=2 * i, type="float32") for i, name in enumerate(_SIGNALS)}
_WORDS["y"] = RegisterSpec(table="input", address=0, type="float32")
_UNKNOWN, _LENGTH, _NOT_IN_COMMAND, _RANGE = 1, 2, 3, 4


def device_on_line(
    plant: Plant, *, u_range: tuple[float, float], u_safe: float, gains: tuple[float, float] = (0.0, 1.0)
) -> RegisterDevice:
    """Return the device that :class:`SerialRig` puts on a line; it gets its dead-man time from the host.

    Parameters
    ----------
    plant : Plant
        What it moves.
    u_range : (float, float)
        Range of its output [u unit].
    u_safe : float
        Output at rest [u unit].
    gains : (float, float)
        K [u unit/y unit] and T_I [s] of its own controller.
    """
    return RegisterDevice(plant, _WORDS, u_safe=u_safe, u_range=u_range, gains=gains)


class SerialRig:
    """A device that answers on a serial line until the context ends, living on the wall clock.

    Parameters
    ----------
    device : RegisterDevice
        From :func:`device_on_line`.
    port : str
        Its end of the line.
    y_span, u_span : (float, float)
        Signal at count 0 and at full scale [y unit, u unit].
    y_full, u_full : int
        Count at full scale.
    """

    def __init__(
        self,
        device: RegisterDevice,
        port: str,
        *,
        y_span: tuple[float, float],
        u_span: tuple[float, float],
        y_full: int = 4095,
        u_full: int = 16000,
    ) -> None:
        self.device = device
        self.starts = 1
        self.late_s = 0.0  # as of a served rig
        self._y, self._u = (*y_span, y_full), (*u_span, u_full)
        self._beat = 0.0
        self._now_s = 0.0  # of the request that is being answered
        self._start_s = time.perf_counter()
        self._clock_error_s = 0.0
        self._restart = threading.Event()
        self._stop = threading.Event()
        self._line = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._line)
        self._thread = threading.Thread(target=self._serve, name="serial rig", daemon=True)

    def __enter__(self) -> SerialRig:
        self.device.live(1e-9)  # the plant's first step may have to be compiled
        self._start_s = time.perf_counter()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._line)

    def restart(self) -> None:
        """Restart the device, as its reset button does."""
        self._restart.set()

    def jump(self, seconds: float) -> None:
        """Let the clock that stamps the samples jump [s]; the plant lives on."""
        self._clock_error_s += seconds

    @property
    def now_s(self) -> float:
        """Time the device has lived [s]."""
        return time.perf_counter() - self._start_s

    def _serve(self) -> None:
        received = b""
        lines = [self._line]
        while not self._stop.is_set():
            due_s = self.now_s + _LIVE_S
            ready, _, _ = select.select(lines, [], [], _LIVE_S)
            self.late_s = max(self.late_s, self.now_s - due_s)
            self.device.live(self.now_s)
            if self._restart.is_set():
                self._restart.clear()
                self._now_s = self.now_s
                self.starts += 1
                self._put("automatic", 0.0)
                self._put("enable", 0.0)
            if ready:
                try:
                    received += os.read(self._line, 1024)
                except OSError:  # unplugged; the device lives on
                    lines = []
                    continue
                *pieces, received = received.split(b"\0")
                for piece in pieces:
                    self._now_s = self.now_s
                    answer = self._answer(_unstuff(piece))
                    if answer:
                        os.write(self._line, _stuff(answer + struct.pack("<H", _crc(answer))) + b"\0")

    def _answer(self, content: bytes) -> bytes:
        """Return the answer to a request; nothing where the bytes are none."""
        if len(content) < 6 or struct.pack("<H", _crc(content[:-2])) != content[-2:] or content[0] != _VERSION:
            return b""
        kind, payload = content[1], content[4:-2]
        reason = self._obey(kind, payload)
        if reason:
            return bytes((_VERSION, 0xFF)) + content[2:4] + bytes((kind, reason))
        if kind == 0x01:
            answer, body = 0x81, struct.pack("<HHHHB", 3, 1000, self._y[2], self._u[2], self.starts)
        elif kind in (0x08, 0x09):
            per = self._unit(self._y) / self._unit(self._u)
            value = self.device.value
            answer, body = 0x83, struct.pack("<ff", value["K"] * per, value["Ti"])
        elif kind == 0x0B:
            answer, body = 0x85, self._law
        else:
            if kind == 0x04:
                self._put("u", self._value(payload, self._u))
                self._feed()
            answer, body = 0x82, self._sample
        return bytes((_VERSION, answer)) + content[2:4] + body

    def _obey(self, kind: int, payload: bytes) -> int:
        """Do what has to be done before the sample is taken; return the reason of a refusal, or 0."""
        size = {1: 0, 2: 8, 3: 0, 4: 2, 5: 0, 7: 14, 8: 0, 9: 8, 11: 0}.get(kind)
        if size is None or len(payload) != size:
            return _UNKNOWN if size is None else _LENGTH
        by_host = self._by_host
        if kind == 0x02:
            safe, _, _, deadman_ms = struct.unpack("<HHHH", payload)
            self._put("safe", self._value(struct.pack("<H", safe), self._u))
            self.device.deadman_s = 1e-3 * deadman_ms
            self._put("u", self.device.output)
            self._put("enable", 1.0)
        elif kind == 0x03 and by_host:
            self._feed()
        elif kind == 0x04 and (not by_host or struct.unpack("<H", payload)[0] > self._u[2]):
            return _RANGE if by_host else _NOT_IN_COMMAND
        elif kind == 0x0B and (by_host or self.device.value["automatic"] != 1.0):
            return _NOT_IN_COMMAND
        elif kind == 0x05:
            self._put("automatic", 0.0)
            self._put("enable", 0.0)
        elif kind == 0x07:
            count = struct.unpack("<fHIHH", payload)[0]
            self._put("setpoint", self._y[0] + count * self._unit(self._y))
            self._put("automatic", 1.0)
            self._put("enable", 0.0)
        elif kind == 0x09:
            K, Ti = struct.unpack("<ff", payload)
            self._put("K", K * self._unit(self._u) / self._unit(self._y))
            self._put("Ti", Ti)
        return 0

    @property
    def _by_host(self) -> bool:
        return self.device.by_host

    @property
    def _sample(self) -> bytes:
        words = self.device.read("input", 0, 2, self._now_s)
        y = float(struct.unpack(">f", struct.pack(">HH", *words))[0])
        state = 1 if self._by_host else 3 if self.device.value["automatic"] == 1.0 else 0
        time_us = int(1e6 * (self._now_s + self._clock_error_s)) & 0xFFFFFFFF
        counts = (self._count(y, self._y), self._count(self.device.output, self._u))
        return struct.pack("<IHHBB", time_us, *counts, state, self.starts & 0xFF)

    @property
    def _law(self) -> bytes:
        value = self.device.value
        setpoint = (value["setpoint"] - self._y[0]) / self._unit(self._y)
        return struct.pack("<fHIHHHHH", setpoint, 0, 0, 0, 0xFFFF, self._count(value["safe"], self._u), 0, self._u[2])

    def _feed(self) -> None:
        self._beat = (self._beat + 1.0) % 1024.0
        self._put("heartbeat", self._beat)

    def _put(self, name: str, x: float) -> None:
        spec = _WORDS[name]
        self.device.write(spec.table, spec.address, to_words(x, spec), self._now_s)

    @staticmethod
    def _unit(scale: tuple[float, float, int]) -> float:
        return (scale[1] - scale[0]) / scale[2]

    def _value(self, payload: bytes, scale: tuple[float, float, int]) -> float:
        return float(scale[0] + struct.unpack("<H", payload)[0] * self._unit(scale))

    def _count(self, value: float, scale: tuple[float, float, int]) -> int:
        return min(max(round((value - scale[0]) / self._unit(scale)), 0), scale[2])


def _crc(data: bytes) -> int:
    """CRC-16/CCITT-FALSE, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
        crc &= 0xFFFF
    return crc


def _stuff(content: bytes) -> bytes:
    """COBS, from the end backwards: each zero becomes the distance to the next one."""
    out = bytearray(b"\0" + content)
    distance = 1
    for at in range(len(out) - 1, -1, -1):
        if out[at] == 0:
            out[at], distance = distance, 0
        distance += 1
    return bytes(out)  # short of 254 bytes, so that no distance is too long


def _unstuff(piece: bytes) -> bytes:
    """Return the content of a piece between two zero bytes; nothing where it is damaged."""
    out = bytearray(piece)
    at = 0
    while at < len(out):
        distance, out[at] = out[at], 0
        at += distance
    return bytes(out[1:]) if at == len(out) else b""
