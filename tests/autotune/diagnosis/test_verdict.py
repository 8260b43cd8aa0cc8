"""From evidence to a verdict: one table, in which what samples show switches no test off."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.evidence.adequacy import ResidualTests
from autotune.diagnosis.evidence.constancy import Variation
from autotune.diagnosis.thresholds import IN_USE
from autotune.diagnosis.verdict import TABLE, odds_of_unknown, verdict_of
from autotune.effects import CATALOGUE
from tests.autotune.diagnosis.servo_rigs import servo_model, servo_recording

FACTS = sorted(set().union(*(holds | lacks for holds, lacks, _ in TABLE)))


def test_every_set_of_facts_has_one_verdict_and_every_row_decides_some() -> None:
    rows = set()
    for count in range(len(FACTS) + 1):
        for facts in itertools.combinations(FACTS, count):
            known = set(facts)
            fits = [i for i, (holds, lacks, _) in enumerate(TABLE) if holds <= known and not lacks & known]
            rows.add(fits[0])
    assert rows == set(range(len(TABLE)))


@pytest.mark.parametrize("samples", [frozenset(), frozenset({"samples"})])
def test_what_samples_show_switches_no_test_off(samples: frozenset[str]) -> None:
    assert verdict_of(samples | {"more than noise", "follows", "constant"}) == "unexplained"
    assert verdict_of(samples | {"missing", "constant"}) == "unexplained"
    assert verdict_of(samples | {"adequate"}) == "unexplained"  # something varies in what is left
    assert verdict_of(samples | {"more than noise", "effects", "follows", "constant"}) == "effect"


def test_a_rigs_effects_are_not_named_where_what_varies_beside_them_explains_more() -> None:
    found = frozenset({"more than noise", "follows", "effects"})
    assert verdict_of(found) == "effect"
    assert verdict_of(found | {"varies more"}) == "unexplained"


@pytest.mark.parametrize(
    "known",
    [
        {"effects", "samples"},
        {"more than noise", "effects"},
        {"more than noise", "effects", "late stamps"},
        {"wrong numbers"},
    ],
)
def test_what_follows_nothing_of_the_recordings_names_nothing(known: set[str]) -> None:
    assert verdict_of(frozenset(known | {"constant"})) == "unexplained"


def residual_with(reduced_chi2: float, *, uneven: bool = False, varies: float = 5.0) -> ResidualTests:
    return ResidualTests(
        reduced_chi2=reduced_chi2, reduced_chi2_chance=0.01, slow=1.0, slow_chance=0.02,
        varies=Variation(gain=varies, places=("plant",), what="a load", period_s=math.inf), uneven=uneven,
    )  # fmt: skip


def test_the_variance_counts_unless_some_rows_are_noisier_than_others() -> None:
    assert residual_with(1.0).is_noise
    assert not residual_with(1.5).is_noise
    assert residual_with(1.5).is_missing
    assert residual_with(1.5, uneven=True).is_noise
    assert not residual_with(1.5, uneven=True, varies=100.0).is_noise


def test_the_unknown_weighs_the_more_the_nearer_the_residual_comes_to_the_bound() -> None:
    odds = [odds_of_unknown(residual_with(r), IN_USE) for r in (1.0, 1.05, 1.1, 1.3)]
    assert odds == sorted(odds)
    assert odds[0] == pytest.approx(IN_USE.unknown_odds)
    assert odds[-1] == 1.0


def test_repeated_readings_beside_an_unknown_force_are_told_and_the_force_stays_unexplained() -> None:
    """A spring on one side, and a sensor that drops out: both are said, none hides the other."""
    recordings = []
    for seed in (11, 12):
        r = servo_recording(seed, lambda x, v: -0.3 * max(x, 0.0) ** 2)
        y = r.y.copy()
        for first in (300, 520, 800):
            y[first : first + 8] = y[first - 1]
        recordings.append(replace(r, y=y))
    nothing_fits = [name for name in CATALOGUE if name != "actuator.rate_limit"]
    found = diagnose(servo_model(), recordings, without=nothing_fits)
    assert found.verdict == "unexplained"
    assert [e.name for e in found.effects] == ["sensor.dropout"]
    assert found.description is not None


def test_lone_readings_far_from_the_simulation_are_the_sensors() -> None:
    r = servo_recording(3)
    y = r.y.copy()
    y[np.array([150, 333, 512, 700, 811])] += 0.4
    found = diagnose(servo_model(), [replace(r, y=y)], without=[n for n in CATALOGUE if n != "actuator.rate_limit"])
    assert [e.name for e in found.effects] == ["sensor.outliers"]
    assert found.verdict == "effect"
