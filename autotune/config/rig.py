"""How the rig is reached: one table ``[rig]``, its ``kind`` says which."""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeAlias, get_args

from pydantic import Field, model_validator

from autotune.config.link import Feed, Retries, Timeout
from autotune.config.opcua import NodeMap
from autotune.config.registers import RegisterMap, RegisterSettings
from autotune.config.s7 import S7Settings
from autotune.config.twin import PlantSettings, TwinSettings
from autotune.errors import InputError
from autotune.schema import Number, Section


class SimulatedRigSettings(PlantSettings):
    """A plant in process, on a virtual clock."""

    kind: Literal["simulated"]


class ReplaySettings(Section):
    """A recording as a rig: its rows come back on a virtual clock, and the commands must be the recorded ones."""

    kind: Literal["replay"]
    recording: Annotated[str, Field(description="recording to replay, NAME.csv")]
    tolerance: Annotated[
        float, Field(ge=0, description="largest difference between a command and the recorded one [u unit]")
    ] = 1e-6


class PermissiveSettings(RegisterSettings):
    """A condition of the plant that is read with every sample: a door, a drive that is ready, a mode switch."""

    name: Annotated[str, Field(min_length=1, description="what it is, as people at the rig call it")]
    at_least: Annotated[float | None, Field(description="holds from this value on; absent: where it is not 0")] = None
    at_most: Annotated[float | None, Field(description="holds up to this value")] = None

    @property
    def held_at(self) -> float:
        """A value at which it holds: what a simulated rig shows."""
        if self.at_least is not None:
            return self.at_least
        return self.at_most if self.at_most is not None else 1.0

    def holds(self, value: float) -> bool:
        """Return whether the rig may be moved at this value; never where it is not a number."""
        if self.at_least is None and self.at_most is None:
            return not math.isnan(value) and value != 0.0
        low = self.at_least if self.at_least is not None else -math.inf
        high = self.at_most if self.at_most is not None else math.inf
        return low <= value <= high


class ModbusSettings(Section):
    """What the Modbus transports have in common."""

    unit_id: Annotated[int, Field(ge=0, le=247, description="unit (slave) id of the device, 0..247")] = 1
    timeout_s: Timeout = 0.2
    retries: Retries = 1
    late_reply_s: Annotated[
        float, Field(gt=0, le=60, description="longest time after which a late answer may still come [s], up to 60")
    ] = 1.0
    feed_s: Feed = 0.1
    scan_time_s: Annotated[
        float | None,
        Field(
            gt=0,
            le=60,
            description="cycle of the device's program [s]: its status may be three late; absent: not known, 0.02",
        ),
    ] = None
    registers: RegisterMap
    permissives: Annotated[
        tuple[PermissiveSettings, ...],
        Field(description="conditions without which the rig is not moved; losing one is a safe stop with its name"),
    ] = ()
    twin: TwinSettings | None = None


class ModbusTcpSettings(ModbusSettings):
    """A device on Modbus TCP."""

    kind: Literal["modbus_tcp"]
    host: Annotated[str, Field(description="address of the device; loopback by default")] = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535, description="TCP port, 1..65535")] = 502


class ModbusTlsSettings(ModbusSettings):
    """A device on Modbus/TCP Security: TLS with certificates on both sides."""

    kind: Literal["modbus_tls"]
    host: Annotated[str, Field(description="address of the device; loopback by default")] = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535, description="TCP port, 1..65535")] = 802
    ca_file: Annotated[str, Field(description="certificate authority that signed the device's certificate, PEM")]
    cert_file: Annotated[str, Field(description="this host's certificate, PEM")]
    key_file: Annotated[str, Field(description="this host's private key, PEM")]
    server_name: Annotated[str | None, Field(description="name the device's certificate must carry; default: host")] = (
        None
    )


class ModbusRtuSettings(ModbusSettings):
    """A device on Modbus RTU, on a serial line."""

    kind: Literal["modbus_rtu"]
    unit_id: Annotated[
        int, Field(ge=1, le=247, description="unit (slave) id of the device, 1..247: nobody answers to 0 on a line")
    ] = 1
    device: Annotated[str, Field(description="serial device, e.g. /dev/ttyUSB0")]
    baud: Annotated[int, Field(ge=300, le=4_000_000, description="line speed [bit/s], 300..4000000")] = 19200
    parity: Annotated[Literal["N", "E", "O"], Field(description="none, even or odd parity")] = "E"
    stop_bits: Annotated[int, Field(ge=1, le=2, description="stop bits, 1 or 2")] = 1


class SerialSettings(Section):
    """A microcontroller on a serial line, with the framed protocol of this project."""

    kind: Literal["serial"]
    device: Annotated[str, Field(description="serial device, e.g. /dev/ttyACM0")]
    baud: Annotated[int, Field(ge=300, le=4_000_000, description="line speed [bit/s], 300..4000000")] = 115200
    timeout_s: Timeout = 0.1
    retries: Retries = 1
    start_s: Annotated[
        float, Field(gt=0, le=60, description="time the device may take to start after the line was opened [s]")
    ] = 3.0
    deadman_s: Annotated[
        float, Field(ge=0.002, le=60, description="silence of the host after which the device is safe [s], 0.002..60")
    ] = 0.5
    y_span: Annotated[tuple[Number, Number], Field(description="y at count 0 and at full scale [y unit]")]
    u_span: Annotated[tuple[Number, Number], Field(description="u at count 0 and at full scale [u unit]")]
    relay: Annotated[
        Literal["host", "device"],
        Field(description="who computes the relay and the verified PI: the host, or the device by itself at its tick"),
    ] = "host"
    twin: TwinSettings | None = None


class RelayNodes(Section):
    """Arrays of a device that runs the relay by itself: the block OPERATED_RIG, see docs/plc.md."""

    law: Annotated[str, Field(min_length=1, description="node of its input LAW, 14 numbers that the host writes")]
    rows: Annotated[str, Field(min_length=1, description="node of its output ROWS, 260 numbers that the host reads")]


class OpcUaSettings(Section):
    """A device behind an OPC UA server."""

    kind: Literal["opcua"]
    endpoint: Annotated[str, Field(pattern=r"^opc\.tcp://", description="address of the server, opc.tcp://HOST:4840")]
    security_policy: Annotated[
        Literal["Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss", "None"],
        Field(description="how messages are secured; None is for a server on this computer"),
    ] = "Basic256Sha256"
    security_mode: Annotated[
        Literal["SignAndEncrypt", "Sign"], Field(description="whether messages are encrypted as well as signed")
    ] = "SignAndEncrypt"
    cert_file: Annotated[str | None, Field(description="this host's certificate, PEM or DER")] = None
    key_file: Annotated[str | None, Field(description="this host's private key, PEM")] = None
    server_cert_file: Annotated[
        str | None, Field(description="the server's certificate, PEM or DER: no other is talked to")
    ] = None
    user: Annotated[str | None, Field(description="user; absent: anonymous")] = None
    password_file: Annotated[str | None, Field(description="file whose first line is the user's password")] = None
    timeout_s: Timeout = 1.0
    retries: Retries = 1
    feed_s: Feed = 0.1
    scan_time_s: Annotated[
        float | None, Field(gt=0, le=60, description="cycle of the device's program [s]; absent: not known, 0.02")
    ] = None
    nodes: NodeMap
    relay: Annotated[
        RelayNodes | None, Field(description="where the device runs the relay by itself; absent: the host does")
    ] = None
    twin: TwinSettings | None = None

    @property
    def registers(self) -> RegisterMap:
        """The nodes as registers."""
        return self.nodes.registers()

    @model_validator(mode="after")
    def _secured(self) -> OpcUaSettings:
        files = {name: getattr(self, name) for name in ("cert_file", "key_file", "server_cert_file")}
        missing = [name for name, file in files.items() if file is None]
        if self.security_policy != "None" and missing:
            raise ValueError(f"security_policy = {self.security_policy!r} needs {', '.join(missing)}")
        if (self.user is None) != (self.password_file is None):
            raise ValueError("user and password_file belong together")
        return self

    @model_validator(mode="after")
    def _relay_can_end(self) -> OpcUaSettings:
        if self.relay is None:
            return self
        lacking = [name for name in ("heartbeat", "enable", "in_command", "K", "Ti") if name not in self.nodes.mapped()]
        if lacking:
            raise ValueError(f"a relay in the device needs the nodes of {', '.join(lacking)}")
        if self.scan_time_s is None:
            raise ValueError("a relay in the device needs scan_time_s, the cycle that it runs in")
        return self


AnyModbusSettings: TypeAlias = ModbusTcpSettings | ModbusTlsSettings | ModbusRtuSettings

RigSettings: TypeAlias = Annotated[
    SimulatedRigSettings
    | ReplaySettings
    | ModbusTcpSettings
    | ModbusTlsSettings
    | ModbusRtuSettings
    | OpcUaSettings
    | S7Settings
    | SerialSettings,
    Field(discriminator="kind", description="how the rig is reached"),
]

RIG_SETTINGS: tuple[type[Section], ...] = get_args(get_args(RigSettings)[0])


def rig_kind_of(settings: type[Section]) -> str:
    """Return what ``kind`` says in ``[rig]`` for settings.

    Raises
    ------
    InputError
        Settings without a ``kind``.
    """
    kind = settings.model_fields.get("kind")
    if kind is None:
        raise InputError(
            f"{settings.__name__} has no kind", where="autotune/config/rig.py", remedy='add kind: Literal["NAME"]'
        )
    return str(get_args(kind.annotation)[0])
