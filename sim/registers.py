"""The simulated devices' own register coding; on purpose it shares nothing with the coding of the drivers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

Table = Literal["holding", "input", "coil", "discrete"]

_SIGNED = {"int16": 16, "int32": 32, "int64": 64}
_UNSIGNED = {"uint16": 16, "uint32": 32, "uint64": 64}


@dataclass(frozen=True, kw_only=True)
class RegisterSpec:
    """Where the device keeps a signal, and how; engineering value = scale x count + offset.

    ``bit`` is the place of a yes or no within its word, ``on`` and ``off`` are the codes for them; None where it has
    none.
    """

    table: Table
    address: int
    type: Literal["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64", "bit"] = "int16"
    byte_order: Literal["big", "little"] = "big"
    word_order: Literal["big", "little"] = "big"
    scale: float = 1.0
    offset: float = 0.0
    bit: int | None = None
    on: int | None = None
    off: int | None = None

    @property
    def size(self) -> int:
        """Number of registers, or of bits."""
        return 4 if self.type.endswith("64") else 2 if self.type.endswith("32") else 1

    @property
    def says(self) -> tuple[int, int] | None:
        """Codes for no and yes; None where the signal is a number."""
        if self.bit is None and self.on is None and self.off is None:
            return None
        return self.off if self.off is not None else 0, self.on if self.on is not None else 1


def to_words(value: float, spec: RegisterSpec) -> list[int]:
    """Return the registers that show a value; beyond the register's range it sticks at the end, as in real devices.

    Parameters
    ----------
    value : float
        In engineering units.
    spec : RegisterSpec
        How the register holds it.
    """
    if spec.says is not None:
        code = spec.says[1 if value else 0]
        count = float(code << spec.bit if spec.bit is not None else code)
    elif spec.type == "bit":
        return [1 if value else 0]
    else:
        count = (value - spec.offset) / spec.scale
    if spec.type == "bit":
        return [int(count)]
    if spec.type == "float32":
        bits = int(np.float32(count).view(np.uint32))
    elif spec.type == "float64":
        bits = int(np.float64(count).view(np.uint64))
    elif math.isnan(count):
        bits = 1 << (16 * spec.size - 1)
    elif spec.type in _SIGNED:
        top = 1 << (_SIGNED[spec.type] - 1)
        bits = round(min(max(count, -top), top - 1)) % (2 * top)
    else:
        bits = round(min(max(count, 0), (1 << _UNSIGNED[spec.type]) - 1))
    words = [bits >> 16 * place & 0xFFFF for place in reversed(range(spec.size))]
    if spec.byte_order == "little":
        words = [(word & 0xFF) << 8 | word >> 8 for word in words]
    return words if spec.word_order == "big" else words[::-1]


def from_words(words: list[int], spec: RegisterSpec) -> float:
    """Return the value that was written into the registers.

    Parameters
    ----------
    words : list of int
        16 bits each, as many as the register has.
    spec : RegisterSpec
        How the register holds it.
    """
    if spec.type == "bit":
        return float(bool(words[0])) if spec.says is None else float(words[0] == spec.says[1])
    words = words if spec.word_order == "big" else words[::-1]
    if spec.byte_order == "little":
        words = [(word & 0xFF) << 8 | word >> 8 for word in words]
    bits = 0
    for word in words:
        bits = bits << 16 | word
    if spec.type == "float32":
        count = float(np.uint32(bits).view(np.float32))
    elif spec.type == "float64":
        count = float(np.uint64(bits).view(np.float64))
    elif spec.type in _SIGNED and bits >= 1 << (_SIGNED[spec.type] - 1):
        count = float(bits - (1 << _SIGNED[spec.type]))
    else:
        count = float(bits)
    if spec.says is not None:
        return float((count if spec.bit is None else bits >> spec.bit & 1) == spec.says[1])
    return spec.scale * count + spec.offset
