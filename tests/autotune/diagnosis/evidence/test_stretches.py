"""Stretches that were left out: what they say of two models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis.evidence.stretches import correlation_rows, held_out_squares, stretches_of
from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.long_windows import cut
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.thresholds import IN_USE
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording


def test_where_a_simulation_runs_away_every_row_counts_as_ten_spreads():
    recording, data, result = _fitted(np.zeros(2000))
    gain = [f.kind == "gain" for f in result.parametrisation.free]
    stuck = np.zeros_like(result.jacobian[0])
    astray = replace(result, theta=result.theta + 20.0 * np.array(gain), jacobian=(stuck, *result.jacobian[1:]))
    judged = np.sum(np.concatenate(stretches_of(data)) >= 0)
    assert held_out_squares(astray, data).sum() == pytest.approx(judged * (10.0 * np.std(recording.y)) ** 2)


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
