"""Register map of a Modbus device: which register holds which signal, in which form and unit."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from autotune.schema import Number, Section

RegisterType = Literal["int16", "uint16", "int32", "uint32", "float32", "bit"]

_BIT_TABLES = ("coil", "discrete")


class RegisterSettings(Section):
    """One signal of the device: engineering value = scale x raw + offset."""

    table: Annotated[
        Literal["holding", "input", "coil", "discrete"],
        Field(description="holding and coil can be written, input and discrete only read"),
    ] = "holding"
    address: Annotated[int, Field(ge=0, le=65535, description="address as sent on the line, counted from 0, 0..65535")]
    type: Annotated[
        RegisterType,
        Field(description="int16, uint16, int32, uint32, float32; a coil or a discrete input is a bit"),
    ] = "int16"
    byte_order: Annotated[Literal["big", "little"], Field(description="order of the bytes within a word")] = "big"
    word_order: Annotated[Literal["big", "little"], Field(description="order of the words of a 32-bit value")] = "big"
    scale: Annotated[Number, Field(description="engineering units per count, not 0")] = 1.0
    offset: Annotated[Number, Field(description="engineering value at count 0")] = 0.0
    not_a_value: Annotated[
        int | None, Field(description="raw count by which the device says that it has no measurement")
    ] = None

    @model_validator(mode="before")
    @classmethod
    def _bits(cls, given: Any) -> Any:
        """Take the type that a coil or a discrete input can only have."""
        if isinstance(given, dict) and given.get("table") in _BIT_TABLES:
            return {"type": "bit"} | given
        return given

    @model_validator(mode="after")
    def _consistent(self) -> RegisterSettings:
        if self.scale == 0.0:
            raise ValueError("scale = 0 would make every value the same")
        if (self.table in _BIT_TABLES) != (self.type == "bit"):
            raise ValueError(f'table = "{self.table}" and type = "{self.type}": coils and discrete inputs hold a bit')
        if self.address + self.words > 65536:
            raise ValueError(f"a {self.type} at address {self.address} ends beyond 65535")
        return self

    @property
    def words(self) -> int:
        """Number of 16-bit registers, or 1 for a bit."""
        return 2 if self.type in ("int32", "uint32", "float32") else 1

    @property
    def writable(self) -> bool:
        """Whether the table can be written."""
        return self.table in ("holding", "coil")


def _signal(description: str) -> RegisterSettings | None:
    """Return the default of an optional signal, with its description in the schema."""
    default: RegisterSettings | None = Field(default=None, description=description)
    return default


class RegisterMap(Section):
    """Which register holds which signal; y and u are needed, each further one lets the driver check more."""

    y: Annotated[RegisterSettings, Field(description="measurement [y unit]")]
    u: Annotated[RegisterSettings, Field(description="command [u unit]")]
    u_applied: RegisterSettings | None = _signal("output that the device applies [u unit]")
    device_time: RegisterSettings | None = _signal("device time stamp of the sample [s]")
    heartbeat: RegisterSettings | None = _signal("counter that the host writes with every command; feeds the dead-man")
    heartbeat_echo: RegisterSettings | None = _signal(
        "last heartbeat the device took; identifies the answer, so place it next to y"
    )
    enable: RegisterSettings | None = _signal("1 while the host commands the actuator, 0 to give it back")
    in_command: RegisterSettings | None = _signal("1 while the device lets the host's command act; place it next to y")
    safe: RegisterSettings | None = _signal("output that the device sets when the host falls silent [u unit]")
    automatic: RegisterSettings | None = _signal("1 while the device's own controller may run")
    setpoint: RegisterSettings | None = _signal("set-point of the device's own controller [y unit]")
    K: RegisterSettings | None = _signal("proportional gain of the device's own controller [u unit/y unit]")
    Ti: RegisterSettings | None = _signal("integral time of the device's own controller [s]")

    def mapped(self) -> dict[str, RegisterSettings]:
        """Return the signals that are mapped, by name."""
        signals = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: register for name, register in signals.items() if register is not None}

    @model_validator(mode="after")
    def _consistent(self) -> RegisterMap:
        mapped = self.mapped()
        for name in ("u", "heartbeat", "enable", "safe", "automatic", "setpoint", "K", "Ti"):
            if name in mapped and not mapped[name].writable:
                raise ValueError(f"{name} is written by the host, so it cannot lie in table {mapped[name].table!r}")
        if (self.K is None) != (self.Ti is None):
            raise ValueError("K and Ti must be mapped together")
        if self.heartbeat_echo is not None and self.heartbeat is None:
            raise ValueError("heartbeat_echo needs heartbeat")
        # the echo may be the heartbeat's own register, read back
        _no_overlap({name: register for name, register in mapped.items() if name != "heartbeat_echo"})
        return self


def _no_overlap(mapped: dict[str, RegisterSettings]) -> None:
    taken = Counter(
        (register.table, register.address + word) for register in mapped.values() for word in range(register.words)
    )
    for (table, address), times in taken.items():
        if times > 1:
            names = [
                name
                for name, register in mapped.items()
                if register.table == table and register.address <= address < register.address + register.words
            ]
            raise ValueError(f"{' and '.join(names)} overlap at {table} {address}")
