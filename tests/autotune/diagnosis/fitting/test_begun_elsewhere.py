"""Fits to other rows begin in the states that the simulation has there, not at rest."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis.agreement import parts_of
from autotune.diagnosis.evidence.stretches import rms
from autotune.diagnosis.fitting.data import as_white
from autotune.diagnosis.fitting.fit import fit, residual_at, start_states, states_in
from autotune.diagnosis.fitting.long_windows import cut
from autotune.diagnosis.fitting.parameters import effect_with, parametrise
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.thresholds import IN_USE
from autotune.effects import ALL
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording
from tests.autotune.diagnosis.thrown_pendulum import DAMPING, DT, FRICTION, GRAVITY, driven

#: Amplitude, period, phase, and the mark that the chain's stiffness is this amplitude over this period.
GRAVITY_OF_AN_ARM = (1.0, 2.0 * math.pi, 0.0, 1.0)


@pytest.fixture
def arm() -> Model:
    block = Block(
        name="arm", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, DAMPING, GRAVITY)), output="angle",
        unit="rad",
    )  # fmt: skip
    return Model(name="pendulum", input=Port(), output=Port(unit="rad"), blocks=(block,))


def all_rows(recording: Recording) -> list[np.ndarray]:
    return [np.isfinite(recording.y)]


def test_windows_that_begin_in_the_states_of_a_simulation_go_on_with_it(arm: Model) -> None:
    r = driven(9)
    long, short = (as_white(cut(arm, [r], all_rows(r), length, IN_USE), 1.0) for length in (30.0, 1.7))
    effects = [effect_with("plant.coulomb_friction", (FRICTION,))]
    result = fit(parametrise(arm, effects, 1.0, DT), long, iterations=3)
    assert len(short.starts[0]) > 10
    there = residual_at(result.parametrisation, short, result.theta, tuple(states_in(result, long, short)))
    assert there == pytest.approx(result.e, abs=1e-9)


def test_where_a_simulation_has_no_state_a_window_begins_at_rest(arm: Model) -> None:
    r = driven(9)
    long, short = (as_white(cut(arm, [r], all_rows(r), length, IN_USE), 1.0) for length in (10.0, 1.7))
    some = long.only([np.array([1])])
    result = fit(parametrise(arm, [], 1.0, DT), some, iterations=3)
    states = states_in(result, some, short)[0]
    outside = (short.first_rows[0] < some.first_rows[0][0]) | (short.first_rows[0] >= some.windows[0].stops[0])
    assert 0 < outside.sum() < outside.size
    assert np.array_equal(states[outside], start_states(result.sim, short)[0][outside])
    assert not np.any(states[~outside] == start_states(result.sim, short)[0][~outside])


@pytest.mark.parametrize("seed", [0, 3, 7])
def test_what_explains_all_rows_explains_a_part_of_them(arm: Model, seed: int) -> None:
    """Numbers that are right lead nowhere from start states that are not: friction holds those where they were."""
    r = driven(seed)
    every = [kind.name for kind in ALL]
    retuned = search_chain(arm, [r], all_rows(r), every).retuned
    right = [effect_with("plant.coulomb_friction", (FRICTION,)), effect_with("plant.sine_torque", GRAVITY_OF_AN_ARM)]
    best = fit(parametrise(arm, right, 1.0, DT), retuned.data)
    whole = replace(retuned, names=tuple(effect.name for effect in right), fit=best, short=best)
    for part in parts_of([r], 100):
        rows = all_rows(part[0])
        there = search_chain(arm, part, rows, every, known=[whole]).judged[1]
        numbers = there.data.kept[0] if there.data.whole is not None else slice(0, len(part[0]))
        here = [one[numbers] for one in whole.fit.residuals]
        # of fewer rows numbers move towards the nominal ones, as far as the residual of all rows is a unit
        assert rms(there.fit.residuals, there.data.good) < 2.0 * rms(here, there.data.good)
