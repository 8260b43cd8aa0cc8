"""How usual it is that a model lacks an effect: said in words, which the record of the effect gives by kind of rig."""

import itertools

import pytest

from autotune.effects import KINDS, kind_of
from autotune.effects.base import PRIOR_ODDS, EffectKind, lacking


def test_what_is_expected_is_as_likely_as_not_and_a_fifth_from_word_to_word() -> None:
    odds = list(PRIOR_ODDS.values())
    assert odds[0] == 1.0
    assert [b / a for a, b in itertools.pairwise(odds)] == pytest.approx([0.2, 0.2, 0.2])


def test_a_kind_of_rig_that_is_not_named_has_the_word_of_any_and_without_one_it_is_rare() -> None:
    one = EffectKind(name="plant.one", odds=lacking(expected="arm", usual="level valve", possible="any"))
    two = EffectKind(name="plant.two", odds=lacking(expected="arm"))
    assert [one.prior_odds(rig) for rig in ("arm", "valve", "shaft")] == [1.0, 0.2, 0.04]
    assert two.prior_odds("shaft") == PRIOR_ODDS["rare"]


@pytest.mark.parametrize("store", ["level", "thermal", "process"])
def test_every_store_that_is_said_to_lose_nothing_usually_loses_something(store: str) -> None:
    assert kind_of("plant.leak").prior_odds(store) >= PRIOR_ODDS["usual"]


def test_no_effect_is_ruled_out_in_any_rig() -> None:
    rigs = {rig for kind in KINDS.values() for rig in kind.odds}
    assert min(kind.prior_odds(rig) for kind in KINDS.values() for rig in rigs) == PRIOR_ODDS["rare"]
