"""The table of thresholds: every row says its unit, its meaning and where it comes from, and is read by the room."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import get_args

import pytest

import autotune
from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.thresholds import IN_USE, Origin, table
from autotune.effects import CATALOGUE
from tests.autotune.diagnosis.servo_rigs import servo_model, servo_recording


def test_every_row_says_unit_meaning_and_origin() -> None:
    for name, _, unit, meaning, origin in table(IN_USE):
        assert unit, name
        assert len(meaning) > 6, name
        assert origin in get_args(Origin), name


def test_every_threshold_decides_something() -> None:
    home = Path(autotune.__file__).parent
    rooms = [home / "diagnosis", home / "experiment_design", home / "pipeline"]
    files = [
        p for room in rooms for p in room.rglob("*.py") if p.name != "thresholds.py" and "__pycache__" not in p.parts
    ]
    text = "\n".join(p.read_text(encoding="utf-8") for p in files if p.name != "thresholds.py")
    for name, *_ in table(IN_USE):
        assert f".{name}" in text, f"{name} is read nowhere"


def test_a_table_passed_in_decides_and_the_one_in_use_stays() -> None:
    recordings = [servo_recording(seed, lambda x, v: -0.03 * v * abs(v)) for seed in (1, 2)]
    rest = [name for name in CATALOGUE if name not in ("plant.quadratic_drag", "actuator.rate_limit")]
    assert diagnose(servo_model(), recordings, without=rest).verdict == "effect"
    closed = replace(IN_USE, beyond_chance=-1.0, material=0.0)
    assert diagnose(servo_model(), recordings, without=rest, thresholds=closed).verdict == "unexplained"
    with pytest.raises(FrozenInstanceError):
        IN_USE.material = 1.0  # type: ignore[misc]
