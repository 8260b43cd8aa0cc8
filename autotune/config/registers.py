"""Register map of a Modbus device: which register holds which signal, in which form and unit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from autotune.controller_forms import FORMS, ControllerForm, Spans
from autotune.schema import Number, Section

RegisterType = Literal["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64", "bit"]

_BIT_TABLES = ("coil", "discrete")
_WIDTH = {"int32": 2, "uint32": 2, "float32": 2, "int64": 4, "uint64": 4, "float64": 4}
#: signals that are true or false
LOGICAL = ("enable", "in_command", "automatic", "trial")


class RegisterSettings(Section):
    """One signal of the device: engineering value = scale x raw + offset; or true and false as bit or code."""

    table: Annotated[
        Literal["holding", "input", "coil", "discrete"],
        Field(description="holding and coil can be written, input and discrete only read"),
    ] = "holding"
    address: Annotated[int, Field(ge=0, le=65535, description="address as sent on the line, counted from 0, 0..65535")]
    type: Annotated[
        RegisterType,
        Field(
            description="int16, uint16, and so to int64, uint64; float32, float64; a coil or discrete input is a bit"
        ),
    ] = "int16"
    byte_order: Annotated[Literal["big", "little"], Field(description="order of the bytes within a word")] = "big"
    word_order: Annotated[
        Literal["big", "little"], Field(description="order of the words of a value of 32 or 64 bits")
    ] = "big"
    scale: Annotated[Number, Field(description="engineering units per count, not 0")] = 1.0
    offset: Annotated[Number, Field(description="engineering value at count 0")] = 0.0
    not_a_value: Annotated[
        int | None, Field(description="raw count by which the device says that it has no measurement")
    ] = None
    bit: Annotated[
        int | None,
        Field(ge=0, le=63, description="which bit of a control or status word, 0 the lowest; its other bits are kept"),
    ] = None
    on: Annotated[int | None, Field(description="code or bit that means yes; default 1")] = None
    off: Annotated[
        int | None,
        Field(description="code or bit that is written for no; default 0. An inverted bit has on = 0, off = 1"),
    ] = None

    @model_validator(mode="before")
    @classmethod
    def _types(cls, given: Any) -> Any:
        """Take the type that a coil or a discrete input can only have, and words without a sign for bits of them."""
        if isinstance(given, dict) and given.get("table") in _BIT_TABLES:
            return {"type": "bit"} | given
        if isinstance(given, dict) and given.get("bit") is not None:
            return {"type": "uint16"} | given
        return given

    @model_validator(mode="after")
    def _consistent(self) -> RegisterSettings:
        if self.scale == 0.0:
            raise ValueError("scale = 0 would make every value the same")
        if (self.table in _BIT_TABLES) != (self.type == "bit"):
            raise ValueError(f'table = "{self.table}" and type = "{self.type}": coils and discrete inputs hold a bit')
        if self.address + self.words > 65536:
            raise ValueError(f"a {self.type} at address {self.address} ends beyond 65535")
        if self.bit is not None and (self.type not in ("uint16", "uint32", "uint64") or self.bit >= 16 * self.words):
            raise ValueError(f"bit {self.bit} is one of a uint16 (0..15), a uint32 (0..31) or a uint64 (0..63)")
        if self.is_coded and (self.type.startswith("float") or (self.scale, self.offset) != (1.0, 0.0)):
            raise ValueError("a bit or a code has no scale, no offset and no float")
        yes, no = self.codes
        if yes == no:
            raise ValueError(f"on = {yes} and off = {no} cannot be told apart")
        if (self.bit is not None or self.type == "bit") and {yes, no} != {0, 1}:
            raise ValueError(f"on = {yes}, off = {no}: a bit is 0 or 1")
        return self

    @property
    def words(self) -> int:
        """Number of 16-bit registers, or 1 for a bit."""
        return _WIDTH.get(self.type, 1)

    @property
    def writable(self) -> bool:
        """Whether the table can be written."""
        return self.table in ("holding", "coil")

    @property
    def step(self) -> float:
        """Engineering units between two values that the register can hold; 0 for a float."""
        return 0.0 if self.type.startswith("float") else abs(self.scale)

    def inwards(self, low: float, high: float) -> tuple[float, float]:
        """Return the lowest and the highest value that the register can hold between two limits.

        Parameters
        ----------
        low, high : float
            The limits, in the value's unit.

        Raises
        ------
        ValueError
            There are not two of them.
        """
        if not self.step:
            return low, high
        first, last = sorted(((low - self.offset) / self.scale, (high - self.offset) / self.scale))
        # a limit that misses its count by rounding alone is on it
        counts = [math.ceil(first - 1e-6), math.floor(last + 1e-6)]
        if counts[0] >= counts[1]:
            raise ValueError(f"between {low:g} and {high:g} the register has not two values: its step is {self.step:g}")
        held = sorted(self.scale * count + self.offset for count in counts)
        cut = [
            limit if abs(limit - end) <= 1e-6 * self.step else end for limit, end in zip((low, high), held, strict=True)
        ]
        return cut[0], cut[1]

    @property
    def is_coded(self) -> bool:
        """Whether the value is yes or no, as a bit of a word or as a code."""
        return self.bit is not None or self.on is not None or self.off is not None

    @property
    def codes(self) -> tuple[int, int]:
        """What means yes, and what is written for no."""
        return (1 if self.on is None else self.on), (0 if self.off is None else self.off)


class UnlockSettings(RegisterSettings):
    """A register that takes a code before the device takes new gains: a password, a parameter lock."""

    code: Annotated[int, Field(description="count that is written before gains")]
    lock: Annotated[int | None, Field(description="count that is written after gains; absent: it locks itself")] = None


class GainSettings(Section):
    """The device's own controller in its maker's form: which register holds which setting."""

    form: Annotated[str, Field(description="the form, as autotune controller --help lists them")]
    u_span: Annotated[Number, Field(gt=0, description="engineering span of the output, for percent forms [u unit]")] = (
        1.0
    )
    y_span: Annotated[Number, Field(gt=0, description="engineering span of the measurement [y unit]")] = 1.0
    sample_time_s: Annotated[Number, Field(ge=0, description="the device's own, for the velocity form [s]")] = 0.0
    settings: Annotated[
        Mapping[str, RegisterSettings],
        Field(description="register by setting, as the form calls it; reverse_acting is the action, where it has one"),
    ]
    fixed: Annotated[
        Mapping[str, Number],
        Field(description="settings that the device has and that are set by hand, e.g. reverse_acting = 0"),
    ] = {}

    @model_validator(mode="after")
    def _consistent(self) -> GainSettings:
        if self.form not in FORMS:
            raise ValueError(f"form = {self.form!r} is none of {', '.join(FORMS)}")
        known = (*self.record.settings, "reverse_acting")
        for name in (*self.settings, *self.fixed):
            if name not in known:
                raise ValueError(f"{name!r} is no setting of the form {self.form}: {', '.join(known)}")
            if name in self.settings and name in self.fixed:
                raise ValueError(f"{name} is both in a register and fixed")
        for name, register in self.settings.items():
            if register.bit is not None or (register.is_coded and name != "reverse_acting"):
                raise ValueError(f"{name} is a number; reverse_acting alone may be a code, in a register of its own")
        for name, neutral in self.record.settings.items():
            if math.isnan(neutral) and name not in self.settings:
                raise ValueError(f"{name} of the form {self.form} needs a register in settings")
        if self.form == "velocity" and not self.sample_time_s > 0.0:
            raise ValueError("the velocity form needs the device's sample_time_s")
        return self

    @property
    def record(self) -> ControllerForm:
        """The form."""
        return FORMS[self.form]

    @property
    def spans(self) -> Spans:
        """What the settings are relative to."""
        return Spans(u=self.u_span, y=self.y_span, sample_time_s=self.sample_time_s)


#: registers of the map itself, as settings of the form in which this project has its gains
_PLAIN = {"K": "K", "Ti": "Ti_s", "Td": "Td_s", "Tf": "Tf_s"}


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
    trial: RegisterSettings | None = _signal(
        "1 while its gains are on trial: where the heartbeat stands still, the device is safe in automatic too"
    )
    setpoint: RegisterSettings | None = _signal("set-point of the device's own controller [y unit]")
    load: RegisterSettings | None = _signal(
        "added to the output of the device's own controller, for a load step of its verification [u unit]"
    )
    K: RegisterSettings | None = _signal("proportional gain of the device's own controller [u unit/y unit]")
    Ti: RegisterSettings | None = _signal("integral time of the device's own controller [s]; 0 is no integral action")
    Td: RegisterSettings | None = _signal("derivative time of the device's own controller [s]; absent: it is a PI")
    Tf: RegisterSettings | None = _signal("time constant of the device's own measurement filter [s]")
    gains: GainSettings | None = Field(
        default=None, description="the gains in a maker's form, in place of K, Ti, Td, Tf"
    )
    unlock: UnlockSettings | None = Field(
        default=None, description="register that takes a code before gains are written"
    )

    def mapped(self) -> dict[str, RegisterSettings]:
        """Return the signals that are mapped, by name; settings of a maker's form as ``gains.NAME``."""
        signals = {name: getattr(self, name) for name in type(self).model_fields if name not in ("gains", "unlock")}
        settings = self.gains.settings if self.gains is not None else {}
        found = {name: register for name, register in signals.items() if register is not None}
        return found | {f"gains.{name}": register for name, register in settings.items()}

    @property
    def held_gains(self) -> GainSettings | None:
        """The gains of the device's own controller, however they are mapped; None where they are not."""
        if self.gains is not None:
            return self.gains
        registers = {setting: getattr(self, name) for name, setting in _PLAIN.items()}
        present = {setting: register for setting, register in registers.items() if register is not None}
        return GainSettings(form="isa", settings=present) if present else None

    @property
    def gain_names(self) -> dict[str, str]:
        """Names by which :meth:`mapped` knows the settings of :attr:`held_gains`, by setting."""
        if self.gains is not None:
            return {name: f"gains.{name}" for name in self.gains.settings}
        return {setting: name for name, setting in _PLAIN.items() if getattr(self, name) is not None}

    @model_validator(mode="after")
    def _consistent(self) -> RegisterMap:
        mapped = self.mapped()
        written = ("u", "heartbeat", "safe", "setpoint", "load", *LOGICAL, *_PLAIN)
        for name, register in mapped.items():
            if (name in written or name.startswith("gains.")) and name != "in_command" and not register.writable:
                raise ValueError(f"{name} is written by the host, so it cannot lie in table {register.table!r}")
            if register.is_coded and name not in (*LOGICAL, "gains.reverse_acting"):
                raise ValueError(f"{name} is a number: bit, on and off are for {', '.join(LOGICAL)}")
        if (self.K is None) != (self.Ti is None):
            raise ValueError("K and Ti must be mapped together")
        if self.K is None and (self.Td is not None or self.Tf is not None):
            raise ValueError("Td and Tf need K and Ti")
        if self.K is not None and self.gains is not None:
            raise ValueError("gains are mapped twice: give K, Ti, Td, Tf or [rig.registers.gains]")
        if self.heartbeat_echo is not None and self.heartbeat is None:
            raise ValueError("heartbeat_echo needs heartbeat")
        if self.trial is not None and (self.heartbeat is None or self.automatic is None):
            raise ValueError("trial needs heartbeat and automatic")
        if self.unlock is not None and not self.unlock.writable:
            raise ValueError(f"unlock is written by the host, so it cannot lie in table {self.unlock.table!r}")
        # the echo may be the heartbeat's own register, read back
        _no_overlap({name: register for name, register in mapped.items() if name != "heartbeat_echo"})
        return self


def _no_overlap(mapped: dict[str, RegisterSettings]) -> None:
    for (one, a), (other, b) in combinations(mapped.items(), 2):
        if a.table != b.table or a.address >= b.address + b.words or b.address >= a.address + a.words:
            continue
        # bits of one word lie side by side
        if a.bit is None or b.bit is None or a.bit == b.bit or (a.address, a.type) != (b.address, b.type):
            raise ValueError(f"{one} and {other} overlap at {a.table} {max(a.address, b.address)}")
