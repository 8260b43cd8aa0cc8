"""How hypotheses are compared that stretches have judged, and which one is taken for all that is likely."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.diagnosis.evidence.stretches import STRETCHES
from autotune.diagnosis.selection.judged import built_on, errors_of, of_likely, predicts_best, probabilities, rank
from autotune.diagnosis.selection.probability import probability_of, share_of
from autotune.diagnosis.thresholds import IN_USE
from tests.autotune.diagnosis.selection.on_stretches import Astray

LAG, READING_LAG, DEAD = "actuator.lag", "sensor.lag", "timing.dead_time"
GRAVITY, DRY, CURVED, DROPPING = (
    "plant.sine_torque", "plant.coulomb_friction", "actuator.nonlinear_gain", "plant.stribeck_friction",
)  # fmt: skip
#: Errors on eight stretches, about 1.
ERRORS = np.array([0.9, 1.1, 1.0, 0.95, 1.05, 1.02, 0.98, 1.0])
SIZES = st.floats(0.4, 3.5)
SQUARES = st.lists(st.floats(0.01, 100.0), min_size=8, max_size=8)


def hypothesis_of(names: tuple[str, ...], size: float, log_odds: float = 0.0, short: float | None = None) -> Astray:
    near = size if short is None else short
    return Astray(
        names=names, long_squares=np.square(size * ERRORS), short_squares=np.square(near * ERRORS), log_odds=log_odds
    )


@given(SIZES, SIZES, SIZES, SIZES)
def test_stretches_count_as_rows_do(a: float, b: float, c: float, d: float) -> None:
    """K stretches say K ln(S1/S2), cooled; two scales count as their mean, and both ways alike."""
    one, other = hypothesis_of((), a, short=c), hypothesis_of((DRY,), b, short=d)
    expected = STRETCHES * (math.log(a / b) + math.log(c / d)) / IN_USE.temperature
    assert one.behind(other) == pytest.approx(expected, abs=1e-9)
    assert other.behind(one) == pytest.approx(-expected, abs=1e-9)


@given(st.lists(st.tuples(SQUARES, st.floats(-5.0, 5.0)), min_size=3, max_size=3), st.floats(1e-3, 1e3))
def test_what_beats_one_that_beats_another_beats_that_in_any_unit(
    three: list[tuple[list[float], float]], unit: float
) -> None:
    """Each stretch has a size of error of its own: what they say adds up, whatever y is measured in."""

    def each(scale: float) -> list[Astray]:
        known = ((scale**2 * np.array(squares), odds) for squares, odds in three)
        return [Astray(names=(), long_squares=s, short_squares=s, log_odds=odds) for s, odds in known]

    first, second, third = each(1.0)
    assert first.behind(second) + second.behind(third) == pytest.approx(first.behind(third), abs=1e-9)
    scaled = each(unit)
    assert scaled[0].behind(scaled[1]) == pytest.approx(first.behind(second), rel=1e-9, abs=1e-9)


class Quiet(Astray):
    """A hypothesis that leaves noise."""

    leaves_noise = True


@given(SIZES, SIZES, st.floats(0.1, 10.0), st.floats(0.1, 10.0), st.integers(100, 10_000))
def test_rows_that_were_fitted_speak_for_what_leaves_noise_as_far_as_left_out_rows_do(
    quiet_error: float, loud_error: float, quiet_variance: float, loud_variance: float, rows: int
) -> None:
    """In windows of some rows, start states that are free make noise of what a wrong effect leaves."""
    quiet = Quiet(names=(DRY,), log_odds=0.0, long_squares=(quiet_error * ERRORS) ** 2, short_squares=np.ones(8))
    loud = Astray(names=(), log_odds=0.0, long_squares=(loud_error * ERRORS) ** 2, short_squares=np.ones(8))
    for one, variance in ((quiet, quiet_variance), (loud, loud_variance)):
        one.__dict__.update(variance=variance, rows=rows)
    said = loud.behind(quiet)
    assert said == pytest.approx(-quiet.behind(loud), abs=1e-9)
    if quiet_error >= loud_error:
        assert said <= 0.0
    else:
        per_row = min(math.log(loud_variance / quiet_variance), math.log(loud_error / quiet_error))
        stretches = STRETCHES * math.log(loud_error / quiet_error) / IN_USE.temperature
        assert said == pytest.approx(max(rows * per_row / IN_USE.temperature, stretches), abs=1e-6)


def test_what_is_rare_needs_more_evidence_than_what_is_usual() -> None:
    rare = hypothesis_of((CURVED,), 0.66, math.log(0.01))
    usual = hypothesis_of((DRY,), 0.7, math.log(0.5))
    assert rank([hypothesis_of((), 1.0), rare, usual])[0] is usual


def test_what_is_likely_is_taken_together_where_that_was_fitted() -> None:
    """Friction is in every good hypothesis, what bends beside it is another thing in each: friction alone is taken."""
    plain, alone = hypothesis_of((), 3.0), hypothesis_of((DRY,), 1.0)
    others = [hypothesis_of((DRY, name), 0.97) for name in (CURVED, GRAVITY)]
    found = [plain, alone, *others]
    assert rank(found)[0] in others
    candidates = probabilities(found, rank(found)[0], 0.03)
    said = {name: probability_of(name, candidates) for name in (DRY, CURVED, GRAVITY)}
    assert said[DRY] > 0.9 > 0.5 > max(said[CURVED], said[GRAVITY])
    assert of_likely(found, {DRY}) is alone
    assert of_likely(found, {DRY, GRAVITY}) is others[1]
    assert of_likely(found, {DROPPING}) is plain


def test_of_two_that_command_and_reading_cannot_tell_apart_one_is_taken() -> None:
    """A lag before the plant and one behind it: both are likely, and both at once are no better than one."""
    plain, before, behind = hypothesis_of((), 3.0), hypothesis_of((LAG,), 1.0), hypothesis_of((READING_LAG,), 1.01)
    both = hypothesis_of((LAG, READING_LAG), 1.0, math.log(0.05))
    assert of_likely([plain, before, behind, both], {LAG, READING_LAG}) is before


def test_that_y_comes_later_is_likely_though_neither_lag_nor_dead_time_is() -> None:
    """To first order in its length a lag is a dead time: where both predict about as well they count together."""
    plain, lag, dead = hypothesis_of((), 1.0), hypothesis_of((LAG,), 0.8), hypothesis_of((DEAD,), 0.81)
    bend = hypothesis_of((CURVED,), 0.95)
    found = [plain, bend, lag, dead]
    candidates = probabilities(found, lag, 0.03)
    alone = {c.name: c.probability for c in candidates}
    assert max(alone[LAG], alone[DEAD]) < 0.5 < probability_of(DEAD, candidates)
    assert (
        probability_of(LAG, candidates) == probability_of(DEAD, candidates) == pytest.approx(alone[LAG] + alone[DEAD])
    )
    assert of_likely(found, {LAG, DEAD}) is lag
    assert share_of(LAG, candidates) + share_of(DEAD, candidates) == pytest.approx(1.0)
    assert share_of(LAG, candidates) * probability_of(LAG, candidates) == pytest.approx(alone[LAG])
    assert share_of(CURVED, candidates) == 1.0


def test_shares_of_a_lag_and_a_dead_time_that_are_both_there_add_up_to_more_than_they_have_together() -> None:
    both = hypothesis_of((LAG, DEAD), 0.3)
    candidates = probabilities([hypothesis_of((), 1.0), hypothesis_of((LAG,), 0.9), both], both, 0.03)
    assert share_of(LAG, candidates) + share_of(DEAD, candidates) > 1.5
    assert probability_of(LAG, candidates) == probability_of(DEAD, candidates) < 1.0


def test_what_predicts_best_is_built_on_though_it_is_too_rare_to_lead() -> None:
    usual = [hypothesis_of((name,), size) for name, size in ((DRY, 0.8), (CURVED, 0.85), (LAG, 0.9))]
    rare = hypothesis_of((GRAVITY,), 0.7, math.log(1e-4))
    order = rank([*usual, rare])
    assert order[0] is usual[0]
    assert order.index(rare) > 1
    assert built_on(order, 2) == [*order[:2], rare]
    assert built_on([rare, *usual], 2) == [rare, usual[0]]
    assert built_on([], 2) == []


def test_two_kinds_of_dry_friction_leave_a_place_for_gravity() -> None:
    falling = "plant.stribeck_friction"
    order = [hypothesis_of((name,), size) for name, size in ((DRY, 0.5), (falling, 0.6), (GRAVITY, 0.7), (LAG, 0.8))]
    assert built_on(order, 2) == [order[0], order[2]]
    assert built_on([*order[1:], order[0]], 2) == [order[1], order[2], order[0]]  # what predicts best goes on as well


def test_what_predicts_is_simulated_with_though_it_is_too_rare_to_be_named() -> None:
    """It leaves a tenth less of all rows and of each part; no load of one recording does."""
    friction, bent = hypothesis_of((DRY,), 1.0), hypothesis_of((DRY, CURVED), 0.85, math.log(1e-4))
    load = hypothesis_of((DRY, "environment.periodic_load"), 0.5)
    found = [hypothesis_of((), 3.0), friction, bent, load, hypothesis_of((GRAVITY,), 0.4)]

    def on_part(size: float) -> dict[frozenset[object], float]:
        return errors_of([hypothesis_of((DRY,), 1.0), hypothesis_of((DRY, CURVED), size), load])

    assert predicts_best(friction, found, [on_part(0.88), on_part(0.6)]) is bent
    assert predicts_best(friction, found, [on_part(0.6), on_part(0.92)]) is friction  # too little on one part
    assert predicts_best(friction, found, [on_part(0.6), {}]) is friction  # one part tells nothing
    assert predicts_best(friction, found, []) is friction
