"""Signals of a device whose protocol names each of them: nodes of a server, places in data blocks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

from pydantic import Field, model_validator

from autotune.config.registers import RegisterMap
from autotune.schema import Section

#: what a signal may hold; a register has the same names
SignalType = Literal["float64", "float32", "int16", "uint16", "int32", "uint32", "int64", "uint64", "boolean"]
#: words of a number as registers carry it
WORDS = {"float64": 4, "float32": 2, "int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "int64": 4, "uint64": 4}
#: signals that count
COUNTED = ("heartbeat", "heartbeat_echo")
#: signals that a sample is made of, which are read; the others are written
SAMPLE = ("y", "u_applied", "heartbeat_echo", "in_command", "device_time")

One = TypeVar("One", bound=Section)


class Held(NamedTuple):
    """How a signal is held: engineering value = scale x what is there + offset."""

    type: SignalType
    scale: float
    offset: float


def side_by_side(signals: Mapping[str, Held], gains: Mapping[str, Any] | None = None) -> RegisterMap:
    """Return signals as registers side by side, which the driver of register rigs knows.

    What a sample is made of lies in one table, so that it is read together, and the rest in another, in the order in
    which it is written. A signal of true and false is a word that is 1 or 0.

    Parameters
    ----------
    signals : mapping of str to Held
        By name; a setting of a maker's form as ``gains.NAME``.
    gains : mapping, optional
        The form of the gains, without its ``settings``.
    """
    found: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    at = {"input": 0, "holding": 0}
    for name, held in signals.items():
        table = "input" if name in SAMPLE else "holding"
        kind = "uint16" if held.type == "boolean" else held.type
        place = {"table": table, "address": at[table], "type": kind, "scale": held.scale, "offset": held.offset}
        within = name.removeprefix("gains.")
        (found if within == name else settings)[within] = place
        at[table] += WORDS[kind]
    if gains is not None:
        found["gains"] = dict(gains) | {"settings": settings}
    return RegisterMap.model_validate(found)


def _signal(description: str) -> Any:
    return Field(default=None, description=description)


class SignalMap(Section, Generic[One]):
    """Where each signal is; a text is its place, a table its type, scale and offset too."""

    #: key of a signal's place in its table
    place_key: ClassVar[str]

    y: Annotated[One, Field(description="measurement [y unit]")]
    u: Annotated[One, Field(description="command from the host [u unit]")]
    u_applied: One | None = _signal("output the device applies [u unit]")
    heartbeat: One | None = _signal("counter the host writes; the device is safe where it stands still")
    heartbeat_echo: One | None = _signal("the last heartbeat that the device's program took")
    enable: One | None = _signal("true while the host commands the actuator, false to give it back")
    in_command: One | None = _signal("true while the device lets the host's command act")
    safe: One | None = _signal("output that the device sets when the host falls silent [u unit]")
    automatic: One | None = _signal("true while the device's own controller may run")
    trial: One | None = _signal("true while gains are on trial: the heartbeat is watched in automatic too")
    setpoint: One | None = _signal("set-point of the device's own controller [y unit]")
    load: One | None = _signal("added to the output of the device's own controller [u unit]")
    K: One | None = _signal("proportional gain of the device's own controller [u unit/y unit]")
    Ti: One | None = _signal("integral time of the device's own controller [s]")
    Td: One | None = _signal("derivative time of the device's own controller [s]")
    Tf: One | None = _signal("time constant of the device's own measurement filter [s]")

    @model_validator(mode="before")
    @classmethod
    def _texts(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        return {name: {cls.place_key: value} if isinstance(value, str) else value for name, value in given.items()}

    def mapped(self) -> dict[str, One]:
        """Return the signals that are mapped, by name."""
        named = ((name, getattr(self, name)) for name in type(self).model_fields)
        return {name: one for name, one in named if one is not None}

    def registers(self) -> RegisterMap:
        """Return the signals as registers side by side; see :func:`side_by_side`."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _consistent(self) -> SignalMap[One]:
        self.registers()  # what holds of registers holds of these signals
        return self
