"""Marking a diagnosis and counting marks."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.score import calibration_error, confusion, mark, resolved, table, wilson

ANSWER = {
    "kind": "single",
    "strength": "strong",
    "rig": "servo",
    "verdict": "effect",
    "effects": [{"name": "sensor.lag", "accept": ["actuator.lag", "sensor.lag"], "parameters": {}}],
    "places": ["sensor", "actuator", "plant"],
    "nuisance": ["actuator.offset"],
    "improvable": True,
    "nrmse_unseen": {"nominal": 0.5, "retuned": 0.2, "truth": 0.101, "noise": 0.1},
}
CLEAN = {**ANSWER, "kind": "clean", "verdict": "none", "effects": [], "places": [], "strength": None, "nuisance": []}
OUTSIDE = {**ANSWER, "kind": "outside", "verdict": "unexplained", "places": ["sensor"]}
OUTSIDE["effects"] = [{"name": "x.echo", "accept": [], "parameters": {}}]
OUTSIDE["improvable"] = False


def said(verdict, *names, places=(), p=0.9):
    effects = [{"name": n, "probability": p, "places": [n.split(".")[0]]} for n in names]
    return {"verdict": verdict, "effects": effects, "places": list(places)}


def test_an_equivalent_name_counts_and_a_nuisance_before_it_does_not():
    m = mark("c", ANSWER, said("effect", "actuator.offset", "actuator.lag"), 0.105)
    assert m.first_right
    assert m.place_right
    assert m.named == ("actuator.lag",)
    assert m.gap == pytest.approx(0.95)
    assert not m.failed


def test_a_wrong_name_after_the_right_one_is_a_wrong_statement():
    m = mark("c", ANSWER, said("effect", "sensor.lag", "sensor.drift"), 0.12)
    assert m.right == (True, False)
    assert m.found == 1


def test_an_effect_on_a_clean_recording_is_a_false_alarm_and_parameters_are_not():
    alarm = mark("a", CLEAN, said("effect", "sensor.drift"), None)
    modest = mark("b", CLEAN, said("parameters"), None)
    rows = {row.figure: row for row in table([alarm, modest])}
    row = rows["false alarm on clean and parameter-only"]
    assert (row.value, row.count, row.met) == (0.5, 2, False)


def test_outside_the_catalogue_the_place_still_counts():
    m = mark("c", OUTSIDE, said("unexplained", places=["sensor"]), None)
    assert m.verdict_right
    assert m.place_right
    assert m.gap is None
    assert mark("c", OUTSIDE, said("effect", "sensor.lag"), None).right == (False,)


def test_an_effect_left_out_of_the_catalogue_is_withdrawn_where_nothing_or_its_equivalent_is_named():
    said_instead = [said("unexplained"), said("effect", "actuator.lag"), said("effect", "sensor.drift"), said("none")]
    assert [mark("c", ANSWER, one, 0.2).withdrawn for one in said_instead] == [True, True, False, False]


def test_ties_are_a_row_of_the_table():
    row = resolved([True] * 9 + [False])
    assert (row.value, row.count, row.met) == (0.9, 10, True)
    assert row.interval == pytest.approx(wilson(9, 10))


def test_an_extended_model_worse_than_the_retuned_one_is_told():
    assert mark("c", ANSWER, said("effect", "sensor.lag"), 0.3).worse_than_retuned


def test_a_double_is_both_named_only_when_two_different_effects_are():
    double = {**ANSWER, "kind": "double", "strength": None}
    double["effects"] = [*ANSWER["effects"], {"name": "plant.leak", "accept": ["plant.leak"], "parameters": {}}]
    assert mark("c", double, said("effect", "sensor.lag", "actuator.lag"), 0.2).found == 1
    assert mark("c", double, said("effect", "sensor.lag", "plant.leak"), 0.2).found == 2


@given(st.integers(1, 400), st.data())
def test_the_interval_of_a_share_holds_the_share_and_stays_within_0_and_1(count, data):
    successes = data.draw(st.integers(0, count))
    low, high = wilson(successes, count)
    assert 0.0 <= low <= successes / count + 1e-12
    assert successes / count - 1e-12 <= high <= 1.0


def test_wilsons_interval_covers_a_share_of_nine_in_ten():
    hits = np.random.default_rng(0).binomial(150, 0.9, 4000)
    inside = [low <= 0.9 <= high for low, high in (wilson(int(h), 150) for h in hits)]
    assert 0.93 < np.mean(inside) < 0.97


def test_wilsons_interval_agrees_with_the_published_example():
    # Newcombe 1998, Statistics in Medicine 17, table I: 81 of 263 gives 0.2553 to 0.3662
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)


def test_stated_probabilities_that_come_true_as_often_have_a_small_calibration_error():
    rng = np.random.default_rng(1)
    p = rng.uniform(0.3, 1.0, 4000)
    honest = calibration_error([(float(q), bool(rng.random() < q)) for q in p])
    boastful = calibration_error([(0.99, bool(rng.random() < 0.6)) for _ in p])
    assert honest < 0.03
    assert boastful > 0.35
    assert math.isnan(calibration_error([]))


def test_the_confusion_rows_say_what_was_said_instead():
    marks = [mark(str(i), ANSWER, said("effect", name), 0.2) for i, name in enumerate(("sensor.lag", "plant.leak"))]
    assert confusion(marks) == [("sensor.lag", 2, 1, [("plant.leak", 1)])]
