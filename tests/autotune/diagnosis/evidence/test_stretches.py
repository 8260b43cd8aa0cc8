"""Stretches that were left out: what they say of two models."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from autotune.diagnosis.evidence.stretches import correlation_rows, held_out_squares, reduction, stretches_of
from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.long_windows import cut
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.thresholds import IN_USE
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

SQUARES = st.lists(st.floats(0.01, 100.0), min_size=8, max_size=8).map(np.array)


@given(SQUARES, SQUARES)
def test_what_speaks_for_one_model_speaks_as_much_against_the_other(a, b):
    assert reduction(a, b) == pytest.approx(-reduction(b, a))


@given(SQUARES, st.floats(1e-3, 1e3))
@example(np.array([18.0, 36.0, 36.0, 72.0, 0.5, 0.25, 0.25, 0.125]), 61.0)  # logarithms whose mean is 0
def test_the_unit_of_the_reading_does_not_matter(a, unit):
    b = a[::-1] * 0.7
    assert reduction(a * unit, b * unit) == pytest.approx(reduction(a, b), rel=1e-9, abs=1e-9)


def test_an_error_that_is_smaller_everywhere_is_told_by_its_size():
    assert reduction(np.ones(8), np.full(8, 0.49)) == pytest.approx(-np.log(0.49))


def test_a_model_that_is_better_on_one_stretch_alone_gains_what_that_is_of_all():
    once = np.array([0.01, *np.ones(7)])
    assert 0.0 < reduction(np.ones(8), once) < 0.15


def test_a_run_away_on_one_stretch_counts_no_more_than_far_off():
    base = np.ones(8)
    far, farther = base.copy(), base.copy()
    far[3], farther[3] = 1e6, np.inf
    assert reduction(far, base) == pytest.approx(reduction(farther, base))


def test_slow_errors_count_as_few_rows_and_white_ones_as_many():
    rng = np.random.default_rng(1)
    recording, data, result = _fitted(rng.normal(0.0, 0.05, 2000))
    assert correlation_rows(result, data) < 2.0
    slow = 0.05 * np.sin(2.0 * np.pi * recording.t / 40.0)
    _, data, result = _fitted(slow)
    assert correlation_rows(result, data) > 20.0


def test_the_head_of_every_window_is_never_judged_and_all_stretches_are():
    _, data, _ = _fitted(np.zeros(2000))
    labels = np.concatenate(stretches_of(data))
    assert np.all(labels[: len(labels) // 10] == -1)
    assert set(labels) == {-1, *range(8)}


def test_left_out_errors_of_the_true_model_are_its_noise():
    rng = np.random.default_rng(2)
    _, data, result = _fitted(rng.normal(0.0, 0.05, 2000))
    labels = np.concatenate(stretches_of(data))
    squares = held_out_squares(result, data)
    assert np.sqrt(squares.sum() / np.sum(labels >= 0)) == pytest.approx(0.05, rel=0.08)


def _fitted(errors):
    """Return a first-order lag with errors on its reading, in one long window, fitted."""
    n, dt, T = errors.size, 0.1, 2.0
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 40), 40)
    y, x, decay = np.zeros(n), 0.0, np.exp(-dt / T)
    for k in range(n):
        y[k] = x
        x = decay * x + (1.0 - decay) * u[k]
    recording = Recording(t=dt * np.arange(n), u=u, y=y + errors)
    block = Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.0,), den=(T, 1.0)))
    model = Model(name="lag", input=Port(), output=Port(), blocks=(block,))
    data = cut([recording], [np.ones(n, dtype=bool)], recording.duration_s, IN_USE)
    return recording, data, fit(parametrise(model, [], 0.5, dt), data)
