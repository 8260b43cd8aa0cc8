"""From a configuration to the simulated device that is served in the real one's place."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from autotune.config import Config
from autotune.config.registers import RegisterMap, RegisterSettings
from autotune.config.rig import (
    AnyModbusSettings,
    ModbusRtuSettings,
    ModbusTcpSettings,
    ModbusTlsSettings,
    OpcUaSettings,
    SerialSettings,
)
from autotune.config.s7 import S7Settings
from autotune.config.twin import TwinSettings
from autotune.controller import PIDController
from autotune.errors import InputError
from drivers.gain_settings import controller_of, settings_of
from drivers.plants import plant_of
from sim.modbus_rig import ModbusRig, Refusal, RtuTransport, TcpTransport
from sim.plant import Plant
from sim.register_device import RegisterDevice
from sim.registers import RegisterSpec
from sim.serial_line import SerialLine
from sim.serial_rig import SerialRig, device_on_line
from sim.served_rig import ServedRig

if TYPE_CHECKING:
    from sim.opcua_rig import OpcUaRig
    from sim.s7_rig import S7Rig, ServedPlace

_Served = TypeVar("_Served", bound=ServedRig)


def modbus_settings(config: Config) -> AnyModbusSettings:
    """Return ``[rig]`` where it is a Modbus device.

    Raises
    ------
    InputError
        It is another kind.
    """
    if not isinstance(config.rig, ModbusTcpSettings | ModbusTlsSettings | ModbusRtuSettings):
        raise InputError(
            f'kind = "{config.rig.kind}" has no registers',
            where="rig",
            remedy='give a Modbus rig: kind = "modbus_tcp", "modbus_tls" or "modbus_rtu"',
        )
    return config.rig


def spec_of(register: RegisterSettings) -> RegisterSpec:
    """Return the simulated device's own description of a register."""
    return RegisterSpec(
        table=register.table,
        address=register.address,
        type=register.type,
        byte_order=register.byte_order,
        word_order=register.word_order,
        scale=register.scale,
        offset=register.offset,
        bit=register.bit,
        on=register.on,
        off=register.off,
    )


def device_of(config: Config, plant: Plant | None = None) -> RegisterDevice:
    """Return the simulated device behind the configuration's register map.

    Parameters
    ----------
    config : Config
        With a rig behind registers, nodes or data blocks that names its twin.
    plant : Plant, optional
        Replaces the twin's plant.

    Raises
    ------
    InputError
        The dead-man would run out between two samples.
    """
    settings = config.rig if isinstance(config.rig, OpcUaSettings | S7Settings) else modbus_settings(config)
    twin = _twin(settings)
    if twin.deadman_s <= config.signals.sample_time_s:
        raise InputError(
            f"a dead-man of {twin.deadman_s:g} s runs out between two samples of {config.signals.sample_time_s:g} s",
            where="rig.twin.deadman_s",
            remedy="give it several sample times",
        )
    controller, registers = config.controller, settings.registers
    specs = {name: spec_of(register) for name, register in registers.mapped().items()}
    if registers.unlock is not None:
        specs["unlock"] = spec_of(registers.unlock)
    conditions = () if isinstance(settings, OpcUaSettings | S7Settings) else settings.permissives
    permissives = {f"permissive {one.name!r}": one for one in conditions}
    specs |= {name: spec_of(register) for name, register in permissives.items()}
    device = RegisterDevice(
        plant or plant_of(twin, u_safe=config.limits.u_safe),
        specs,
        u_safe=config.limits.u_safe,
        u_range=(config.limits.u_min, config.limits.u_max),
        deadman_s=twin.deadman_s,
        gains=(controller.K, controller.Ti_s) if controller else (0.0, 1.0),
        unlock_code=registers.unlock.code if registers.unlock is not None else None,
        **_form_of(config, registers),
    )
    for name, condition in permissives.items():
        device.show(name, condition.held_at)
    return device


def _form_of(config: Config, registers: RegisterMap) -> dict[str, Any]:
    """Return what a device with gains in its maker's form is delivered with, and how it reads them."""
    gains = registers.gains
    if gains is None:
        return {}
    given = config.controller
    delivered = PIDController(K=given.K if given else 0.0, Ti_s=given.Ti_s if given else 1.0)

    def law(held: Mapping[str, float]) -> tuple[float, float, float, float]:
        c = controller_of(gains, {name: held[f"gains.{name}"] for name in gains.settings})
        return c.K, 0.0 if math.isinf(c.Ti_s) else c.Ti_s, c.Td_s, c.Tf_s

    return {"held": {f"gains.{name}": value for name, value in settings_of(gains, delivered).items()}, "law": law}


@contextmanager
def serve_modbus(config: Config, device: RegisterDevice, *, refuse: Refusal | None = None) -> Iterator[ModbusRig]:
    """Serve a device at the address of the configuration until the context ends.

    Parameters
    ----------
    config : Config
        With a Modbus rig.
    device : RegisterDevice
        What answers.
    refuse : callable, optional
        Which requests are refused, and how.

    Raises
    ------
    InputError
        The address is taken, or the serial device cannot be opened.
    """
    settings = modbus_settings(config)
    twin = _twin(settings)
    if isinstance(settings, ModbusRtuSettings):
        with _line_end(settings, twin) as end:
            # a pseudo-terminal knows no parity
            parity = settings.parity if twin.device else "N"
            transport = RtuTransport(device=end, baud=settings.baud, parity=parity, stop_bits=settings.stop_bits)
            with _start(ModbusRig(device, transport, unit_id=settings.unit_id, refuse=refuse)) as rig:
                yield rig
        return
    ca_file = settings.ca_file if isinstance(settings, ModbusTlsSettings) else None
    if isinstance(settings, ModbusTlsSettings) and not (twin.cert_file and twin.key_file):
        raise InputError("the served twin has no certificate", where="rig.twin", remedy="give cert_file and key_file")
    transport_tcp = TcpTransport(
        address=twin.listen, port=settings.port, ca_file=ca_file, cert_file=twin.cert_file, key_file=twin.key_file
    )
    with _start(ModbusRig(device, transport_tcp, unit_id=settings.unit_id, refuse=refuse)) as rig:
        yield rig


@contextmanager
def serve_opcua(config: Config, settings: OpcUaSettings, users: Mapping[str, str] | None = None) -> Iterator[OpcUaRig]:
    """Serve the configuration's twin behind an OPC UA server at its endpoint until the context ends.

    Parameters
    ----------
    config : Config
        With a twin.
    settings : OpcUaSettings
        Endpoint and nodes.
    users : mapping of str to str, optional
        Passwords by user name; without them anybody may come.

    Raises
    ------
    InputError
        There is no twin, the address is taken, or a secured server has no certificate.
    """
    from sim.opcua_rig import OpcUaRig, Security, ServedNode

    twin, written = _twin(settings), settings.nodes.registers().mapped()
    if settings.relay is not None:
        raise InputError(
            "the served twin runs no relay of its own", where="rig.relay", remedy="leave it out for the twin"
        )
    if settings.security_policy != "None" and not (twin.cert_file and twin.key_file):
        raise InputError("the served twin has no certificate", where="rig.twin", remedy="give cert_file and key_file")
    nodes = {
        name: ServedNode(node=one.node, type=settings.nodes.type_of(name), writable=written[name].table == "holding")
        for name, one in settings.nodes.mapped().items()
    }
    security = Security()
    if settings.security_policy != "None":
        trusted = str(Path(str(settings.cert_file)).parent)
        security = Security(cert_file=twin.cert_file, key_file=twin.key_file, trusted=trusted, users=users)
    with _start(OpcUaRig(device_of(config), nodes, settings.endpoint, security)) as rig:
        yield rig


@contextmanager
def serve_s7(config: Config, settings: S7Settings) -> Iterator[S7Rig]:
    """Serve the configuration's twin as a Siemens CPU at its address until the context ends.

    Parameters
    ----------
    config : Config
        With a twin.
    settings : S7Settings
        Address and data blocks.

    Raises
    ------
    InputError
        There is no twin, or the address is taken.
    """
    from sim.s7_rig import S7Rig

    twin = _twin(settings)
    with _start(S7Rig(device_of(config), s7_places(settings), twin.listen, settings.port)) as rig:
        yield rig


def s7_places(settings: S7Settings) -> dict[str, ServedPlace]:
    """Return the simulated CPU's own description of where its signals are."""
    from sim.s7_rig import ServedPlace

    return {
        name: ServedPlace(block=one.place.block, byte=one.place.byte, bit=one.place.bit, type=one.kind)
        for name, one in settings.signals.mapped().items()
    }


@contextmanager
def serve_serial_line(config: Config, settings: SerialSettings) -> Iterator[SerialRig]:
    """Serve the configuration's twin as a microcontroller on a serial line until the context ends.

    Parameters
    ----------
    config : Config
        With a twin.
    settings : SerialSettings
        The line.

    Raises
    ------
    InputError
        There is no twin, or the serial device cannot be opened.
    """
    twin, controller = _twin(settings), config.controller
    device = device_on_line(
        plant_of(twin, u_safe=config.limits.u_safe, converters=False),
        u_range=(config.limits.u_min, config.limits.u_max),
        u_safe=config.limits.u_safe,
        gains=(controller.K, controller.Ti_s) if controller else (0.0, 1.0),
    )
    with _line_end(settings, twin) as end:
        try:
            rig = SerialRig(device, end, y_span=settings.y_span, u_span=settings.u_span)
        except OSError as error:
            raise InputError(f"cannot be opened ({error.strerror})", where=end, remedy="give rig.twin.device") from None
        with rig:
            yield rig


def _twin(settings: AnyModbusSettings | OpcUaSettings | S7Settings | SerialSettings) -> TwinSettings:
    if settings.twin is None:
        raise InputError(
            "the rig has no simulated twin",
            where="rig.twin",
            remedy='name one, [rig.twin] plant = "ball", or its model = "FILE.toml"',
        )
    return settings.twin


@contextmanager
def _start(rig: _Served) -> Iterator[_Served]:
    try:
        rig.__enter__()
    except ConnectionError as error:
        raise InputError(str(error), where="rig", remedy="free the address or give another one") from None
    try:
        yield rig
    finally:
        rig.__exit__(None, None, None)


@contextmanager
def _line_end(settings: ModbusRtuSettings | SerialSettings, twin: TwinSettings) -> Iterator[str]:
    """Yield the serial device for the server; makes the line where the configuration names none."""
    if twin.device is not None:
        yield twin.device
        return
    path = Path(settings.device)
    if path.exists():
        raise InputError(
            "exists already, so no pseudo-terminal can be linked there",
            where=settings.device,
            remedy="remove it, or name the other end of the line: rig.twin.device",
        )
    with SerialLine() as line:
        path.unlink(missing_ok=True)  # a link that an earlier run left behind
        path.symlink_to(line.host_device)
        try:
            yield line.rig_device
        finally:
            path.unlink(missing_ok=True)
