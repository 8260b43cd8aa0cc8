"""Probabilities of hypotheses, thinned data, and fits that begin where dry friction holds the plant."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.fitting.parameters import effect_with, parametrise
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.selection.prediction import extend
from autotune.diagnosis.selection.probability import probability_of, weighed
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording


@given(
    scores=st.dictionaries(st.sampled_from("abcdef"), st.floats(0.0, 200.0), min_size=1),
    odds=st.floats(0.001, 1.0),
)
def test_hypotheses_share_the_probability_and_less_evidence_never_weighs_more(
    scores: dict[str, float], odds: float
) -> None:
    ranked = weighed(scores, odds)
    named = {c.name: c.probability for c in ranked}
    assert sum(named.values()) == pytest.approx(1.0, abs=1e-3)
    # prior odds beside 1 of all hypotheses together, however many share that 1
    assert named["unknown"] == pytest.approx(odds / (1.0 + odds), rel=1e-3)
    known = sorted(set(named) - {"unknown"}, key=lambda name: scores[name])
    assert all(named[a] >= named[b] for a, b in itertools.pairwise(known))


def test_an_effect_has_the_probability_of_all_hypotheses_that_have_it_however_many_they_are() -> None:
    fifty = {f"sensor.absolute_value+{name}": 0.1 * k for k, name in enumerate(f"effect_{k}" for k in range(50))}
    ranked = weighed(fifty, 0.25)
    assert probability_of("sensor.absolute_value", ranked) == pytest.approx(0.8)


def test_thinned_data_keep_the_windows_where_a_limit_is_reached() -> None:
    rows, per = 4000, 100
    u = np.sin(np.arange(rows) * 0.1)
    u[2350] = 3.0
    recording = Recording(t=0.01 * np.arange(rows), u=u, y=u)
    starts = np.arange(0, rows, per, dtype=np.int64)
    data = Data(
        recordings=(recording,), good=(np.ones(rows, dtype=bool),), starts=(starts,), stops=(starts + per,),
        noise=Noise(sd=1.0),
    )  # fmt: skip
    few = data.thinned(800)
    assert 2300 in few.first_rows[0]
    assert few.rows < 0.4 * data.rows


def rubbing(level: float, seed: int, rows: int = 1200) -> Recording:
    """tau dv/dt = -v + gain (u - friction) under a P controller, friction stopping the mass exactly."""
    rng = np.random.default_rng(seed)
    dt, gain, tau = 0.02, 5.0, 0.25
    v = x = 0.0
    u, y = np.empty(rows), np.empty(rows)
    aim = np.repeat(rng.uniform(-2.0, 2.0, rows // 100 + 1), 100)[:rows]
    for k in range(rows):
        y[k] = x + 0.005 * rng.normal()
        u[k] = 0.9 * (aim[k] - y[k])
        for _ in range(20):
            h = dt / 20
            free = v + h * (gain * u[k] - v) / tau
            most = h * gain * level / tau
            v = free - np.clip(free, -most, most)
            x += h * v
    return Recording(t=dt * np.arange(rows), u=u, y=y)


def test_a_friction_three_times_too_large_comes_down_to_the_true_level() -> None:
    model = Model(
        name="servo",
        input=Port(unit="V"),
        output=Port(unit="rad"),
        blocks=(
            Block(name="mass", place="plant", dynamics=TransferFunction(num=(5.0,), den=(0.25, 1.0))),
            Block(name="position", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0))),
        ),
    )
    r = rubbing(0.2, seed=1)
    data, base = prepare(model, [r], [np.ones(len(r), dtype=bool)])
    p, theta, states = extend(base, effect_with("plant.coulomb_friction", (0.6,)), data)
    result = fit(p, data, theta, states, iterations=40)
    assert result.model.effects[0].parameters["level"].value == pytest.approx(0.2, rel=0.05)
    again = parametrise(model, result.model.effects, 1.0, 0.02)
    assert again.with_values(again.centre).effects == result.model.effects
