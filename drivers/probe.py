"""First contact: every register, or all that a microcontroller says, read once, nothing written; what looks wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from autotune.config.registers import RegisterSettings, RegisterType
from autotune.config.rig import AnyModbusSettings, SerialSettings
from autotune.errors import LinkError
from drivers.clock import MonotonicClock
from drivers.line_protocol import Command, Kind
from drivers.modbus import ModbusLink
from drivers.registers import Codec, blocks, codecs
from drivers.serial_line import SerialLink

Order = Literal["big", "little"]

_FLOAT_PLAUSIBLE = (1e-9, 1e9)


@dataclass(frozen=True, kw_only=True)
class ProbedRegister:
    """One mapped signal as the device shows it.

    Attributes
    ----------
    name : str
        Signal.
    register : RegisterSettings
        Where it lies and in which form.
    words : tuple of int
        What was read; empty where the device refused.
    value : float
        Engineering value; NaN where there is none.
    warnings : tuple of str
        What looks wrong with it.
    """

    name: str
    register: RegisterSettings
    words: tuple[int, ...]
    value: float
    warnings: tuple[str, ...]


def probe(settings: AnyModbusSettings, expected: Mapping[str, tuple[float, float]]) -> tuple[ProbedRegister, ...]:
    """Read every mapped register once; nothing is written.

    Parameters
    ----------
    settings : ModbusTcpSettings, ModbusTlsSettings or ModbusRtuSettings
        The table ``[rig]``.
    expected : mapping of str to (float, float)
        Range within which a signal's engineering value is plausible.

    Raises
    ------
    LinkError
        No connection. A register that the device refuses is a warning of its own.
    """
    link = ModbusLink(settings, exclusive=False)
    link.connect()
    named = {f"permissive {one.name!r}": one for one in settings.permissives}
    try:
        return tuple(
            _probe_one(link, codec, expected.get(codec.name))
            for codec in codecs(settings.registers.mapped() | named).values()
        )
    finally:
        link.disconnect()


@dataclass(frozen=True, kw_only=True)
class ProbedSignal:
    """One signal as a microcontroller shows it.

    Attributes
    ----------
    name : str
        Signal.
    raw : str
        As it came over the line.
    value : float
        Engineering value.
    warnings : tuple of str
        What looks wrong with it.
    """

    name: str
    raw: str
    value: float
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ProbedDevice:
    """A microcontroller as it shows itself: who it is, and its signals."""

    description: str
    signals: tuple[ProbedSignal, ...]


def probe_line(settings: SerialSettings, expected: Mapping[str, tuple[float, float]]) -> ProbedDevice:
    """Ask a microcontroller who it is, for a sample and for its gains; nothing is written and no command taken.

    Parameters
    ----------
    settings : SerialSettings
        The table ``[rig]``.
    expected : mapping of str to (float, float)
        Range within which a signal's engineering value is plausible.

    Raises
    ------
    LinkError
        Nobody answers, or it speaks another version.
    """
    link = SerialLink(settings, MonotonicClock())
    try:
        version, ticks, y_full, u_full, starts = link.connect().values
        time_us, y, u, state, _ = link.ask(Kind.READ)[0].values
        K, Ti_s = link.ask(Kind.GET_GAINS)[0].values
    finally:
        link.disconnect()
    who = Command(int(state) & 3).name.lower()
    per_count = (_scale(1.0, settings.u_span, u_full) - settings.u_span[0]) / (
        _scale(1.0, settings.y_span, y_full) - settings.y_span[0]
    )
    return ProbedDevice(
        description=(
            f"microcontroller, firmware {version:g}, {ticks:g} ticks per second, started {starts:g} time(s),"
            f" commanded by {who}"
        ),
        signals=(
            _probe_count("y", y, y_full, settings.y_span, expected.get("y")),
            _probe_count("u_applied", u, u_full, settings.u_span, None),
            ProbedSignal(name="device_time", raw=f"{time_us:g} us", value=1e-6 * time_us),
            ProbedSignal(name="K", raw=f"{K:g} counts/count", value=K * per_count),
            ProbedSignal(name="Ti", raw=f"{Ti_s:g} s", value=Ti_s),
        ),
    )


def _scale(count: float, span: tuple[float, float], full: float) -> float:
    return span[0] + count * (span[1] - span[0]) / full


def _probe_count(
    name: str, count: float, full: float, span: tuple[float, float], expected: tuple[float, float] | None
) -> ProbedSignal:
    value = _scale(count, span, full)
    warnings = []
    if expected is not None and not expected[0] <= value <= expected[1]:
        warnings.append(f"{value:.6g}, expected {expected[0]:g}..{expected[1]:g}; check rig.{name}_span and the wiring")
    if expected is not None and count in (0.0, full):
        warnings.append("at the end of the converter's range; check that the sensor is connected")
    return ProbedSignal(name=name, raw=f"{count:g} of {full:g}", value=value, warnings=tuple(warnings))


def _probe_one(link: ModbusLink, codec: Codec, expected: tuple[float, float] | None) -> ProbedRegister:
    (block,) = blocks([codec])
    try:
        words = tuple(link.read(block).words)
    except LinkError as error:
        warning = f"{error.what}; {error.remedy}"
        return ProbedRegister(name=codec.name, register=codec.register, words=(), value=math.nan, warnings=(warning,))
    return ProbedRegister(
        name=codec.name,
        register=codec.register,
        words=words,
        value=codec.decode(words),
        warnings=tuple(implausible(codec, words, expected)),
    )


def implausible(codec: Codec, words: Sequence[int], expected: tuple[float, float] | None) -> list[str]:
    """Return what looks wrong with a register's content, with the order or type under which it would look right.

    Parameters
    ----------
    codec : Codec
        The register as it is mapped.
    words : sequence of int
        What was read.
    expected : (float, float) or None
        Plausible range of the engineering value, where one is known.

    Notes
    -----
    A guess from one reading: a device at rest may show a value that fits under several orders, such as 0.
    """
    value = codec.decode(words)
    if _plausible(value, codec, expected):
        return []
    shown = "not a number" if math.isnan(value) else f"{value:.6g}"
    outside = f", expected {expected[0]:g}..{expected[1]:g}" if expected else ""
    found = [f"{shown}{outside}"]
    others = [
        other
        for other in _alternatives(codec)
        if (expected is not None or other.register.type.startswith("float"))
        and _plausible(other.decode(words), other, expected)
    ]
    for other in others[:2]:
        changes = ", ".join(
            f'{key} = "{getattr(other.register, key)}"'
            for key in ("type", "byte_order", "word_order")
            if getattr(other.register, key) != getattr(codec.register, key)
        )
        found.append(f"would be {other.decode(words):.6g} with {changes}")
    if not others and expected is not None:
        found.append("check address, scale and offset")
    return found


def _plausible(value: float, codec: Codec, expected: tuple[float, float] | None) -> bool:
    if not math.isfinite(value):
        return False
    if expected is not None:
        low, high = expected
        return low <= value <= high and not _is_denormal(value, codec)
    return not _is_denormal(value, codec) and (
        not codec.register.type.startswith("float") or value == 0.0 or abs(value) <= _FLOAT_PLAUSIBLE[1]
    )


def _is_denormal(value: float, codec: Codec) -> bool:
    """Return whether a float is so small that swapped words are its likelier reading."""
    return codec.register.type.startswith("float") and 0.0 < abs(value) < _FLOAT_PLAUSIBLE[0]


def _alternatives(codec: Codec) -> list[Codec]:
    register = codec.register
    if register.type == "bit" or register.is_coded:
        return []
    words: tuple[Order, ...] = get_args(Order) if register.words > 1 else (register.word_order,)
    forms: list[tuple[RegisterType, Order, Order]] = [
        (register.type, byte, word) for word in words for byte in get_args(Order)
    ]
    forms += [(other, register.byte_order, word) for other in _same_size(register) for word in words]
    # the fewer changes, the likelier: word order first, then byte order, then type
    return [
        Codec(
            name=codec.name,
            register=register.model_copy(update={"type": form, "byte_order": byte, "word_order": word}),
        )
        for form, byte, word in forms
        if (form, byte, word) != (register.type, register.byte_order, register.word_order)
    ]


def _same_size(register: RegisterSettings) -> tuple[RegisterType, ...]:
    sizes: dict[int, tuple[RegisterType, ...]] = {
        1: ("int16", "uint16"),
        2: ("float32", "int32", "uint32"),
        4: ("float64", "int64", "uint64"),
    }
    return tuple(other for other in sizes[register.words] if other != register.type)
