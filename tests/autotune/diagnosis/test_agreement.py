"""What parts of the recordings say of an effect that the whole shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
import pytest

from autotune.diagnosis.agreement import LEFT_OUT, Begins, Part, Said, agreement, parts_of
from autotune.recording import Recording

DRY, DROPPING, STEP = "plant.coulomb_friction", "plant.stribeck_friction", "environment.step_load"


def recorded(rows: int) -> Recording:
    return Recording(t=0.1 * np.arange(rows), u=np.zeros(rows), y=np.arange(rows, dtype=float), name="r")


def said(probabilities: Mapping[str, float], *named: str) -> Said:
    return Said(probabilities=probabilities, named=frozenset(named))


def shares(whole: Said, parts: Sequence[Said], begins: Begins = MappingProxyType({})) -> Mapping[str, float]:
    answers = iter(parts)
    return agreement(whole, begins, parts_of((recorded(1000),), 100), lambda part: next(answers))


def test_each_part_leaves_a_fifth_of_every_recording_out_at_one_of_its_ends() -> None:
    first, last = parts_of((recorded(1000), recorded(500)), 100)
    assert [len(r) for r in first.recordings] == [len(r) for r in last.recordings] == [800, 400]
    assert first.recordings[0].y[0] == LEFT_OUT * 1000
    assert last.recordings[0].y[-1] == (1.0 - LEFT_OUT) * 1000 - 1
    assert parts_of((recorded(1000), recorded(120)), 100) == ()


def test_what_is_likelier_than_not_in_the_mean_is_named_and_what_one_says_alone_is_not() -> None:
    assert shares(said({DRY: 0.9}, DRY), [said({DRY: 0.9}), said({DRY: 0.9})]) == {DRY: pytest.approx(0.9)}
    assert shares(said({DRY: 0.9}, DRY), [said({}), said({})]) == {}
    changing = [said({DROPPING: 0.9, DRY: 0.1}, DROPPING), said({DRY: 0.8, DROPPING: 0.2}, DRY)]
    assert shares(said({DRY: 0.9, DROPPING: 0.1}, DRY), changing)[DRY] == pytest.approx(0.6)


def test_what_all_of_them_name_is_named_though_much_else_may_be_as_likely() -> None:
    one = said({DRY: 0.4}, DRY)
    assert shares(one, [one, one]) == {DRY: pytest.approx(0.4)}
    assert shares(one, [one, said({DRY: 0.45})]) == {}
    # dry friction that drops with speed is dry friction
    assert DRY in shares(one, [one, said({DROPPING: 0.4, DRY: 0.4}, DROPPING)])


def test_a_part_without_the_moment_at_which_an_effect_begins_is_not_asked() -> None:
    both = [said({}), said({STEP: 0.9}, STEP)]
    # 10 s lie within the first fifth
    assert shares(said({STEP: 0.9}, STEP), both, {STEP: [(0, 10.0)]}) == {STEP: pytest.approx(0.9)}
    assert shares(said({STEP: 0.9}, STEP), both, {STEP: [(0, 50.0)]}) == {STEP: pytest.approx(0.6)}
    assert Part(recordings=(recorded(1000),)).tells([])


def test_nothing_is_diagnosed_again_where_nothing_was_found() -> None:
    assert shares(said({}), []) == {}
