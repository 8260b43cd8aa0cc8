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
_BIG = {1: struct.Struct(">H"), 2: struct.Struct(">HH")}
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
    _is_reversed: bool = field(init=False, repr=False)
    _is_plain: bool = field(init=False, repr=False)
    _scale: float = field(init=False, repr=False)
    _offset: float = field(init=False, repr=False)
    _none: int | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        register = self.register
        order = ">" if register.byte_order == "big" else "<"
        form = _FORMATS.get(register.type)
        prepared = {  # a sample is decoded in every control cycle
            "_words": struct.Struct(order + "H" * register.words),
            "_count": struct.Struct(form) if form else None,
            "_is_reversed": register.word_order == "little",
            "_is_plain": register.byte_order == "big" and (register.word_order == "big" or register.words == 1),
            "_scale": register.scale,
            "_offset": register.offset,
            "_none": register.not_a_value,
        }
        for name, value in prepared.items():
            object.__setattr__(self, name, value)

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
        return self.decode_from(struct.pack(f">{len(words)}H", *words), 0)

    def decode_from(self, data: bytes, at: int) -> float:
        """Return the engineering value at a place [bytes] in registers as they came over the line."""
        if self._count is None:
            return float(data[at + 1])
        if self._is_plain:
            (count,) = self._count.unpack_from(data, at)
        else:
            words = self._words.unpack_from(data, at)
            (count,) = self._count.unpack(_BIG[len(words)].pack(*(words[::-1] if self._is_reversed else words)))
        if count == self._none:
            return math.nan
        return float(self._scale * count + self._offset)

    def encode(self, value: float) -> tuple[int, ...]:
        """Return the words of the engineering value, rounded to the nearest count.

        Raises
        ------
        InputError
            The value is not a number, or its count does not fit the register: it is refused, never clipped.
        """
        register = self.register
        if not math.isfinite(value):
            raise InputError(f"{value} is not a value", where=self.name, remedy="give a finite number")
        count = (value - self._offset) / self._scale
        if self._count is None:
            if value not in (0.0, 1.0):
                raise InputError(f"{value:g} does not fit a bit", where=self.name, remedy="give 0 or 1")
            return (int(value),)
        try:
            packed = self._count.pack(count if register.type == "float32" else round(count))
        except (struct.error, OverflowError):
            low, high = self.span
            raise InputError(
                f"{value:g} does not fit the register ({register.type}, scale {register.scale:g}, "
                f"offset {register.offset:g})",
                where=self.name,
                remedy=f"stay within {low:g}..{high:g}, or correct type, scale and offset in the register map",
            ) from None
        words = self._words.unpack(packed)
        return words[::-1] if self._is_reversed else words


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

    _words: struct.Struct = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_words", struct.Struct(f">{self.count}H"))

    def decode(self, words: Sequence[int]) -> dict[str, float]:
        """Return the engineering values by signal."""
        data = self._words.pack(*words)
        return {codec.name: codec.decode_from(data, 2 * at) for codec, at in self.parts}


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
