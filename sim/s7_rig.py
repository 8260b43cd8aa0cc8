"""The simulated device as a Siemens CPU on a real S7 server, in real time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from snap7.datatypes import S7Area, S7WordLen
from snap7.server import CPUState, Server
from snap7.type import SrvArea, SrvEvent

from sim.register_device import IllegalValue, RegisterDevice
from sim.registers import from_words, to_words
from sim.served_rig import ServedRig

logging.getLogger("snap7").addHandler(logging.NullHandler())

#: bytes of the types, as the CPU keeps them: big-endian
_FORMS = {
    "INT": ">h", "UINT": ">H", "WORD": ">H", "DINT": ">i", "UDINT": ">I", "DWORD": ">I", "TIME": ">i", "REAL": ">f",
    "LINT": ">q", "ULINT": ">Q", "LWORD": ">Q", "LREAL": ">d",
}  # fmt: skip
#: event of a client that has written, and the part of the system status list with the operating state
_WRITTEN, _OPERATING_STATE = 0x00040000, 0x0424


@dataclass(frozen=True, kw_only=True)
class ServedPlace:
    """Where the CPU keeps a signal: data block, first byte, bit of a BOOL, data type."""

    block: int
    byte: int
    bit: int
    type: str

    @property
    def size(self) -> int:
        """Bytes."""
        return 1 if self.type == "BOOL" else struct.calcsize(_FORMS[self.type])


class S7Rig(ServedRig):
    """A device served in its own thread until the context ends.

    Parameters
    ----------
    device : RegisterDevice
        The device; its time runs with the wall clock from the start of the service.
    places : mapping of str to ServedPlace
        Its signals. A data block ends with its last signal; others do not exist.
    address : str
        Where it listens.
    port : int
        TCP port.

    Notes
    -----
    The program runs whenever it is asked, at least every 20 ms. In STOP it does not: what is written stays in memory,
    and the device's output is the safe one.
    """

    def __init__(self, device: RegisterDevice, places: Mapping[str, ServedPlace], address: str, port: int) -> None:
        super().__init__(device, f"{address}:{port}", "s7 rig")
        self._places, self._address, self._port = dict(places), address, port
        self._turn = threading.RLock()  # every client has a thread of the server's
        self.cpu = _Cpu(self._turn, self._refresh)
        for block in {place.block for place in places.values()}:
            end = max(place.byte + place.size for place in places.values() if place.block == block)
            self.cpu.register_area(SrvArea.DB, block, bytearray(end))

    def stop_program(self) -> None:
        """Bring the CPU into STOP, as its mode switch does."""
        with self._turn:
            self.cpu.set_cpu_status(int(CPUState.STOP))
            for name in ("automatic", "enable"):
                self._take(name, 0.0)

    def start_program(self) -> None:
        """Bring the CPU into RUN."""
        with self._turn:
            self.cpu.set_cpu_status(int(CPUState.RUN))

    async def _serve(self, stop: asyncio.Event) -> None:
        with socket.socket() as trial:  # the library shares a port with whoever has it
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((self._address, self._port))
        self._start_s = time.perf_counter()
        self.cpu.set_events_callback(self._take_client_write)
        self.cpu.start_to(self._address, self._port)
        try:
            self._ready.set()
            living = asyncio.create_task(self._live())
            await stop.wait()
            living.cancel()
        finally:
            self.cpu.hang_up()
            self.cpu.stop()

    def _refresh(self, block: int = 0, start: int = 0, end: int = 1 << 16) -> None:
        """Let the plant live until now, and put what the program shows into a part of a data block, or into all."""
        with self._turn:
            self.device.live(self.now_s)
            if self.cpu.cpu_state is not CPUState.RUN:
                return
            for name, place in self._places.items():
                if block in (0, place.block) and place.byte < end and place.byte + place.size > start:
                    self._show(name, place)

    def _show(self, name: str, place: ServedPlace) -> None:
        spec = self.device.registers[name]
        words = self.device.read(spec.table, spec.address, spec.size, self.now_s)
        count = (from_words(words, spec) - spec.offset) / spec.scale
        memory = self.cpu.block(place.block)
        if place.type == "BOOL":
            memory[place.byte] = memory[place.byte] & ~(1 << place.bit) | (count != 0.0) << place.bit
        else:
            form = _FORMS[place.type]
            struct.pack_into(form, memory, place.byte, count if form[1] in "fd" else round(count))

    def _take_client_write(self, event: SrvEvent) -> None:
        """Have the program take what a client has written, all of it in one cycle."""
        if event.EvtCode != _WRITTEN or self.cpu.cpu_state is not CPUState.RUN:
            return
        block, start, end = event.EvtParam2, event.EvtParam3, event.EvtParam3 + event.EvtParam4
        memory, now_s = self.cpu.block(block), self.now_s
        for name, place in self._places.items():
            if place.block != block or place.byte < start or place.byte + place.size > end:
                continue
            if place.type == "BOOL":
                self._take(name, float(memory[place.byte] >> place.bit & 1), now_s)
            else:
                self._take(name, float(struct.unpack_from(_FORMS[place.type], memory, place.byte)[0]), now_s)

    def _take(self, name: str, count: float, now_s: float | None = None) -> None:
        spec = self.device.registers.get(name)
        if spec is None or spec.table != "holding":
            return
        at_s = self.now_s if now_s is None else now_s
        if self._places[name].type == "BOOL":  # the bits beside the one that was written came along
            (shown,) = self.device.read(spec.table, spec.address, 1, at_s)
            if shown == count:
                return
        with contextlib.suppress(IllegalValue):  # a program does not take what is no number
            self.device.write(spec.table, spec.address, to_words(spec.scale * count + spec.offset, spec), at_s)


class _Cpu(Server):
    """The library's server, with bits that are written as bits, an operating state, and an end that clients see."""

    def __init__(self, turn: threading.RLock, refresh: Callable[[int, int, int], None]) -> None:
        super().__init__(log=False)
        self._turn, self._refresh = turn, refresh
        self._sockets: list[socket.socket] = []

    def block(self, number: int) -> bytearray:
        """Return the memory of a data block."""
        return self.memory_areas[S7Area.DB, number]

    def hang_up(self) -> None:
        """End every connection; the library itself would answer one more request of each."""
        self.running = False
        for client in self._sockets:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def stop(self) -> int:
        """Stop the server, also after :meth:`hang_up`."""
        self.running = True
        return super().stop()

    def _handle_client(self, client_socket: socket.socket, address: tuple[str, int]) -> None:
        self._sockets.append(client_socket)
        try:
            super()._handle_client(client_socket, address)
        finally:
            self._sockets.remove(client_socket)

    def _handle_read_area(self, request: dict[str, Any], client_address: tuple[str, int]) -> bytes:
        found = self._parse_read_address(request)
        with self._turn:
            if found is not None:
                self._refresh(found[1], found[2], found[2] + found[3])
            return super()._handle_read_area(request, client_address)

    def _handle_write_area(self, request: dict[str, Any], client_address: tuple[str, int]) -> bytes:
        with self._turn:
            return super()._handle_write_area(request, client_address)

    def _parse_address_specification(self, addr_spec: bytes) -> dict[str, Any]:
        return super()._parse_address_specification(addr_spec) | {"bit": addr_spec[-1] & 7}

    def _parse_write_address(self, request: dict[str, Any]) -> tuple[S7Area, int, int, int, bytearray] | None:
        found = super()._parse_write_address(request)
        spec = request["parameters"]["address_spec"]
        if found is None or spec.get("word_len") != S7WordLen.BIT:
            return found
        area, number, start, count, data = found
        held = self.memory_areas.get((area, number), bytearray())[start : start + 1] or bytearray(1)
        bit = 1 << spec["bit"]
        return area, number, start, count, bytearray([held[0] & ~bit | bit * (data[0] & 1)])

    def _get_szl_data(self, szl_id: int, szl_index: int) -> bytes | None:
        if szl_id != _OPERATING_STATE:
            return super()._get_szl_data(szl_id, szl_index)
        record = bytearray(20)
        record[3] = self.cpu_state
        return struct.pack(">HH", len(record), 1) + record
