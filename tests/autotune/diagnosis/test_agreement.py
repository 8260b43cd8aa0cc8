"""What parts of the recordings say of an effect that the whole shows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import pytest

from autotune.diagnosis.agreement import LEFT_OUT, Begins, agreement, parts_of, tells
from autotune.diagnosis.thresholds import IN_USE
from autotune.recording import Recording

Said: TypeAlias = Mapping[str, float]
#: A cause outside the catalogue is always left.
SUREST = 1.0 / (1.0 + IN_USE.unknown_odds)
DRY, DROPPING, STEP = "plant.coulomb_friction", "plant.stribeck_friction", "environment.step_load"


def recorded(rows: int) -> Recording:
    return Recording(t=0.1 * np.arange(rows), u=np.zeros(rows), y=np.arange(rows, dtype=float), name="r")


def shares(whole: Said, parts: Sequence[Said], begins: Begins = MappingProxyType({})) -> Mapping[str, float]:
    answers = iter(parts)
    return agreement(whole, begins, parts_of((recorded(1000),), 100), lambda part: next(answers))


def test_each_part_leaves_a_fifth_of_every_recording_out_at_one_of_its_ends() -> None:
    first, last = parts_of((recorded(1000), recorded(500)), 100)
    assert [len(r) for r in first] == [len(r) for r in last] == [800, 400]
    assert first[0].y[0] == LEFT_OUT * 1000
    assert last[0].y[-1] == (1.0 - LEFT_OUT) * 1000 - 1
    assert parts_of((recorded(1000), recorded(120)), 100) == ()


def test_what_is_likelier_than_not_is_named_and_what_a_part_contradicts_is_not() -> None:
    assert shares({DRY: 0.9}, [{DRY: 0.9}, {DRY: 0.9}]) == {DRY: pytest.approx(SUREST)}
    assert shares({DRY: 0.9}, [{DRY: 0.4}, {DRY: 0.6}]) == {DRY: pytest.approx(1.5**2 / (1.0 + 1.5**2))}
    assert shares({DRY: 0.5}, [{DRY: 0.5}, {DRY: 0.5}]) == {DRY: pytest.approx(0.5)}
    assert shares({DRY: 0.8}, [{DRY: 0.8}, {DRY: 0.8}]) == {DRY: pytest.approx(16.0 / 17.0)}
    assert shares({DRY: 0.9}, [{DRY: math.nan}, {DRY: math.nan}]) == {DRY: pytest.approx(0.9)}
    assert shares({DRY: 0.97}, [{DRY: 0.97}, {}]) == {}
    assert shares({DRY: 0.4}, [{DRY: 0.45}, {DRY: 0.4}]) == {}
    assert shares({DRY: 0.9}, [{DRY: math.nan}, {DRY: 0.9}]) == {DRY: pytest.approx(SUREST)}  # one cannot tell


def test_a_part_without_the_moment_at_which_an_effect_begins_is_not_asked() -> None:
    both = [{}, {STEP: 0.9}]
    # 10 s lie within the first fifth
    assert shares({STEP: 0.9}, both, {STEP: [(0, 10.0)]}) == {STEP: pytest.approx(SUREST)}
    assert shares({STEP: 0.9}, both, {STEP: [(0, 50.0)]}) == {}
    assert tells((recorded(1000),), [])


def test_nothing_is_diagnosed_again_where_nothing_was_found() -> None:
    assert shares({}, []) == {}
