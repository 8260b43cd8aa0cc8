"""Requests and answers on Modbus TCP, TLS and RTU: an answer is the one that was asked for, or there is none.

What can go wrong, and what is done about it:

- TCP, TLS. A transaction id pairs answer and request, but only if no id is used twice: every attempt here is a new
  request with a new id, so an answer to an earlier attempt is dropped. After a time-out the stream may stand in the
  middle of a frame, so the connection is made anew.
- RTU has no transaction id: an answer that comes after its time-out would be taken for the next request's. After
  anything but a clean answer (also an interrupted request) the line is resynchronised, see :meth:`ModbusLink._flush`.
- Every answer is checked against its request: function code, number of registers, echoed address and value.
- An open but silent peer costs (retries + 1) x timeout_s, plus late_reply_s each on RTU; no wait is without end.
- A peer that says that it is busy (exceptions 5 and 6) is asked again after waits that grow, for as long as a silent
  one would cost.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import ssl
import time
from collections.abc import Callable, Sequence
from typing import Any

import serial
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.framer.rtu import FramerRTU
from pymodbus.pdu import ModbusPDU

from autotune.config.rig import AnyModbusSettings, ModbusRtuSettings, ModbusTcpSettings, ModbusTlsSettings
from autotune.errors import InputError, LinkError
from drivers.line_errors import ECHO, ECHO_REMEDY, LINE_ERRORS, line_errors
from drivers.register_link import Answer
from drivers.registers import Block
from drivers.session_lock import SessionLock

# the library logs what is raised here anyway; without a handler Python would print it
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

_EXCEPTIONS = {
    1: ("does not know the function", "check table and type in the register map"),
    2: ("does not have that address", "check the register map: addresses count from 0"),
    3: ("refuses that value or count", "check type and scale in the register map"),
    4: ("failed to do it", "look at the device's own fault display"),
    5: ("acknowledges, and is not done yet", "raise retries or timeout_s"),
    6: ("is busy", "raise retries or timeout_s"),
    10: ("is behind a gateway that has no path to it", "check unit_id and the gateway"),
    11: ("does not answer its gateway", "check unit_id and the gateway"),
}
_BUSY = (5, 6)
#: first and longest wait before a busy device is asked again [s]: its dead-man runs meanwhile
_BUSY_WAIT_S, _LONGEST_BUSY_WAIT_S = 0.005, 0.05
#: longest wait for each answer of a device that opens a TLS session [s]: a small one takes a second to sign. Only where
#: a rig is opened, before anything is commanded; a session that breaks in the loop has the time of one answer
_HANDSHAKE_S = 5.0
#: what the library raises where the line is gone, beside the line's own errors
_LOST = (ConnectionException,)
_READ = {
    "coil": (1, "read_coils"),
    "discrete": (2, "read_discrete_inputs"),
    "holding": (3, "read_holding_registers"),
    "input": (4, "read_input_registers"),
}


class DeviceRefused(LinkError):  # noqa: N818 - a verdict, as its base
    """The device answered, with a Modbus exception."""


class _TcpClient(ModbusTcpClient):
    """The library's client, with TLS that checks the device's name, and frames cut by their length on TLS too."""

    tls: ssl.SSLContext | None = None
    server_name: str = ""
    handshake_s: float = 0.0

    def connect(self) -> bool:
        """Connect; return whether there is a connection."""
        if self.socket is not None:
            return True
        address, wait_s = (self.comm_params.host, self.comm_params.port), self.comm_params.timeout_connect
        plain = socket.create_connection(address, timeout=wait_s)
        try:
            plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            plain.settimeout(max(wait_s, self.handshake_s))
            self.socket = self.tls.wrap_socket(plain, server_hostname=self.server_name) if self.tls else plain
            self.socket.settimeout(wait_s)
        except ssl.SSLError as error:
            plain.close()
            raise ConnectionException(f"TLS: {error}") from None
        except BaseException:
            plain.close()
            raise
        return True


class _RtuClient(ModbusSerialClient):
    """The library's client, waiting in select() for the first byte where the library polls each millisecond."""

    def connect(self) -> bool:
        """Open the serial device; return whether it is open."""
        if self.socket is None:
            settings = self.comm_params
            self.socket = serial.Serial(
                settings.host,
                baudrate=settings.baudrate,
                parity=settings.parity,
                stopbits=settings.stopbits,
                timeout=settings.timeout_connect,
                write_timeout=settings.timeout_connect,
                exclusive=True,
            )
        return True

    def recv(self, size: int | None) -> bytes:
        """Return what has come, at the latest after the time-out nothing."""
        if self.socket is None:
            raise ConnectionException("the line is closed")
        first = bytes(self.socket.read(1))
        return first + bytes(self.socket.read(self.socket.in_waiting)) if first else first


class ModbusLink:
    """One device on Modbus.

    Parameters
    ----------
    settings : ModbusTcpSettings, ModbusTlsSettings or ModbusRtuSettings
        Transport, unit id, time-outs.
    exclusive : bool
        Whether no other session of this computer may have the device meanwhile; not needed by who only reads.
    """

    def __init__(self, settings: AnyModbusSettings, *, exclusive: bool = True) -> None:
        self._settings = settings
        self._lock = SessionLock(self.where, exclusive=exclusive)
        self._unit = settings.unit_id
        self._client: _TcpClient | _RtuClient | None = None
        self._is_clean = False  # whether nothing but the next answer can come
        self._sent_s = 0.0  # when the last request was sent
        used = {_READ[register.table][0] for register in settings.registers.mapped().values()}
        self._marker = next((function for function in (2, 1, 4, 3) if function not in used), None)

    @property
    def where(self) -> str:
        """The device, for messages."""
        match self._settings:
            case ModbusRtuSettings(device=device, unit_id=unit):
                return f"Modbus RTU {device} unit {unit}"
            case ModbusTcpSettings(host=host, port=port, unit_id=unit):
                return f"Modbus TCP {host}:{port} unit {unit}"
            case ModbusTlsSettings(host=host, port=port, unit_id=unit):
                return f"Modbus TLS {host}:{port} unit {unit}"

    def connect(self) -> None:
        """Connect.

        Raises
        ------
        InputError
            A certificate cannot be read.
        LinkError
            Nothing answers there.
        """
        if self._client is None:
            self._client = _client(self._settings)
        is_new, is_first = self._client.socket is None, self._lock.take()
        if isinstance(self._client, _TcpClient):
            self._client.handshake_s = _HANDSHAKE_S if is_first else 0.0
        try:
            with line_errors(self.where, "no connection", "check address, cable and power", also=_LOST):
                self._client.connect()
        except LinkError:
            if is_first:
                self._lock.give_back()
            raise
        if is_new:  # on a connection that is made now nothing earlier can come; a serial line carries what it carried
            self._is_clean = isinstance(self._client, _TcpClient)

    def disconnect(self) -> None:
        """Disconnect; may be called more than once, and does not raise."""
        self._hang_up()
        self._client = None
        self._is_clean = False
        self._lock.give_back()

    def distrust(self) -> None:
        """Have a serial line flushed before the next request: an answer was not what it should be.

        On TCP and TLS the transaction id has paired answer and request, so that another connection would not help.
        """
        self._is_clean = self._is_clean and isinstance(self._client, _TcpClient)

    def read(self, block: Block) -> Answer:
        """Read a block of registers.

        Raises
        ------
        LinkError
            No answer, or none that belongs to the request, in all attempts.
        """
        function, method = _READ[block.table]
        is_bits = function < 3

        def ask(client: Any) -> ModbusPDU:
            answer: ModbusPDU = getattr(client, method)(block.address, count=block.count, device_id=self._unit)
            return answer

        def belongs(answer: ModbusPDU) -> bool:
            if is_bits:
                return len(answer.bits) == 8 * ((block.count + 7) // 8)
            return len(answer.registers) == block.count

        answer, attempts = self._exchange(ask, belongs, function, block.table, block.address)
        words = [int(bit) for bit in answer.bits[: block.count]] if is_bits else answer.registers
        return Answer(words, attempts > 1, time.perf_counter() - self._sent_s)

    def write(self, table: str, address: int, words: Sequence[int]) -> bool:
        """Write side-by-side registers in one request, or one coil.

        Parameters
        ----------
        table : str
            "holding" or "coil".
        address : int
            Of the first register.
        words : sequence of int
            16 bits each; of a coil one, 0 or 1.

        Returns
        -------
        suspect : bool
            Whether it took more than one attempt, so that it may have acted more than once.

        Raises
        ------
        LinkError
            No answer, or none that belongs to the request, in all attempts; it may have acted nevertheless.
        """
        value = words[0]

        def ask(client: Any) -> ModbusPDU:
            answer: ModbusPDU
            if table == "coil":
                answer = client.write_coil(address, bool(value), device_id=self._unit)
            elif len(words) == 1:
                answer = client.write_register(address, value, device_id=self._unit)
            else:
                answer = client.write_registers(address, list(words), device_id=self._unit)
            return answer

        def belongs(answer: ModbusPDU) -> bool:
            if answer.address != address:
                return False
            if table == "coil":
                return bool(answer.bits[0]) == bool(value)
            return answer.registers == [value] if len(words) == 1 else answer.count == len(words)

        function = 5 if table == "coil" else 6 if len(words) == 1 else 16
        _, attempts = self._exchange(ask, belongs, function, table, address)
        return attempts > 1

    def _exchange(
        self,
        ask: Callable[[Any], ModbusPDU],
        belongs: Callable[[ModbusPDU], bool],
        function: int,
        table: str,
        address: int,
    ) -> tuple[ModbusPDU, int]:
        """Ask until an answer belongs to the request; return it and the number of attempts."""
        what, remedy = "no answer", "check cable, power and unit_id, or raise timeout_s"
        attempt, left = 0, self._settings.retries + 1
        wait_s, busy_until_s = _BUSY_WAIT_S, time.monotonic() + left * self._settings.timeout_s
        while left > 0:
            attempt, left = attempt + 1, left - 1
            try:
                answer = self._attempt(ask)
            except LinkError as error:
                what, remedy = error.what, error.remedy
                self._hang_up()
                continue
            except ModbusException:  # time-out, or bytes that are no frame
                what, remedy = "no answer", "check cable, power and unit_id, or raise timeout_s"
                continue
            refused = answer.isError()
            if answer.function_code & 0x7F != function or not (refused or belongs(answer)):
                what, remedy = "the answer belongs to another request", "let only one master talk to the device"
                continue
            self._is_clean = True
            if not refused:
                return answer, attempt
            code = answer.exception_code
            what, remedy = _EXCEPTIONS.get(code, (f"answers with exception {code}", "see the device's manual"))
            what = f"the device {what}"
            if code not in _BUSY:
                raise DeviceRefused(what, where=f"{self.where}, {table} {address}", remedy=remedy)
            if (room_s := busy_until_s - time.monotonic()) > 0.0:
                time.sleep(min(wait_s, room_s))
                wait_s, left = min(2.0 * wait_s, _LONGEST_BUSY_WAIT_S), max(left, 1)
        raise LinkError(what, where=f"{self.where}, {table} {address}", remedy=remedy)

    def _attempt(self, ask: Callable[[Any], ModbusPDU]) -> ModbusPDU:
        """Ask once; whatever the line raises on the way is a LinkError."""
        if not self._is_clean:
            self._flush()
        # stays so if the request is interrupted: its answer would be the next one's
        self._is_clean = False
        self._sent_s = time.perf_counter()
        with line_errors(self.where, also=_LOST):
            return ask(self._client)

    def _flush(self) -> None:
        """Make sure that no earlier answer can be taken for the next one.

        TCP and TLS: a new connection. RTU: wait for silence, then read with a function that the register map does not
        use (2 where no discrete input is mapped). The line and the device keep the order, so when its answer or its
        refusal has come, which nothing else can cause, every earlier answer has come before it. Where that does not
        happen within ``late_reply_s``, no earlier answer is on its way any more. (The textbook's choice would be the
        diagnostic echo, function 8; but common slaves cannot tell its length and take its tail for the next request.)
        """
        if isinstance(self._client, _TcpClient):
            self._hang_up()
        self.connect()
        if not isinstance(self._client, _RtuClient) or self._client.socket is None:
            return
        line = self._client.socket
        settings = self._settings
        with line_errors(self.where):
            line.timeout = max(0.002, 3.5 * 11 / line.baudrate)
            while line.read(1):
                line.reset_input_buffer()
            self._await_markers(line, time.monotonic() + settings.late_reply_s)
            line.timeout = settings.timeout_s

    def _await_markers(self, line: serial.Serial, deadline: float) -> None:
        """Mark the end of earlier answers with reads of the unused function; return when all of them are answered."""
        received = request = b""
        sent = 0
        while (left := deadline - time.monotonic()) > 0:
            if self._marker is not None:  # its answer may have been lost, so it is sent again at each time-out
                content = bytes((self._unit, self._marker, 0, 0, 0, 1))
                request = content + FramerRTU.compute_CRC(content).to_bytes(2, "big")
                line.write(request)
                sent += 1
            until = min(deadline, time.monotonic() + (self._settings.timeout_s if self._marker else left))
            while (left := until - time.monotonic()) > 0:
                line.timeout = left
                received += line.read(1) + line.read(line.in_waiting)
                if request and request in received:  # it would pass for the acknowledgement of a write
                    raise LinkError(ECHO, where=self.where, remedy=ECHO_REMEDY)
                if self._marker is not None and _answers(received, self._unit, self._marker) >= sent:
                    return

    def _hang_up(self) -> None:
        if self._client is not None:
            with contextlib.suppress(*LINE_ERRORS):  # it is gone already
                self._client.close()  # type: ignore[no-untyped-call]  # the library leaves it untyped
            self._client.socket = None


def _answers(received: bytes, unit: int, function: int) -> int:
    """Return how many answers to a read of one register or bit, or refusals of it, are among the bytes."""
    size = 1 if function < 3 else 2
    count = 0
    for head, length in ((bytes((unit, function, size)), 5 + size), (bytes((unit, function | 0x80)), 5)):
        at = received.find(head)
        while at >= 0:
            frame = received[at : at + length]
            count += len(frame) == length and FramerRTU.compute_CRC(frame[:-2]).to_bytes(2, "big") == frame[-2:]
            at = received.find(head, at + 1)
    return count


def _client(settings: AnyModbusSettings) -> _TcpClient | _RtuClient:
    match settings:
        case ModbusRtuSettings():
            return _RtuClient(
                settings.device,
                baudrate=settings.baud,
                parity=settings.parity,
                stopbits=settings.stop_bits,
                timeout=settings.timeout_s,
                retries=0,
            )
        case ModbusTcpSettings() | ModbusTlsSettings():
            client = _TcpClient(settings.host, port=settings.port, timeout=settings.timeout_s, retries=0)
            if isinstance(settings, ModbusTlsSettings):
                client.tls = _tls_context(settings)
                client.server_name = settings.server_name or settings.host
            return client


def _tls_context(settings: ModbusTlsSettings) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=settings.ca_file)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.load_cert_chain(settings.cert_file, settings.key_file)
    except ssl.SSLError as error:
        raise InputError(
            f"certificate or key refused ({error.reason or error})",
            where=settings.cert_file,
            remedy="give the certificate and its own unencrypted key, both PEM",
        ) from None
    return context
