"""What parts of the recordings say of an effect that the whole shows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import pytest

from autotune.diagnosis.agreement import LEFT_OUT, Begins, agreement, parts_of, tells
from autotune.diagnosis.evidence.stretches import rms
from autotune.diagnosis.fitting.data import as_white
from autotune.diagnosis.fitting.fit import fit, fit_from, states_in
from autotune.diagnosis.fitting.long_windows import cut, within
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.thresholds import IN_USE
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording

Said: TypeAlias = Mapping[str, float]
#: A cause outside the catalogue is always left.
SUREST = 1.0 / (1.0 + IN_USE.unknown_odds)
DRY, DROPPING, STEP = "plant.coulomb_friction", "plant.stribeck_friction", "environment.step_load"


def recorded(rows: int) -> Recording:
    return Recording(t=0.1 * np.arange(rows), u=np.zeros(rows), y=np.arange(rows, dtype=float), name="r")


def shares(whole: Said, parts: Sequence[Said], begins: Begins = MappingProxyType({})) -> Mapping[str, float]:
    return agreement(whole, begins, parts_of((recorded(1000),), 100), parts)


def test_each_part_leaves_a_fifth_of_every_recording_out_at_one_of_its_ends() -> None:
    first, last = parts_of((recorded(1000), recorded(500)), 100)
    assert [int(np.isfinite(r.y).sum()) for r in first] == [len(r) for r in last] == [800, 400]
    assert first[0].y[first[0].first_reading] == LEFT_OUT * 1000
    assert last[0].y[-1] == (1.0 - LEFT_OUT) * 1000 - 1
    assert parts_of((recorded(1000), recorded(120)), 100) == ()


def test_what_was_commanded_before_a_part_begins_acts_in_it() -> None:
    """A play holds where it was pulled to and a dead time what was sent: true numbers leave noise in every part."""
    rng, rows, sd, width, delay = np.random.default_rng(5), 600, 0.01, 1.0, 25
    u = np.cumsum(0.15 * rng.normal(size=rows) * (np.arange(rows) > 50))
    held, y, state = np.zeros(rows), np.zeros(rows), 0.0
    for k in range(1, rows):
        held[k] = min(max(held[k - 1], u[k] - width / 2.0), u[k] + width / 2.0)
        state += (1.0 - math.exp(-0.1)) * (held[max(k - 1 - delay, 0)] - state)
        y[k] = state
    recording = Recording(t=np.arange(float(rows)), u=u, y=y + sd * rng.normal(size=rows))
    dynamics = TransferFunction(num=(1.0,), den=(10.0, 1.0), delay_s=float(delay))
    model = Model(name="loop", input=Port(), output=Port(), blocks=(Block(name="p", place="plant", dynamics=dynamics),))
    play = Effect(name="actuator.backlash", parameters={"width": Parameter(value=width)})
    p = parametrise(model, [play], float(np.std(u)), 1.0, IN_USE.prior_spread)
    for part in parts_of((recording,), 100):
        data = cut(model, part, [np.isfinite(r.y) for r in part], 600.0, IN_USE)
        there = fit_from(p, as_white(data, sd), p.centre, iterations=0, rounds=2)
        assert rms(there.residuals, data.good) < 1.1 * sd


@pytest.mark.parametrize("thinned", [False, True])
def test_a_part_is_judged_in_the_windows_of_all_rows_from_the_states_that_these_have(thinned: bool) -> None:
    rng, rows = np.random.default_rng(3), 2000
    u, y = rng.normal(size=rows).cumsum() * 0.1, np.empty(rows)
    state = 0.0
    for k in range(rows):
        y[k] = state + 0.01 * rng.normal()
        state += 0.1 * (u[k] - state)
    recording = Recording(t=0.1 * np.arange(rows), u=u, y=y)
    block = Block(name="p", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 1.0)))
    model = Model(name="m", input=Port(), output=Port(), blocks=(block,))
    every = cut(model, (recording,), [np.ones(rows, dtype=bool)], 11.0, IN_USE)
    known = every.only([np.arange(every.starts[0].size) % 3 > 0]) if thinned else every
    all_rows = fit(parametrise(model, [], float(np.std(u)), 0.1, IN_USE.prior_spread), known)
    told = np.full(rows, np.nan)
    told[known.kept[0] if thinned else slice(None)] = np.where(known.good[0], all_rows.residuals[0], np.nan)
    for part in parts_of((recording,), 100):
        there = within(known, part, [np.isfinite(r.y) for r in part])
        begun, none = states_in(all_rows, known, there), np.zeros(all_rows.theta.size, dtype=bool)
        begins = fit(all_rows.parametrisation, there, all_rows.theta, begun, free=none, iterations=0)
        numbers = there.kept[0] if there.whole is not None else np.arange(len(part[0]))
        inside = there.good[0]
        assert inside.sum() > 0.7 * known.rows
        np.testing.assert_allclose(begins.residuals[0][inside], told[numbers[inside]], rtol=0.0, atol=1e-9)


def test_what_is_likelier_than_not_is_named_and_what_a_part_contradicts_is_not() -> None:
    assert shares({DRY: 0.9}, [{DRY: 0.9}, {DRY: 0.9}]) == {DRY: pytest.approx(SUREST)}
    assert shares({DRY: 0.9}, [{DRY: 0.4}, {DRY: 0.6}]) == {DRY: pytest.approx(1.5**2 / (1.0 + 1.5**2))}
    assert shares({DRY: 0.5}, [{DRY: 0.5}, {DRY: 0.5}]) == {DRY: pytest.approx(0.5)}
    assert shares({DRY: 0.8}, [{DRY: 0.8}, {DRY: 0.8}]) == {DRY: pytest.approx(16.0 / 17.0)}
    assert shares({DRY: 0.9}, [{DRY: math.nan}, {DRY: math.nan}]) == {DRY: pytest.approx(0.9)}
    assert shares({DRY: 0.97}, [{DRY: 0.97}, {}]) == {}
    assert shares({DRY: 0.4}, [{DRY: 0.45}, {DRY: 0.4}]) == {}
    assert shares({DRY: 0.9}, [{DRY: math.nan}, {DRY: 0.9}]) == {DRY: pytest.approx(0.9)}  # one cannot tell


def test_a_part_without_the_moment_at_which_an_effect_begins_is_not_asked() -> None:
    both = [{}, {STEP: 0.9}]
    # 10 s lie within the first fifth
    assert shares({STEP: 0.9}, both, {STEP: [(0, 10.0)]}) == {STEP: pytest.approx(0.9)}
    assert shares({STEP: 0.9}, both, {STEP: [(0, 50.0)]}) == {}
    assert tells((recorded(1000),), [])


def test_nothing_is_diagnosed_again_where_nothing_was_found() -> None:
    assert shares({}, []) == {}
