"""Commands: first contact with a rig, and simulated rigs behind real transports."""

from __future__ import annotations

import signal
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from autotune.cli import app
from autotune.cli.common import CONFIG
from autotune.errors import LinkError
from autotune.interrupts import signals_heard

if TYPE_CHECKING:
    from autotune.config import Config
    from autotune.config.registers import RegisterSettings
    from autotune.config.rig import AnyModbusSettings
    from drivers.probe import ProbedDevice
    from sim.serial_rig import SerialRig
    from sim.served_rig import ServedRig

#: how often whoever serves a rig looks whether a signal came [s]
_LOOKS_S = 0.1


@app.command()
def rig(config: CONFIG) -> None:
    """Serve the config's simulated plant over its real transport, until stopped by Ctrl-C."""
    from autotune.cli.served import device_of, modbus_settings, serve_modbus, serve_opcua, serve_s7, serve_serial_line
    from autotune.config import load_config
    from autotune.config.rig import OpcUaSettings, SerialSettings
    from autotune.config.s7 import S7Settings
    from autotune.experiment.priority import spare_collections

    content = load_config(config)
    console = Console(highlight=False)
    heard: list[signal.Signals] = []
    with ExitStack() as serving:
        serving.enter_context(signals_heard(signal.SIGINT, signal.SIGTERM, by=heard.append))
        if isinstance(content.rig, SerialSettings):
            server: ServedRig | SerialRig = serving.enter_context(serve_serial_line(content, content.rig))
            said = f"a microcontroller on {content.rig.device}"
        elif isinstance(content.rig, OpcUaSettings):
            server = serving.enter_context(serve_opcua(content, content.rig))
            said = f"OPC UA on {content.rig.endpoint}"
        elif isinstance(content.rig, S7Settings):
            server = serving.enter_context(serve_s7(content, content.rig))
            said = f"a Siemens CPU on {content.rig.twin.listen if content.rig.twin else ''}:{content.rig.port}"
        else:
            settings = modbus_settings(content)
            modbus = server = serving.enter_context(serve_modbus(content, device_of(content)))
            console.print(_registers_of(content.name, settings))
            said = f"{_address(settings, modbus.port)}, unit {settings.unit_id}"
        spare_collections()  # a real plant does not stop for one
        server.late_s = 0.0  # nobody was there yet
        console.print(f"serving {said}; Ctrl-C ends it", markup=False)
        while not heard:  # a wait without end is not ended by a signal that another thread takes
            time.sleep(_LOOKS_S)
    console.print(f"stopped; the plant was up to {1e3 * server.late_s:.1f} ms late")


def _registers_of(name: str, settings: AnyModbusSettings) -> Table:
    table = Table("signal", "table", "address", "type", "order", "scale", "offset", title=escape(name))
    for signal_name, register in settings.registers.mapped().items():
        table.add_row(signal_name, *_row(register))
    return table


@app.command()
def probe(config: CONFIG) -> None:
    """Read every mapped register, or all a microcontroller says, once; nothing is written."""
    from autotune.config import load_config
    from drivers.kinds import kind_of
    from drivers.probe import ProbedDevice

    content = load_config(config)
    found = kind_of(content.rig).probe(content.rig, _plausible_ranges(content))
    units = _units(content)
    if isinstance(found, ProbedDevice):
        _print_device(content.name, found, units)
        return
    table = Table("signal", "register", "type", "raw", "value", "unit", title=escape(content.name))
    for one in found:
        register = one.register
        raw = " ".join(f"{word:04X}" for word in one.words) or "-"
        value = f"{one.value:.6g}" if one.words else "-"
        place = f"{register.table} {register.address}"
        table.add_row(one.name, place, register.type, raw, value, escape(units.get(one.name, "")))
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    read = sum(bool(one.words) for one in found)
    what = f"{read} registers" if read == len(found) else f"{read} of {len(found)} registers"
    _print_verdict(console, what, {one.name: one.warnings for one in found})
    if not read:
        raise LinkError(
            "no register could be read", where=content.name, remedy="check address, unit id and the register map"
        )


def _print_device(name: str, found: ProbedDevice, units: Mapping[str, str]) -> None:
    table = Table("signal", "raw", "value", "unit", title=escape(name))
    for one in found.signals:
        table.add_row(one.name, one.raw, f"{one.value:.6g}", escape(units.get(one.name, "")))
    console = Console(highlight=False, soft_wrap=True)
    console.print(found.description, markup=False)
    console.print(table)
    _print_verdict(console, f"{len(found.signals)} signals", {one.name: one.warnings for one in found.signals})


def _print_verdict(console: Console, what: str, warnings: Mapping[str, Sequence[str]]) -> None:
    for name, said in warnings.items():
        for warning in said:
            console.print(f"{name}: {warning}", markup=False)
    implausible = [name for name, said in warnings.items() if said]
    verdict = f"not plausible: {', '.join(implausible)}" if implausible else "all values are plausible"
    console.print(f"{what} read, nothing written: {verdict}", markup=False)


@app.command()
def ports(
    ask: Annotated[
        bool,
        typer.Option("--ask", help="ask each port who is there: microcontroller, Modbus device (default: only list)"),
    ] = False,
    unit: Annotated[int, typer.Option(min=1, max=247, help="unit id to ask for")] = 1,
) -> None:
    """List the serial ports, and with --ask what answers on them."""
    from drivers.ports import answers_on, serial_ports

    console = Console(highlight=False)
    found = serial_ports()
    table = Table("port", "description", "hardware", *(["answers"] if ask else []))
    for port in found:
        table.add_row(port.device, port.description, port.hardware, *([answers_on(port.device, unit)] if ask else []))
    if found:
        console.print(table)
    console.print(f"{len(found)} serial port{'' if len(found) == 1 else 's'}")


def _row(register: RegisterSettings) -> tuple[str, ...]:
    order = "" if register.type == "bit" else f"{register.byte_order}/{register.word_order}"
    return (
        register.table,
        str(register.address),
        register.type,
        order,
        f"{register.scale:g}",
        f"{register.offset:g}",
    )


def _address(settings: AnyModbusSettings, port: int) -> str:
    from autotune.config.rig import ModbusRtuSettings

    if isinstance(settings, ModbusRtuSettings):
        return f"Modbus RTU on {settings.device}"
    listen = settings.twin.listen if settings.twin else ""
    return f"Modbus {'TLS' if settings.kind == 'modbus_tls' else 'TCP'} on {listen}:{port}"


def _plausible_ranges(config: Config) -> dict[str, tuple[float, float]]:
    """Return where values are plausible; y may lie outside its limits while the rig is at rest."""
    limits = config.limits
    span = limits.y_max - limits.y_min
    y = (limits.y_min - span, limits.y_max + span)
    u = (limits.u_min, limits.u_max)
    bit = (0.0, 1.0)
    return {
        "y": y,
        "setpoint": (min(y[0], 0.0), max(y[1], 0.0)),
        "u": u,
        "u_applied": u,
        "safe": u,
        "in_command": bit,
        "enable": bit,
        "automatic": bit,
        "trial": bit,
        "device_time": (0.0, 1e9),
        "Ti": (0.0, 1e6),
    }


def _units(config: Config) -> dict[str, str]:
    u, y = config.signals.u_unit, config.signals.y_unit
    gain = f"{u}/{y}" if u or y else ""
    names = {"y": y, "setpoint": y, "u": u, "u_applied": u, "safe": u, "K": gain}
    return names | {"Ti": "s", "device_time": "s"}
