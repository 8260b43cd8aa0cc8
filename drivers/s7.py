"""Places in a Siemens CPU's data blocks, read and written as registers over S7 communication (PUT/GET).

What lies in one block, near each other, is read in one request; what lies side by side is written in one. A bit is
written as a bit, so that its neighbours keep what they have. The sequence number pairs an answer with its request;
after a time-out the connection is made anew and the request sent once more, which marks the sample suspect.
"""

from __future__ import annotations

import contextlib
import logging
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from snap7.connection import ISOTCPConnection
from snap7.datatypes import S7Area, S7WordLen
from snap7.error import S7Error, S7TimeoutError
from snap7.s7protocol import S7Protocol

from autotune.config.s7 import SIZES, S7Settings
from autotune.errors import LinkError
from drivers.register_link import Answer
from drivers.registers import Block, codecs
from drivers.s7_errors import (
    LOST,
    NO_ANSWER,
    NO_CONNECTION,
    REFUSED,
    RUN,
    STOPPED,
    STOPPED_REMEDY,
    item_refusal,
    request_refusal,
)
from drivers.s7_requests import Part, adjacent, together
from drivers.session_lock import SessionLock

# the library logs what is raised here anyway; without a handler Python would print it
logging.getLogger("snap7").addHandler(logging.NullHandler())

_T = TypeVar("_T")
_DONE = 0xFF
#: as a programming device: the resource that every CPU has
_CONNECTION_TYPE = 1
#: length of a message that is asked for [bytes]
_PDU = 480
#: part of the system status list with the operating state, and where in it the state is
_STATE, _STATE_AT = 0x0424, 11
#: time between two looks at the operating state where the program echoes no heartbeat [s]
_LOOK_S = 1.0


class S7Refused(LinkError):  # noqa: N818 - a verdict, as its base
    """The CPU answered, and refuses."""


class S7Link:
    """One CPU; see :class:`drivers.register_link.RegisterLink`.

    Parameters
    ----------
    settings : S7Settings
        Address of the CPU and its signals.
    exclusive : bool
        Whether no other session of this computer may have the device meanwhile, and the CPU and every place are looked
        at before anything else; not needed by who only reads.
    """

    def __init__(self, settings: S7Settings, *, exclusive: bool = True) -> None:
        self._settings = settings
        self._lock = SessionLock(self.where, exclusive=exclusive)
        self._is_exclusive = exclusive
        self._connection: ISOTCPConnection | None = None
        self._protocol = S7Protocol()
        self._is_looked_at = not exclusive
        self._looked_s = time.monotonic()
        self._parts = {
            name: Part(name, signal.place, SIZES[signal.kind], signal.kind == "BOOL")
            for name, signal in settings.signals.mapped().items()
        }
        mapped = settings.registers.mapped()
        self._words = {name: register.words for name, register in mapped.items()}
        self._at: dict[tuple[str, int], str] = {
            (codec.register.table, codec.register.address): name for name, codec in codecs(mapped).items()
        }
        # a program that echoes the heartbeat says by that whether it runs
        self._looks = exclusive and "heartbeat_echo" not in self._parts
        self._requests: dict[tuple[str, ...], list[list[Part]]] = {}

    @property
    def where(self) -> str:
        """The CPU, for messages."""
        settings = self._settings
        return f"S7 {settings.host}:{settings.port} rack {settings.rack} slot {settings.slot}"

    def connect(self) -> None:
        """Connect, and look once whether the CPU runs and every place can be reached; nothing is written.

        Raises
        ------
        LinkError
            Nobody answers, the CPU refuses the connection or a place, or it is in STOP.
        """
        if self._connection is not None:
            return
        is_first = self._lock.take()
        try:
            self._open()
            if not self._is_looked_at:
                self._require_run()
                for part in self._parts.values():
                    self._read([part])
                self._is_looked_at = True
        except BaseException:
            self._hang_up()
            if is_first:
                self._lock.give_back()
            raise

    def disconnect(self) -> None:
        """Disconnect; may be called more than once, and does not raise."""
        self._hang_up()
        self._is_looked_at = not self._is_exclusive
        self._lock.give_back()

    def distrust(self) -> None:
        """Look whether the CPU still runs: answers are paired with requests, so that its program did not echo.

        Raises
        ------
        LinkError
            It is in STOP.
        """
        self._exchange(self._require_run)

    def state(self) -> int | None:
        """Return the CPU's operating state, 8 in RUN; None where it does not say it."""
        with contextlib.suppress(S7Refused):
            data = self._ask(self._protocol.build_read_szl_request(_STATE, 0))["data"]
            if data and data["return_code"] == _DONE and len(data["data"]) > _STATE_AT:
                return int(data["data"][_STATE_AT]) & 0x0F
        return None

    def read(self, block: Block) -> Answer:
        """Read the places of a block's signals, those of the first signal's request first.

        Raises
        ------
        LinkError
            No answer in all attempts, a place that the CPU refuses, or it is in STOP.
        """
        if self._looks and time.monotonic() - self._looked_s > _LOOK_S:
            self._exchange(self._require_run)
        names = tuple(codec.name for codec, _ in block.parts)
        if names not in self._requests:
            self._requests[names] = together([self._parts[name] for name in names])

        def ask() -> tuple[dict[str, bytes], float]:
            held: dict[str, bytes] = {}
            began_s, middle_s = time.perf_counter(), 0.0
            for parts in self._requests[names]:
                held |= self._read(parts)
                middle_s = middle_s or 0.5 * (began_s + time.perf_counter())
            # a sample's time is the middle of its first request: what the others took comes after
            return held, 2.0 * (time.perf_counter() - middle_s)

        (held, took_s), attempts = self._exchange(ask)
        return Answer([word for name in names for word in self._words_of(name, held[name])], attempts > 1, took_s)

    def write(self, table: str, address: int, words: Sequence[int]) -> bool:
        """Write places whose registers lie side by side in the map, in as few requests as their addresses allow.

        Parameters
        ----------
        table : str
            As the map has it.
        address : int
            Of the first word.
        words : sequence of int
            16 bits each.

        Raises
        ------
        LinkError
            No answer in all attempts, or a place that the CPU does not let be written.
        """
        given, left = [], list(words)
        while left:
            name = self._at[table, address]
            size = self._words[name]
            given.append((self._parts[name], struct.pack(f">{size}H", *left[:size])))
            address, left = address + size, left[size:]

        def ask() -> None:
            for parts, data in adjacent(given):
                self._write(parts, data)

        return self._exchange(ask)[1] > 1

    def _words_of(self, name: str, data: bytes) -> Sequence[int]:
        part = self._parts[name]
        if part.is_bit:
            return (data[0] >> part.place.bit & 1,)
        return struct.unpack(f">{self._words[name]}H", data)

    def _require_run(self) -> None:
        self._looked_s = time.monotonic()
        state = self.state()
        if state is not None and state != RUN:
            raise S7Refused(STOPPED, where=self.where, remedy=STOPPED_REMEDY)

    def _open(self) -> None:
        settings = self._settings
        line = ISOTCPConnection(
            settings.host, settings.port, remote_tsap=_CONNECTION_TYPE << 8 | settings.rack << 5 | settings.slot
        )
        try:
            line.connect(settings.timeout_s)
        except S7TimeoutError:
            raise self._failure(NO_ANSWER) from None
        except S7Error as error:
            # the library says only by its words which of TCP and the protocol above it was refused
            if str(error).startswith("TCP"):
                raise self._failure(NO_CONNECTION, error.__context__) from None
            raise self._failure(REFUSED) from None
        self._connection, self._protocol = line, S7Protocol()
        self._ask(self._protocol.build_setup_communication_request(pdu_length=_PDU))

    def _read(self, parts: Sequence[Part]) -> dict[str, bytes]:
        """Return the bytes of signals that lie in one block, read in one request."""
        block, start = parts[0].place.block, parts[0].place.byte
        count = max(part.place.byte + part.size for part in parts) - start
        request = self._protocol.build_read_request(S7Area.DB, block, start, S7WordLen.BYTE, count)
        data = self._ask(request, parts)["data"] or {}
        self._require_done(data.get("return_code", 0), parts)
        if len(data["data"]) != count:
            raise self._failure(LOST)
        held = bytes(data["data"])
        return {part.name: held[part.place.byte - start :][: part.size] for part in parts}

    def _write(self, parts: Sequence[Part], data: bytes) -> None:
        place = parts[0].place
        start, kind = place.byte, S7WordLen.BYTE
        if parts[0].is_bit:
            start, kind, data = 8 * place.byte + place.bit, S7WordLen.BIT, data[-1:]
        answer = self._ask(self._protocol.build_write_request(S7Area.DB, place.block, start, kind, data), parts)
        self._require_done(bytes(answer.get("raw_data") or b"\0")[0], parts)

    def _require_done(self, code: int, parts: Sequence[Part]) -> None:
        if code != _DONE:
            raise self._refusal(item_refusal(code), parts)

    def _ask(self, request: bytes, parts: Sequence[Part] = ()) -> dict[str, Any]:
        """Send a request and return its answer; whatever the library raises on the way is a LinkError."""
        assert self._connection is not None
        try:
            self._connection.send_data(request)
            answer = self._protocol.parse_response(self._connection.receive_data())
            self._protocol.validate_pdu_reference(answer["sequence"])
        except S7TimeoutError:
            raise self._failure(NO_ANSWER) from None
        except S7Error as error:
            if error.error_code:
                raise self._refusal(request_refusal(error.error_code), parts) from None
            raise self._failure(LOST, error.__context__) from None
        except (OSError, struct.error) as error:
            raise self._failure(LOST, error) from None
        return answer

    def _exchange(self, ask: Callable[[], _T]) -> tuple[_T, int]:
        """Ask until there is an answer; return it and the number of attempts."""
        failure: LinkError | None = None
        for attempt in range(1, self._settings.retries + 2):
            try:
                self.connect()
                return ask(), attempt
            except S7Refused:
                raise
            except LinkError as error:
                failure = error
            self._hang_up()
        assert failure is not None
        raise failure

    def _hang_up(self) -> None:
        line, self._connection = self._connection, None
        if line is not None:
            line.disconnect()

    def _failure(self, said: tuple[str, str], cause: BaseException | None = None) -> LinkError:
        words = getattr(cause, "strerror", None) or (str(cause) if cause is not None else "")
        return LinkError(said[0] + (f" ({words})" if words else ""), where=self.where, remedy=said[1])

    def _refusal(self, said: tuple[str, str], parts: Sequence[Part]) -> LinkError:
        """Return the refusal of a request, with the first of its places."""
        if not parts:
            return S7Refused(f"a request {said[0]}", where=self.where, remedy=said[1])
        place = self._settings.signals.mapped()[parts[0].name].address
        return S7Refused(f"{parts[0].name} {said[0]}", where=f"{self.where}, {place}", remedy=said[1])
