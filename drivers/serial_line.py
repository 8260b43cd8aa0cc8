"""Requests and answers on a serial line: an answer is the one that was asked for, or there is none.

An answer is taken only for the request whose sequence number it carries: a late one is dropped, and a request can be
repeated. What was torn or hit by noise is no frame and costs a repetition. No wait is without end.
"""

from __future__ import annotations

import contextlib
import random
from collections import deque
from collections.abc import Callable, Iterator
from typing import Protocol

import serial

from autotune.config.rig import SerialSettings
from autotune.errors import LinkError
from autotune.experiment.rig import Clock
from drivers.line_errors import ECHO, ECHO_REMEDY, LINE_ERRORS, line_errors
from drivers.line_protocol import VERSION, Decoder, Frame, Kind, encode

_FLASH = "flash the firmware that belongs to this version"
UNKNOWN_REQUEST, NOT_IN_COMMAND = 1, 3
_REASONS = {
    UNKNOWN_REQUEST: ("does not know the request", _FLASH),
    2: ("finds the request too long or too short", _FLASH),
    NOT_IN_COMMAND: ("does not let the host command", "open the rig again"),
    4: ("refuses the value", "check y_span, u_span and the gains"),
}
_CABLE = "check cable, power and [rig] device"


class Port(Protocol):
    """What a link needs of a serial port; pyserial's, or one in virtual time."""

    timeout: float | None

    @property
    def in_waiting(self) -> int:
        """Bytes that have arrived."""
        ...

    def read(self, size: int, /) -> bytes:
        """Return up to ``size`` bytes, fewer where they do not come within ``timeout`` [s]."""
        ...

    def write(self, data: bytes, /) -> object:
        """Send bytes."""
        ...

    def close(self) -> None:
        """Close the port."""
        ...


def open_port(settings: SerialSettings) -> Port:
    """Open the serial device of the settings, for this process alone."""
    port: Port = serial.Serial(
        settings.device, settings.baud, timeout=settings.timeout_s, write_timeout=settings.timeout_s, exclusive=True
    )
    return port


class DeviceRefused(LinkError):  # noqa: N818 - a verdict, as its base
    """The device answered that it does not do it; ``reason`` is its code."""

    reason = 0


class SerialLink:
    """One device on a serial line.

    Parameters
    ----------
    settings : SerialSettings
        Line, time-outs, repetitions.
    clock : Clock
        Of the waits.
    port : callable
        Opens the line.
    """

    def __init__(
        self, settings: SerialSettings, clock: Clock, port: Callable[[SerialSettings], Port] = open_port
    ) -> None:
        self._settings = settings
        self._clock = clock
        self._open_port = port
        self._port: Port | None = None
        self._decoder = Decoder()
        self._arrived: deque[Frame] = deque()
        # a device that answers an earlier session's request must not seem to answer this one's
        self._sequence = random.randrange(0x10000)
        self._echoes = False  # whether the last request came back

    @property
    def where(self) -> str:
        """The device, for messages."""
        return f"serial line {self._settings.device}"

    @property
    def is_connected(self) -> bool:
        """Whether the line is open."""
        return self._port is not None

    def connect(self) -> Frame:
        """Open the line and wait until the device says HELLO; return its INFO.

        Raises
        ------
        LinkError
            The line cannot be opened, nobody answers, or the device speaks another version.
        """
        settings = self._settings
        if self._port is None:
            with line_errors(self.where, "cannot be opened", _CABLE, also=(ValueError,)):  # a speed it cannot run at
                self._port = self._open_port(settings)
        until = self._clock.now() + settings.start_s  # opening restarts a board whose reset hangs on DTR
        while True:
            try:
                return self.ask(Kind.HELLO, retries=0)[0]
            except LinkError as error:
                if self._clock.now() > until or self._port is None or isinstance(error, DeviceRefused):
                    self.disconnect()
                    raise

    def disconnect(self) -> None:
        """Close the line; may be called more than once."""
        port, self._port = self._port, None
        self._arrived.clear()
        self._decoder.clear()
        if port is not None:
            with contextlib.suppress(*LINE_ERRORS):  # it is gone already
                port.close()

    def ask(self, kind: Kind, *values: float, retries: int | None = None) -> tuple[Frame, float, bool]:
        """Ask until an answer carries the request's number.

        Parameters
        ----------
        kind : Kind
            Of the request.
        *values : float
            What it carries.
        retries : int, optional
            Attempts after the first; those of the settings when absent.

        Returns
        -------
        answer : Frame
            Not a refusal.
        sent_s : float
            When the answered request was sent [s].
        suspect : bool
            Whether it took more than one attempt.

        Raises
        ------
        DeviceRefused
            The device does not do it.
        LinkError
            No answer in all attempts, or the line is gone.
        """
        attempts = 1 + (self._settings.retries if retries is None else retries)
        for attempt in range(attempts):
            self._sequence = (self._sequence + 1) & 0xFFFF
            sent_s = self._clock.now()
            # a zero byte first ends what noise has left on the device's side
            start = b"\0" if attempt else b""
            self._write(start + encode(Frame(kind=kind, sequence=self._sequence, values=values)))
            answer = self._answer(kind)
            if answer is not None:
                return answer, sent_s, attempt > 0
        if self._echoes:
            raise LinkError(f"{ECHO}, and nobody answers", where=self.where, remedy=ECHO_REMEDY)
        raise LinkError(f"no answer to {kind.name}", where=self.where, remedy=_CABLE)

    def send(self, kind: Kind, *values: float) -> None:
        """Send a request whose answer arrives among the streamed rows.

        Parameters
        ----------
        kind : Kind
            Of the request.
        *values : float
            What it carries.
        """
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._write(encode(Frame(kind=kind, sequence=self._sequence, values=values)))

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Return the next frame that the device sent by itself, None where none comes within ``timeout_s`` [s]."""
        until = self._clock.now() + timeout_s
        while not self._arrived:
            if self._clock.now() >= until:
                return None
            self._arrived.extend(self._receive(until))
        return self._arrived.popleft()

    def put_back(self, frame: Frame) -> None:
        """Have a frame that the device sent by itself come again as the next."""
        self._arrived.appendleft(frame)

    def forget(self) -> None:
        """Drop the frames that the device sent by itself so far."""
        self._arrived.clear()

    def _answer(self, kind: Kind) -> Frame | None:
        until = self._clock.now() + self._settings.timeout_s
        answer: Frame | None = None
        self._echoes = False
        while answer is None and self._clock.now() < until:
            for frame in self._receive(until):
                if frame.version != VERSION:
                    raise DeviceRefused(
                        f"speaks version {frame.version} of the protocol", where=self.where, remedy=_FLASH
                    )
                if frame.kind == Kind.ROW:
                    self._arrived.append(frame)
                elif frame.kind == kind:  # a line of two wires, or one that is looped back
                    self._echoes = True
                elif frame.sequence == self._sequence:
                    answer = frame
        if answer is not None and answer.kind == Kind.REFUSED:
            what, remedy = _REASONS.get(int(answer.values[1]), ("refuses the request", _FLASH))
            refusal = DeviceRefused(f"the device {what} ({kind.name})", where=self.where, remedy=remedy)
            refusal.reason = int(answer.values[1])
            raise refusal
        return answer

    def _receive(self, until: float) -> list[Frame]:
        """Return the frames that are complete with the next bytes."""
        port = self._opened
        with self._or_closed("the line is gone"):
            port.timeout = max(0.0, until - self._clock.now())
            return self._decoder.feed(port.read(port.in_waiting or 1))

    def _write(self, data: bytes) -> None:
        port = self._opened
        with self._or_closed("the line takes nothing"):
            port.write(data)

    @contextlib.contextmanager
    def _or_closed(self, what: str) -> Iterator[None]:
        """Close the line where it breaks."""
        try:
            with line_errors(self.where, what, _CABLE):
                yield
        except LinkError:
            self.disconnect()
            raise

    @property
    def _opened(self) -> Port:
        if self._port is None:
            raise LinkError("the line is not open", where=self.where, remedy="open the rig first")
        return self._port
