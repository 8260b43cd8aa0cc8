"""Between registers and engineering values: pure functions of a register's settings, no input or output.

A value passes through four forms: engineering value -> count (scale, offset) -> bytes of the count, most significant
first -> 16-bit words (byte order within the word, order of the words). A signal that is yes or no may instead be one
bit of a word, or a code. ::

    float32 5.0 = 40 A0 00 00     byte_order  word_order   words
                                  big         big          40A0 0000
                                  big         little       0000 40A0
                                  little      big          A040 0000
                                  little      little       0000 A040
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from autotune.config.registers import RegisterSettings
from autotune.errors import InputError

_FORMATS = {
    "int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "int64": ">q", "uint64": ">Q",
    "float32": ">f", "float64": ">d",
}  # fmt: skip
_BIG = {words: struct.Struct(">" + "H" * words) for words in (1, 2, 4)}
_FLOAT_MAX = {"float32": struct.unpack(">f", b"\x7f\x7f\xff\xff")[0], "float64": sys.float_info.max}
#: relative distance of neighbouring floats
_FLOAT_STEP = {"float32": 2.0**-23, "float64": 2.0**-52}
#: part of a count by which a value may miss it and still be on it
_ON_COUNT = 1e-6

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
    _is_coded: bool = field(init=False, repr=False)
    _codes: tuple[int, int] = field(init=False, repr=False)

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
            "_is_coded": register.is_coded,
            "_codes": register.codes,
        }
        for name, value in prepared.items():
            object.__setattr__(self, name, value)

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest engineering value that the register can hold."""
        match self.register.type:
            case "bit":
                return 0.0, 1.0
            case _ if self.register.is_coded:
                return 0.0, 1.0
            case "float32" | "float64" as form:
                low, high = -_FLOAT_MAX[form], _FLOAT_MAX[form]
            case "int16" | "int32" | "int64":
                half = 1 << (16 * self.register.words - 1)
                low, high = -half, half - 1
            case _:
                low, high = 0, (1 << 16 * self.register.words) - 1
        ends = sorted(self.register.scale * count + self.register.offset for count in (low, high))
        return ends[0], ends[1]

    @property
    def resolution(self) -> float:
        """Engineering units per count; 0 where the register holds a float."""
        return 0.0 if self.register.type in _FLOAT_MAX else abs(self.register.scale)

    def decode(self, words: Sequence[int]) -> float:
        """Return the engineering value of the words, NaN where the device says that it has none."""
        return self.decode_from(struct.pack(f">{len(words)}H", *words), 0)

    def decode_from(self, data: bytes, at: int) -> float:
        """Return the engineering value at a place in registers.

        Parameters
        ----------
        data : bytes
            Registers as they came over the line, the high byte of each first.
        at : int
            Where the value begins [bytes].
        """
        if self._count is None:
            return float(data[at + 1] == self._codes[0])
        if self._is_plain:
            (count,) = self._count.unpack_from(data, at)
        else:
            words = self._words.unpack_from(data, at)
            (count,) = self._count.unpack(_BIG[len(words)].pack(*(words[::-1] if self._is_reversed else words)))
        if self._is_coded:
            return float((count if self.register.bit is None else count >> self.register.bit & 1) == self._codes[0])
        if count == self._none:
            return math.nan
        return float(self._scale * count + self._offset)

    def encode(self, value: float, held: Sequence[int] = ()) -> tuple[int, ...]:
        """Return the words of the engineering value, rounded to the nearest count.

        Parameters
        ----------
        value : float
            Engineering value; 0 or 1 where the signal is no or yes.
        held : sequence of int
            What the register holds now; needed of a bit within a word, whose other bits are kept.

        Raises
        ------
        InputError
            The value is not a number, or its count does not fit the register: it is refused, never clipped.
        """
        register = self.register
        if not math.isfinite(value):
            raise InputError(f"{value} is not a value", where=self.name, remedy="give a finite number")
        if self._count is None or self._is_coded:
            if value not in (0.0, 1.0):
                raise InputError(f"{value:g} does not fit a bit or a code", where=self.name, remedy="give 0 or 1")
            return self._encode_code(self._codes[0 if value else 1], held)
        count = (value - self._offset) / self._scale
        return self._pack_count(count if register.type in _FLOAT_MAX else round(count), value)

    def encode_within(self, value: float, low: float, high: float) -> tuple[int, ...]:
        """Return the words of the count that is nearest to the value and within limits.

        Parameters
        ----------
        value : float
            Engineering value, within the limits.
        low, high : float
            Limits that what the register then holds keeps too: a value is rounded away from the limit that its nearest
            count would pass.

        Raises
        ------
        InputError
            The value is outside its limits, no count near it is within them, or it does not fit the register.
        """
        slack = _ON_COUNT * self.resolution + 1e-12 * max(abs(low), abs(high))
        if low - slack <= value <= high + slack:
            words = self.encode(value)
            held = self.decode(words)
            step = self.resolution or abs(held) * _FLOAT_STEP.get(self.register.type, 0.0)
            for _ in range(2):  # a scaled float may round twice
                if low - slack <= held <= high + slack:
                    return words
                words = self.encode(held + step if held < low else held - step)
                held = self.decode(words)
            if low - slack <= held <= high + slack:
                return words
        raise InputError(
            f"{value:.9g} cannot be held within {low:g}..{high:g}: the register has steps of {self.resolution:g}",
            where=self.name,
            remedy="keep to the limits, or give the register a finer scale",
        )

    def _encode_code(self, code: int, held: Sequence[int]) -> tuple[int, ...]:
        bit = self.register.bit
        if self._count is None:
            return (code,)
        if bit is None:
            return self._pack_count(code, code)
        if len(held) != self.register.words:
            raise InputError("a bit is written into its word", where=self.name, remedy="read the word first")
        data = struct.pack(f">{len(held)}H", *held)
        words = self._words.unpack(data)
        (count,) = self._count.unpack(_BIG[len(words)].pack(*(words[::-1] if self._is_reversed else words)))
        return self._pack_count(count & ~(1 << bit) | code << bit, code)

    def _pack_count(self, count: float, value: float) -> tuple[int, ...]:
        """Return the words of a count."""
        assert self._count is not None
        try:
            packed = self._count.pack(count)
        except (struct.error, OverflowError):
            low, high = self.span
            raise InputError(
                f"{value:g} does not fit the register ({self.register.type}, scale {self._scale:g}, "
                f"offset {self._offset:g})",
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


def blocks(signals: Sequence[Codec]) -> tuple[Block, ...]:
    """Group signals into as few requests as possible, keeping the block of the first signal first.

    No register without a signal is touched: a write would overwrite it, and a device may refuse the address.

    Parameters
    ----------
    signals : sequence of Codec
        Signals to be read or written together.
    """
    found: list[list[Codec]] = []
    for codec in sorted(signals, key=lambda codec: (codec.register.table, codec.register.address)):
        last = found[-1] if found else None
        if last is not None and _joins(last, codec):
            last.append(codec)
        else:
            found.append([codec])
    grouped = [_block(members) for members in found]
    return tuple(sorted(grouped, key=lambda block: all(part is not signals[0] for part, _ in block.parts)))


def _end(members: Sequence[Codec]) -> int:
    return max(codec.register.address + codec.register.words for codec in members)


def _joins(members: Sequence[Codec], codec: Codec) -> bool:
    register = codec.register
    return (
        register.table == members[0].register.table
        and register.address <= _end(members)
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
