"""The short form of ``make fuzz``: every family, a few inputs each, and the inputs that once were answered badly."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.fuzz.campaign import answers
from tests.fuzz.families import FAMILIES

#: inputs that ended in a traceback, a hang or a wrong exit when they were first tried: family and number, by seed
ONCE = {
    0: [("recordings", 60)],
    1: [("workbooks", 4), ("workbooks", 30), ("workbooks", 34)],
    2: [("fmus", 77)],
    7: [("models", 76), ("models", 147), ("controllers", 66)],
    11: [("models", 568), ("options", 57)],
    1801: [("options", 31)],
    2912: [("edges", 322), ("parquet", 1174)],
    2911: [("live story", 266), ("live story", 397), ("configs", 49)],
    2002: [("models", 2395), ("points", 3849), ("points", 5169), ("live story", 3778)],
    29103: [("structure", 137)],
    29104: [("structure", 32), ("structure", 45)],
}


def faults(orders: Sequence[tuple[str, int]], seed: int, folder: Path) -> list[str]:
    return [f"{one.family} {one.number}: {one.fault}\n{one.said}" for one in answers(orders, seed, folder) if one.fault]


def test_damaged_inputs_are_answered_in_one_line(tmp_path: Path) -> None:
    orders = [(family.name, number) for number in range(12) for family in FAMILIES]
    assert faults(orders, 1, tmp_path) == []


@pytest.mark.parametrize("seed", sorted(ONCE))
def test_what_was_once_answered_badly_is_answered_well(seed: int, tmp_path: Path) -> None:
    assert faults(ONCE[seed], seed, tmp_path) == []
