"""Signals in a CPU's data blocks, grouped into as few requests as their places allow: pure functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from autotune.config.s7 import Place

#: what the smallest message that a CPU grants leaves for data [bytes]
MOST = 200


class Part(NamedTuple):
    """A signal in a request."""

    name: str
    place: Place
    size: int
    is_bit: bool


def together(parts: Sequence[Part]) -> list[list[Part]]:
    """Group signals into requests for reading, that of the first signal first; what lies between is read along."""
    found: list[list[Part]] = []
    for part in sorted(parts, key=lambda part: part.place):
        last = found[-1] if found else None
        first = last[0].place if last else None
        if last and first and first.block == part.place.block and part.place.byte + part.size - first.byte <= MOST:
            last.append(part)
        else:
            found.append([part])
    return sorted(found, key=lambda group: parts[0] not in group)


def adjacent(given: Sequence[tuple[Part, bytes]]) -> list[tuple[list[Part], bytes]]:
    """Group signals into requests for writing, in their order: numbers of which one ends where the next begins."""
    found: list[tuple[list[Part], bytes]] = []
    for part, data in given:
        last = found[-1][0][-1] if found else None
        if last is not None and not last.is_bit and not part.is_bit and _end(last) == part.place:
            found[-1] = ([*found[-1][0], part], found[-1][1] + data)
        else:
            found.append(([part], data))
    return found


def _end(part: Part) -> Place:
    return Place(part.place.block, part.place.byte + part.size, 0)
