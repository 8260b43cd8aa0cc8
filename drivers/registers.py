"""Between registers and engineering values: pure functions of a register's settings, no input or output.

A value passes through four forms: engineering value -> count (scale, offset) -> bytes of the count, most significant
first -> 16-bit words (byte order within the word, order of the words). ::

    float32 5.0 = 40 A0 00 00     byte_order  word_order   words
                                  big         big          40A0 0000
                                  big         little       0000 40A0
                                  little      big          A040 0000
                                  little      little       0000 A040
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from autotune.config.registers import RegisterSettings
from autotune.errors import InputError

_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}
_FLOAT32_MAX = struct.unpack(">f", b"\x7f\x7f\xff\xff")[0]

#: Largest count of one request (Modbus Application Protocol V1.1b3, 6.1 to 6.4).
MAX_WORDS = 125


@dataclass(frozen=True, kw_only=True)
class Codec:
    """One signal's way between registers and engineering values.

    Attributes
    ----------
    name : str
        The signal, for messages.
    register : RegisterSettings
        Where it lies and in which form.
    """

    name: str
    register: RegisterSettings
    _words: struct.Struct = field(init=False, repr=False)
    _count: struct.Struct | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        order = ">" if self.register.byte_order == "big" else "<"
        object.__setattr__(self, "_words", struct.Struct(order + "H" * self.register.words))
        form = _FORMATS.get(self.register.type)
        object.__setattr__(self, "_count", struct.Struct(form) if form else None)

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest engineering value that the register can hold."""
        match self.register.type:
            case "bit":
                return 0.0, 1.0
            case "float32":
                low, high = -_FLOAT32_MAX, _FLOAT32_MAX
            case "int16" | "int32":
                half = 1 << (16 * self.register.words - 1)
                low, high = -half, half - 1
            case _:
                low, high = 0, (1 << 16 * self.register.words) - 1
        ends = sorted(self.register.scale * count + self.register.offset for count in (low, high))
        return ends[0], ends[1]

    @property
    def resolution(self) -> float:
        """Engineering units per count; 0 where the register holds a float."""
        return 0.0 if self.register.type == "float32" else abs(self.register.scale)

    def decode(self, words: Sequence[int]) -> float:
        """Return the engineering value of the words, NaN where the device says that it has none."""
        register = self.register
        if self._count is None:
            return float(words[0])
        if register.word_order == "little":
            words = words[::-1]
        (count,) = self._count.unpack(self._words.pack(*words))
        if count == register.not_a_value:
            return math.nan
        return float(register.scale * count + register.offset)

    def encode(self, value: float) -> tuple[int, ...]:
        """Return the words of the engineering value, rounded to the nearest count.

        Raises
        ------
        InputError
            The value is not a number, or its count does not fit the register: it is refused, never clipped.
        """
        register = self.register
        if not math.isfinite(value):
            raise InputError(f"{value} is not a value", where=self.name, mend="give a finite number")
        count = (value - register.offset) / register.scale
        if self._count is None:
            if value not in (0.0, 1.0):
                raise InputError(f"{value:g} does not fit a bit", where=self.name, mend="give 0 or 1")
            return (int(value),)
        try:
            packed = self._count.pack(count if register.type == "float32" else round(count))
        except (struct.error, OverflowError):
            low, high = self.span
            raise InputError(
                f"{value:g} does not fit the register ({register.type}, scale {register.scale:g}, "
                f"offset {register.offset:g})",
                where=self.name,
                mend=f"stay within {low:g}..{high:g}, or correct type, scale and offset in the register map",
            ) from None
        words = self._words.unpack(packed)
        return words[::-1] if register.word_order == "little" else words


def codecs(registers: Mapping[str, RegisterSettings]) -> dict[str, Codec]:
    """Return a codec for each mapped signal."""
    return {name: Codec(name=name, register=register) for name, register in registers.items()}


@dataclass(frozen=True, kw_only=True)
class Block:
    """Registers that lie side by side and travel in one request.

    Attributes
    ----------
    table : str
        Table of the device.
    address, count : int
        First register and how many.
    parts : tuple of (Codec, int)
        The signals within, each with its offset from ``address``.
    """

    table: str
    address: int
    count: int
    parts: tuple[tuple[Codec, int], ...]

    def decode(self, words: Sequence[int]) -> dict[str, float]:
        """Return the engineering values by signal."""
        return {codec.name: codec.decode(words[offset : offset + codec.register.words]) for codec, offset in self.parts}


def blocks(signals: Sequence[Codec], *, gap: int = 0) -> tuple[Block, ...]:
    """Group signals into as few requests as possible, keeping the block of the first signal first.

    Parameters
    ----------
    signals : sequence of Codec
        Signals to be read or written together.
    gap : int
        How many registers without a signal may be read along; 0 for writes, where they would be overwritten, and for
        devices that refuse a request which touches an address they do not have.
    """
    found: list[list[Codec]] = []
    for codec in sorted(signals, key=lambda codec: (codec.register.table, codec.register.address)):
        last = found[-1] if found else None
        if last is not None and _joins(last, codec, gap):
            last.append(codec)
        else:
            found.append([codec])
    grouped = [_block(members) for members in found]
    return tuple(sorted(grouped, key=lambda block: all(part is not signals[0] for part, _ in block.parts)))


def _end(members: Sequence[Codec]) -> int:
    return max(codec.register.address + codec.register.words for codec in members)


def _joins(members: Sequence[Codec], codec: Codec, gap: int) -> bool:
    register = codec.register
    return (
        register.table == members[0].register.table
        and register.address - _end(members) <= gap
        and register.address + register.words - members[0].register.address <= MAX_WORDS
    )


def _block(members: Sequence[Codec]) -> Block:
    address = members[0].register.address
    return Block(
        table=members[0].register.table,
        address=address,
        count=_end(members) - address,
        parts=tuple((codec, codec.register.address - address) for codec in members),
    )
