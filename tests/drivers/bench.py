"""Rigs on the bench: every kind of rig around the same servo, with what the rig's own side says of it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.cli.served import s7_places, spec_of
from autotune.config.registers import RegisterMap
from autotune.config.rig import (
    AnyModbusSettings,
    ModbusRtuSettings,
    ModbusTcpSettings,
    ModbusTlsSettings,
    OpcUaSettings,
    SerialSettings,
)
from autotune.config.s7 import S7Settings
from autotune.experiment.rig import Rig
from autotune.recording import Recording
from drivers import open_rig
from drivers.replay import ReplayRig
from sim.modbus_rig import ModbusRig, Refusal, RtuTransport, TcpTransport
from sim.opcua_rig import OpcUaRig, ServedNode
from sim.register_device import OutputChange, RegisterDevice
from sim.serial_line import SerialLine, Tamper
from sim.serial_rig import SerialRig, device_on_line
from sim.servo import Servo, ServoSettings
from tests.sim.imperfections import Fault, FaultyPlant, FaultyRig

U_RANGE = (-10.0, 10.0)
U_SAFE = -0.5
DEADMAN_S = 0.3
#: no wait of a test is longer [s]
LIMIT_S = 20.0  # no wait of a test is longer

#: a sample in one request, a command in one request; one signal in each form that devices use
REGISTERS = RegisterMap.model_validate(
    {
        "y": {"table": "input", "address": 0, "type": "float32"},
        "u_applied": {"table": "input", "address": 2, "type": "int16", "scale": 1e-3},
        "heartbeat_echo": {"table": "input", "address": 3, "type": "uint16"},
        "in_command": {"table": "input", "address": 4, "type": "uint16"},
        "device_time": {"table": "input", "address": 5, "type": "uint32", "scale": 1e-3, "word_order": "little"},
        "u": {"address": 0, "type": "int16", "scale": 1e-3},
        "heartbeat": {"address": 1, "type": "uint16"},
        "safe": {"address": 2, "type": "int16", "scale": 1e-3},
        "enable": {"table": "coil", "address": 17, "type": "bit"},
        "automatic": {"table": "coil", "address": 18, "type": "bit"},
        "K": {"address": 10, "type": "float32", "byte_order": "little"},
        "Ti": {"address": 12, "type": "uint32", "scale": 1e-3, "word_order": "little"},
        "setpoint": {"address": 20, "type": "int32", "scale": 1e-4},
    }
)


@dataclass(kw_only=True)
class Bench:
    """A rig and the rig's own side.

    ``output`` says what the actuator is moved with, ``cut`` breaks the link, ``commands`` are those that it can take.
    """

    rig: Rig
    output: Callable[[], float]
    cut: Callable[[], None]
    device: RegisterDevice | None = None
    commands: tuple[float, ...] = (0.25, -0.75, 0.5)
    restart: Callable[[], None] = lambda: None
    released: threading.Event = field(default_factory=threading.Event)

    def watch(self) -> None:
        """Set ``released`` as soon as the device's dead-man has acted."""
        assert self.device is not None
        self.device.on_change = self._on_change

    def _on_change(self, change: OutputChange) -> None:
        if change.cause == "dead-man":
            self.released.set()


def servo() -> Servo:
    return Servo(ServoSettings(load=0.1, noise=0.001), seed=1)


def register_device(registers: RegisterMap = REGISTERS, plant: Any = None, **device: Any) -> RegisterDevice:
    return RegisterDevice(
        plant if plant is not None else servo(),
        {name: spec_of(register) for name, register in registers.mapped().items()},
        u_safe=0.0,
        u_range=U_RANGE,
        deadman_s=DEADMAN_S,
        gains=(1.5, 2.0),
        **device,
    )


def rig_of(settings: AnyModbusSettings | OpcUaSettings | S7Settings | SerialSettings) -> Rig:
    return open_rig(settings, u_range=U_RANGE, u_safe=U_SAFE)


def tcp_settings(port: int, registers: RegisterMap = REGISTERS, **changes: Any) -> ModbusTcpSettings:
    return ModbusTcpSettings.model_validate({"kind": "modbus_tcp", "port": port, "registers": registers} | changes)


def rtu_settings(device: str, registers: RegisterMap = REGISTERS, **changes: Any) -> ModbusRtuSettings:
    given = {"kind": "modbus_rtu", "device": device, "baud": 115200, "parity": "N", "registers": registers}
    return ModbusRtuSettings.model_validate(given | changes)


def tls_settings(port: int, certificates: Path, **changes: Any) -> ModbusTlsSettings:
    given = {
        "kind": "modbus_tls",
        "port": port,
        "ca_file": str(certificates / "ca.pem"),
        "cert_file": str(certificates / "host.pem"),
        "key_file": str(certificates / "host.key"),
        "server_name": "ball-rig",
        "registers": REGISTERS,
    }
    return ModbusTlsSettings.model_validate(given | changes)


@contextmanager
def tcp_bench(*, refuse: Refusal | None = None, **changes: Any) -> Iterator[Bench]:
    device = register_device()
    with ExitStack() as stack:
        serving = stack.enter_context(ExitStack())
        server = serving.enter_context(ModbusRig(device, TcpTransport(), refuse=refuse))
        rig = rig_of(tcp_settings(server.port, **changes))
        stack.callback(rig.close)
        yield Bench(rig=rig, output=lambda: device.output, cut=serving.close, device=device)


@contextmanager
def tls_bench(certificates: Path, **changes: Any) -> Iterator[Bench]:
    device = register_device()
    transport = TcpTransport(
        ca_file=str(certificates / "ca.pem"),
        cert_file=str(certificates / "rig.pem"),
        key_file=str(certificates / "rig.key"),
    )
    with ExitStack() as stack:
        serving = stack.enter_context(ExitStack())
        server = serving.enter_context(ModbusRig(device, transport))
        rig = rig_of(tls_settings(server.port, certificates, **changes))
        stack.callback(rig.close)
        yield Bench(rig=rig, output=lambda: device.output, cut=serving.close, device=device)


#: the same device on nodes: one signal in each form that servers have
NODES = {
    "y": "ns=2;s=y",
    "u_applied": {"node": "ns=2;s=u_applied", "type": "float32"},
    "heartbeat_echo": "ns=2;s=heartbeat_echo",
    "in_command": "ns=2;s=in_command",
    "u": {"node": "ns=2;s=u", "type": "int16", "scale": 1e-3},
    "heartbeat": "ns=2;s=heartbeat",
    "safe": {"node": "ns=2;s=safe", "type": "int32", "scale": 1e-3},
    "enable": "ns=2;s=enable",
    "automatic": {"node": "ns=2;s=automatic", "type": "boolean"},
    "K": {"node": "ns=2;s=K", "type": "float32"},
    "Ti": {"node": "ns=2;s=Ti", "type": "uint32", "scale": 1e-3},
    "setpoint": {"node": "ns=2;s=setpoint", "type": "int64", "scale": 1e-4},
}


@contextmanager
def opcua_bench(endpoint: str) -> Iterator[Bench]:
    settings = OpcUaSettings.model_validate(
        {"kind": "opcua", "endpoint": endpoint, "security_policy": "None", "nodes": NODES}
    )
    nodes, registers = settings.nodes, settings.registers
    device = register_device(registers)
    shown = {
        name: ServedNode(node=one.node, type=nodes.type_of(name), writable=registers.mapped()[name].table == "holding")
        for name, one in nodes.mapped().items()
    }
    with ExitStack() as stack:
        serving = stack.enter_context(ExitStack())
        serving.enter_context(OpcUaRig(device, shown, endpoint))
        rig = rig_of(settings)
        stack.callback(rig.close)
        yield Bench(rig=rig, output=lambda: device.output, cut=serving.close, device=device)


#: the same device in data blocks: one signal in each form that programs have
PLACES = {
    "y": "DB10.DBD0",
    "u_applied": {"address": "DB10.DBD4", "type": "REAL"},
    "heartbeat_echo": {"address": "DB10.DBW8", "type": "WORD"},
    "in_command": "DB10.DBX10.3",
    "u": {"address": "DB11.DBW0", "scale": 1e-3},
    "heartbeat": {"address": "DB11.DBW2", "type": "WORD"},
    "safe": {"address": "DB11.DBD4", "type": "DINT", "scale": 1e-3},
    "enable": "DB11.DBX8.0",
    "automatic": "DB11.DBX8.5",
    "K": "DB12.DBD0",
    "Ti": {"address": "DB12.DBD4", "type": "TIME"},
    "setpoint": {"address": "DB12.DBX8.0", "type": "LREAL"},
}


def s7_settings(port: int, signals: dict[str, Any] = PLACES, **changes: Any) -> S7Settings:
    return S7Settings.model_validate({"kind": "s7", "port": port, "signals": signals} | changes)


@contextmanager
def s7_bench(port: int, **changes: Any) -> Iterator[Bench]:
    pytest.importorskip("snap7", reason="needs the extra s7")
    from sim.s7_rig import S7Rig

    settings = s7_settings(port, **changes)
    device = register_device(settings.registers)
    with ExitStack() as stack:
        serving = stack.enter_context(ExitStack())
        serving.enter_context(S7Rig(device, s7_places(settings), "127.0.0.1", port))
        rig = rig_of(settings)
        stack.callback(rig.close)
        yield Bench(rig=rig, output=lambda: device.output, cut=serving.close, device=device)


@contextmanager
def rtu_bench(*, tamper: Tamper | None = None, **changes: Any) -> Iterator[Bench]:
    device = register_device()
    with SerialLine(tamper) as line, ModbusRig(device, RtuTransport(device=line.rig_device, parity="N")):
        rig = rig_of(rtu_settings(line.host_device, **changes))
        yield Bench(rig=rig, output=lambda: device.output, cut=line.cut, device=device)
        rig.close()


def serial_settings(device: str, **changes: Any) -> SerialSettings:
    given = {"kind": "serial", "device": device, "timeout_s": 2.0, "deadman_s": DEADMAN_S, "y_span": (-10.0, 10.0)}
    return SerialSettings.model_validate(given | {"u_span": U_RANGE} | changes)


@contextmanager
def serial_bench(*, tamper: Tamper | None = None, **changes: Any) -> Iterator[Bench]:
    device = device_on_line(servo(), u_range=U_RANGE, u_safe=0.0, gains=(1.5, 2.0))
    with (
        SerialLine(tamper) as line,
        SerialRig(device, line.rig_device, y_span=U_RANGE, u_span=U_RANGE) as served,
    ):
        rig = rig_of(serial_settings(line.host_device, **changes))
        yield Bench(rig=rig, output=lambda: device.output, cut=line.cut, device=device, restart=served.restart)
        rig.close()


@contextmanager
def firmware_bench(elf: Path, **changes: Any) -> Iterator[Bench]:
    """Yield the firmware, executed, with the servo behind its converters."""
    from tests.drivers.simavr_bench import U_FULL, Uno, UnoOnLine

    plant, low, span = servo(), U_RANGE[0], U_RANGE[1] - U_RANGE[0]

    def live(count: int) -> int:
        plant.advance(low + span * count / U_FULL, 1e-3)
        return round(min(max((plant.measure() + 10.0) / 20.0, 0.0), 1.0) * 5000)

    uno = Uno(elf, elf.parent, live)
    with SerialLine() as line, UnoOnLine(uno, line.rig_device) as served:
        # the Uno lives in this process: where the computer is busy its host is late, and that is not what is tested
        rig = rig_of(serial_settings(line.host_device, **({"deadman_s": 5.0, "timeout_s": 1.0} | changes)))
        yield Bench(rig=rig, output=lambda: low + span * uno.duty / U_FULL, cut=line.cut, restart=served.restart)
        rig.close()


@contextmanager
def simulated_bench() -> Iterator[Bench]:
    plant = FaultyPlant(servo(), [Fault(kind="cut link", start_s=1000.0)])
    rig = FaultyRig(plant, u_safe=U_SAFE)
    yield Bench(rig=rig, output=lambda: rig.command, cut=lambda: rig.clock.sleep_until(1001.0))


@contextmanager
def replay_bench() -> Iterator[Bench]:
    t = 0.01 * np.arange(60)
    u = np.array([0.25, -0.75, 0.5, *np.full(57, 0.5)])
    recording = Recording(t=t, u=u, y=np.sin(t), name="recorded servo")
    rig = ReplayRig(recording)

    def wind() -> None:
        """Run to the end, where a recording has nothing more to say."""
        for _ in range(len(recording) - 1):
            rig.read()

    yield Bench(rig=rig, output=lambda: float("nan"), cut=wind)


def certificates_by_the_book(folder: Path) -> Path:
    """Make the certificates with the commands of docs/modbus_tls.md."""
    import subprocess

    text = (Path(__file__).parents[2] / "docs" / "modbus_tls.md").read_text()
    script = text.split("```sh\n")[1].split("```")[0]
    subprocess.run(["bash", "-euc", script], cwd=folder, check=True, capture_output=True, env=os.environ)
    return folder / "certificates"
