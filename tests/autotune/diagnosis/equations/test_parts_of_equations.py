"""Equations that state where they begin, on a part of the rows."""

from __future__ import annotations

import pytest

from autotune.diagnosis.agreement import parts_of
from autotune.diagnosis.equations.gathering_equations import evidence_of_equations
from autotune.diagnosis.thresholds import IN_USE
from autotune.effects import KINDS
from autotune.equations.read import equations_of
from autotune.progress import quiet
from tests.autotune.diagnosis.thrown_pendulum import DAMPING, GRAVITY, driven

DRY = "plant.coulomb_friction"
PENDULUM = equations_of(
    {
        "input": [{"column": "u"}],
        "output": {"value": "angle", "unit": "rad"},
        "state": [
            {"name": "angle", "unit": "rad", "kind": "position", "start": 0.0, "derivative": "speed"},
            {"name": "speed", "unit": "rad/s", "kind": "speed", "of": "angle", "start": 0.0,
             "derivative": "u - d*speed - k*sin(angle)"},
        ],
        "parameters": {"d": DAMPING, "k": GRAVITY},
    },
    "pendulum",
)  # fmt: skip


@pytest.mark.parametrize("seed", [2, 3])
def test_a_part_begins_where_the_recording_did(seed: int) -> None:
    """What is stated of its first row is true there alone, and not where the part's readings begin."""
    others = [name for name in KINDS if name != DRY]
    whole = evidence_of_equations(PENDULUM, [driven(seed)], None, others, quiet, IN_USE)
    assert whole.names == (DRY,)
    for part in parts_of([driven(seed)], 100):
        there = whole.on(part)[0]
        assert there is not None
        assert there.names == (DRY,)
        assert there.quality.extended < 0.02
