"""The simulated device behind a real Modbus server, in real time: TCP, TLS, or RTU on a serial device."""

from __future__ import annotations

import asyncio
import ssl
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.exceptions import NoSuchIdException
from pymodbus.server import ModbusSerialServer, ModbusTcpServer, ModbusTlsServer
from pymodbus.simulator import DataType, SimData, SimDevice

from sim.bounded_connection import BoundedConnection
from sim.register_device import IllegalAddress, IllegalValue, RegisterDevice
from sim.registers import RegisterSpec, Table
from sim.served_rig import ServedRig

_TABLE: dict[int, Table] = {
    1: "coil",
    2: "discrete",
    3: "holding",
    4: "input",
    5: "coil",
    6: "holding",
    15: "coil",
    16: "holding",
    22: "holding",
    23: "holding",
}
_TABLES: tuple[Table, ...] = ("coil", "discrete", "holding", "input")

#: Asked before each request is served (table, address, whether it writes); a code is answered as Modbus exception.
Refusal: TypeAlias = Callable[[str, int, bool], int | None]


@dataclass(frozen=True, kw_only=True)
class TcpTransport:
    """Where a TCP or TLS server listens; port 0 for any free one.

    Attributes
    ----------
    address, port : str, int
        Loopback unless asked otherwise.
    ca_file, cert_file, key_file : str or None
        PEM files; with them the server speaks TLS and wants a client certificate that the authority signed.
    """

    address: str = "127.0.0.1"
    port: int = 0
    ca_file: str | None = None
    cert_file: str | None = None
    key_file: str | None = None


@dataclass(frozen=True, kw_only=True)
class RtuTransport:
    """The serial device that an RTU server sits on."""

    device: str
    baud: int = 19200
    parity: str = "E"
    stop_bits: int = 1


class ModbusRig(ServedRig):
    """A device served in its own thread until the context ends.

    Parameters
    ----------
    device : RegisterDevice
        The device; its time runs with the wall clock from the start of the service.
    transport : TcpTransport or RtuTransport
        Where it is served.
    unit_id : int
        Unit id it answers to.
    refuse : callable, optional
        Injects Modbus exceptions, see :data:`Refusal`.
    """

    def __init__(
        self,
        device: RegisterDevice,
        transport: TcpTransport | RtuTransport,
        *,
        unit_id: int = 1,
        refuse: Refusal | None = None,
    ) -> None:
        super().__init__(device, transport, "modbus rig")
        self.port = 0
        self._transport = transport
        self._unit_id = unit_id
        self._refuse = refuse

    async def _serve(self, stop: asyncio.Event) -> None:
        server = self._server()
        self._start_s = time.perf_counter()
        await server.serve_forever(background=True)
        if isinstance(self._transport, TcpTransport):
            listening: Any = server.transport  # an asyncio.Server, which the library types as its transport
            self.port = int(listening.sockets[0].getsockname()[1])
        living = asyncio.create_task(self._live())
        self._ready.set()
        await stop.wait()
        living.cancel()
        connections = [connection.transport for connection in server.active_connections.values()]
        await server.shutdown()  # type: ignore[no-untyped-call]  # the library leaves it untyped
        for connection in connections:  # a TLS farewell would be waited for beyond the end of this loop
            if isinstance(connection, asyncio.WriteTransport):
                connection.abort()
        await asyncio.sleep(0.01)

    def _server(self) -> ModbusTcpServer | ModbusSerialServer:
        server = self._library_server(_sim_device(self.device.registers, self._unit_id, self._serve_request))
        server.context = _OneUnit(server.context)  # type: ignore[assignment]  # the two methods it is asked
        if isinstance(self._transport, TcpTransport):
            server.callback_new_connection = partial(BoundedConnection, server)  # type: ignore[method-assign]
        return server

    def _library_server(self, context: SimDevice) -> ModbusTcpServer | ModbusSerialServer:
        match self._transport:
            case RtuTransport(device=device, baud=baud, parity=parity, stop_bits=stop_bits):
                return ModbusSerialServer(
                    context,
                    framer=FramerType.RTU,
                    port=device,
                    baudrate=baud,
                    parity=parity,
                    stopbits=stop_bits,
                    ignore_missing_devices=True,
                )
            case TcpTransport(address=address, port=port, cert_file=None):
                return ModbusTcpServer(context, address=(address, port))
            case TcpTransport(address=address, port=port):
                # frames are cut by their length, as on TCP: a TLS record may hold half a frame or two
                tls = _tls_context(self._transport)
                return ModbusTlsServer(context, framer=FramerType.SOCKET, address=(address, port), sslctx=tls)

    async def _serve_request(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        memory: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Answer one request out of the device; called by the server, which then reads ``memory``."""
        table = _TABLE[function]
        code = self._refuse(table, address, values is not None) if self._refuse else None
        if code is not None:
            return ExcCodes(code)
        now_s = self.now_s
        try:
            if values is not None:
                self.device.write(table, address, [int(value) for value in values], now_s)
            elif table in ("coil", "discrete"):
                self._show_bits(table, start, memory, now_s)
            else:
                memory[address - start : address - start + count] = self.device.read(table, address, count, now_s)
        except IllegalAddress:
            return ExcCodes.ILLEGAL_ADDRESS
        except IllegalValue:  # refused before anything was taken: the plant goes on
            return ExcCodes.ILLEGAL_VALUE
        return None

    def _show_bits(self, table: Table, start: int, memory: list[int], now_s: float) -> None:
        """Put the table's bits where the server looks for them: 16 to a register, from the lowest bit on."""
        for spec in self.device.registers.values():
            if spec.table == table:
                (bit,) = self.device.read(table, spec.address, 1, now_s)
                at, place = spec.address // 16 - start, spec.address % 16
                memory[at] = memory[at] & ~(1 << place) | bit << place


class _OneUnit:
    """The server's memory, without the library's habit of answering for units that are not there with a failure.

    On TCP it then answers as a gateway that has no such unit, on a serial line it keeps silent.
    """

    def __init__(self, memory: Any) -> None:
        self._memory = memory

    def device_ids(self) -> list[int]:
        """Return the unit ids."""
        return list(self._memory.device_ids())

    async def async_getValues(self, device_id: int, *request: Any) -> Any:  # noqa: N802 - the library's name
        """Return what a request reads."""
        self._check(device_id)
        return await self._memory.async_getValues(device_id, *request)

    async def async_setValues(self, device_id: int, *request: Any) -> Any:  # noqa: N802 - the library's name
        """Take what a request writes."""
        self._check(device_id)
        return await self._memory.async_setValues(device_id, *request)

    def _check(self, device_id: int) -> None:
        if device_id not in self._memory.device_ids():
            raise NoSuchIdException


def _sim_device(
    registers: dict[str, RegisterSpec],
    unit_id: int,
    serve: Callable[..., object],
) -> SimDevice:
    """Return the server's memory for the registers; every request goes through ``serve``."""
    rows: dict[Table, dict[int, SimData]] = {table: {} for table in _TABLES}
    for spec in registers.values():
        is_bit = spec.type == "bit"
        rows[spec.table][spec.address] = SimData(
            spec.address,
            count=spec.size,
            values=False if is_bit else 0,
            datatype=DataType.BITS if is_bit else DataType.REGISTERS,
        )
    for table, held in rows.items():  # the library wants a row in every table; the device itself refuses this one
        is_bits = table in ("coil", "discrete")
        if not held:
            held[0] = SimData(
                0, values=False if is_bits else 0, datatype=DataType.BITS if is_bits else DataType.REGISTERS
            )
    coils, discretes, holdings, inputs = (list(rows[table].values()) for table in _TABLES)
    return SimDevice(id=unit_id, simdata=(coils, discretes, holdings, inputs), action=serve)  # type: ignore[arg-type]  # its SimAction


def _tls_context(transport: TcpTransport) -> ssl.SSLContext:
    if transport.cert_file is None or transport.key_file is None or transport.ca_file is None:
        raise RuntimeError("TLS needs ca_file, cert_file and key_file")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(transport.cert_file, transport.key_file)
    context.load_verify_locations(transport.ca_file)
    context.verify_mode = ssl.CERT_REQUIRED
    return context
