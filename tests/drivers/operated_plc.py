"""The block OPERATED_RIG, compiled and scanned, behind an OPC UA server: a PLC that runs the relay by itself."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from asyncua import ua
from asyncua.server.server import Server

from autotune.config.rig import OpcUaSettings
from sim.served_rig import ServedRig
from tests.drivers.iec_compiler import Blocks, CompiledInstance
from tests.drivers.scanned_plc import STRUCTURED_TEXT, Lags

FILES = ("relay.st", "pi.st", "rig.st", "operated.st")
SOURCE = "".join((STRUCTURED_TEXT / name).read_text() for name in FILES)
U_RANGE, U_SAFE, Y_RANGE, DEADMAN_S = (0.0, 10.0), 1.0, (0.2, 9.8), 1.0
#: how often the server lets its program run the cycles that are due [s]
_LOOK_S = 0.001
#: node by signal: its type, the block's variable, and whether the host writes it
_NODES = {
    "y": ("Double", "Y", False), "u_applied": ("Double", "U", False), "heartbeat_echo": ("UInt16", "HEARTBEAT", False),
    "in_command": ("Boolean", "IN_COMMAND", False), "u": ("Double", "U_HOST", True),
    "heartbeat": ("UInt16", "HEARTBEAT", True), "enable": ("Boolean", "ENABLE", True),
    "automatic": ("Boolean", "AUTOMATIC", True), "trial": ("Boolean", "TRIAL", True),
    "safe": ("Double", "U_SAFE", True), "setpoint": ("Double", "SETPOINT", True), "K": ("Double", "K", True),
    "Ti": ("Double", "TI", True),
}  # fmt: skip


class Program:
    """The compiled block with a plant on its channels; ``live`` runs the cycles that are due.

    Parameters
    ----------
    plant : Lags
        Takes 0 .. 10 and shows 0 .. 10.
    blocks : Blocks
        The compiled function blocks.
    cycle_s : float
        Cycle of its task [s].
    deadman_s : float
        Time without a new heartbeat after which the output is safe [s].
    """

    def __init__(self, plant: Lags, blocks: Blocks, cycle_s: float, deadman_s: float = DEADMAN_S) -> None:
        self.block = CompiledInstance("OPERATED_RIG", blocks)
        self.plant, self.cycle_s, self.cycles = plant, cycle_s, 0
        self.outputs: list[float] = []  # of every cycle
        self.measured: list[float] = []
        self.held: dict[str, float] = {"U_SAFE": U_SAFE, "K": 0.1, "TI": 1.0}
        self._fixed: Mapping[str, Any] = {
            "U_MIN": U_RANGE[0], "U_MAX": U_RANGE[1], "Y_MIN": Y_RANGE[0], "Y_MAX": Y_RANGE[1], "CYCLE": cycle_s,
            "DEADMAN_CYCLES": round(deadman_s / cycle_s),
        }  # fmt: skip

    def live(self, now_s: float) -> None:
        """Run the cycles that are due."""
        while (self.cycles + 1) * self.cycle_s <= now_s:
            self.cycles += 1
            y = self.plant.measure()
            self.block(Y=y, **self._fixed, **self.held)
            self.measured.append(y)
            self.outputs.append(self.output)
            self.plant.advance(self.output, self.cycle_s)

    @property
    def output(self) -> float:
        """What the actuator is moved with now."""
        return float(self.block.value["U"])


class OperatedPlc(ServedRig):
    """The program served at an endpoint until the context ends, without security.

    Parameters
    ----------
    program : Program
        Its time runs with the wall clock from the start of the service.
    endpoint : str
        Where it is served.
    """

    start_s = 60.0

    def __init__(self, program: Program, endpoint: str) -> None:
        super().__init__(program, endpoint, "operated plc")  # type: ignore[arg-type]  # what a device does here
        self.program, self._endpoint = program, endpoint

    async def _serve(self, stop: asyncio.Event) -> None:
        server = Server()
        await server.init()
        server.set_endpoint(self._endpoint)
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        space = await server.register_namespace("urn:plc")
        folder = await server.nodes.objects.add_object(space, "Rig")
        block = self.program.block
        for name, (kind, variable, writable) in _NODES.items():
            node = await folder.add_variable(ua.NodeId(name, space), name, self._variant(kind, 0.0).Value)
            if writable:
                await node.set_writable()
            server.set_attribute_value_setter(node.nodeid, partial(self._take, variable))
            server.set_attribute_value_callback(node.nodeid, partial(self._show, kind, variable))
        law = await folder.add_variable(ua.NodeId("law", space), "law", [0.0] * 14)
        await law.set_writable()
        server.set_attribute_value_setter(law.nodeid, lambda *given: block.put("LAW", given[-1].Value.Value))
        rows = await folder.add_variable(ua.NodeId("rows", space), "rows", [0.0] * 260)
        server.set_attribute_value_callback(
            rows.nodeid, lambda *_: ua.DataValue(ua.Variant(block.numbers("ROWS", 260), ua.VariantType.Double))
        )
        self._start_s = time.perf_counter()
        async with server:
            living = asyncio.create_task(self._live())
            self._ready.set()
            await stop.wait()
            living.cancel()

    async def _live(self) -> None:
        while True:
            self.program.live(self.now_s)
            await asyncio.sleep(_LOOK_S)

    def _take(self, variable: str, _node: Any, _attribute: Any, value: ua.DataValue) -> None:
        assert value.Value is not None
        self.program.held[variable] = value.Value.Value

    def _show(self, kind: str, variable: str, *_: Any) -> ua.DataValue:
        self.program.live(self.now_s)
        held = self.program.held.get(variable)
        return ua.DataValue(self._variant(kind, float(self.program.block.value[variable] if held is None else held)))

    @staticmethod
    def _variant(kind: str, value: float) -> ua.Variant:
        shown: Any = {"Double": float, "UInt16": lambda v: int(v) & 0xFFFF, "Boolean": bool}[kind](value)
        return ua.Variant(shown, ua.VariantType[kind])


def settings_of(endpoint: str, cycle_s: float, **changes: Any) -> OpcUaSettings:
    """Return the table [rig] of it."""
    nodes = {name: f"ns=2;s={name}" for name in _NODES}
    given = {
        "kind": "opcua", "endpoint": endpoint, "security_policy": "None", "timeout_s": 1.0, "scan_time_s": cycle_s,
        "nodes": nodes, "relay": {"law": "ns=2;s=law", "rows": "ns=2;s=rows"},
    }  # fmt: skip
    return OpcUaSettings.model_validate(given | changes)
