"""The simulated devices' own register coding; on purpose it shares nothing with the coding of the drivers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

Table = Literal["holding", "input", "coil", "discrete"]

_SIGNED = {"int16": 16, "int32": 32}
_UNSIGNED = {"uint16": 16, "uint32": 32}


@dataclass(frozen=True, kw_only=True)
class RegisterSpec:
    """Where the device keeps a signal, and how; engineering value = scale x count + offset."""

    table: Table
    address: int
    type: Literal["int16", "uint16", "int32", "uint32", "float32", "bit"] = "int16"
    byte_order: Literal["big", "little"] = "big"
    word_order: Literal["big", "little"] = "big"
    scale: float = 1.0
    offset: float = 0.0

    @property
    def size(self) -> int:
        """Number of registers, or of bits."""
        return 2 if self.type.endswith("32") else 1


def to_words(value: float, spec: RegisterSpec) -> list[int]:
    """Return the registers that show a value; beyond the register's range it sticks at the end, as in real devices."""
    if spec.type == "bit":
        return [1 if value else 0]
    count = (value - spec.offset) / spec.scale
    if spec.type == "float32":
        bits = int(np.float32(count).view(np.uint32))
    elif math.isnan(count):
        bits = 1 << (16 * spec.size - 1)
    elif spec.type in _SIGNED:
        top = 1 << (_SIGNED[spec.type] - 1)
        bits = min(max(round(count), -top), top - 1) % (2 * top)
    else:
        bits = min(max(round(count), 0), (1 << _UNSIGNED[spec.type]) - 1)
    words = [bits] if spec.size == 1 else [bits >> 16, bits & 0xFFFF]
    if spec.byte_order == "little":
        words = [(word & 0xFF) << 8 | word >> 8 for word in words]
    return words if spec.word_order == "big" else words[::-1]


def from_words(words: list[int], spec: RegisterSpec) -> float:
    """Return the value that was written into the registers."""
    if spec.type == "bit":
        return float(bool(words[0]))
    words = words if spec.word_order == "big" else words[::-1]
    if spec.byte_order == "little":
        words = [(word & 0xFF) << 8 | word >> 8 for word in words]
    bits = words[0] if spec.size == 1 else words[0] << 16 | words[1]
    if spec.type == "float32":
        count = float(np.uint32(bits).view(np.float32))
    elif spec.type in _SIGNED and bits >= 1 << (_SIGNED[spec.type] - 1):
        count = float(bits - (1 << _SIGNED[spec.type]))
    else:
        count = float(bits)
    return spec.scale * count + spec.offset
