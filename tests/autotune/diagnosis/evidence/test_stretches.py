"""Stretches that were left out: what they say of two models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.diagnosis.evidence.stretches import (
    STRETCHES,
    correlation_rows,
    cuttings_in,
    cuttings_of,
    held_out_squares,
    weights_of_rows,
)
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
    judged = np.sum(np.concatenate(cuttings_of(data)[0]) >= 0)
    assert held_out_squares(astray, data).sum(axis=1) == pytest.approx(judged * (10.0 * np.std(recording.y)) ** 2)


def test_slow_errors_count_as_few_rows_and_white_ones_as_many():
    rng = np.random.default_rng(1)
    recording, data, result = _fitted(rng.normal(0.0, 0.05, 2000))
    assert correlation_rows(result, data) < 2.0
    slow = 0.05 * np.sin(2.0 * np.pi * recording.t / 40.0)
    _, data, result = _fitted(slow)
    assert correlation_rows(result, data) > 20.0


def test_the_head_of_every_window_is_never_judged_and_all_stretches_are():
    _, data, _ = _fitted(np.zeros(2000))
    by_rows, by_speed = (np.concatenate(labels) for labels in cuttings_of(data))
    for labels in (by_rows, by_speed):
        assert np.all(labels[:8] == -1)
        assert set(labels[8:]) == set(range(8))
        assert np.all(np.diff(labels[8:]) >= 0)
    assert np.ptp(np.bincount(by_rows[8:])) <= 1


@given(size=st.floats(1e-6, 1e6), shift=st.floats(-1e3, 1e3))
def test_what_rows_tell_does_not_hang_on_units(size: float, shift: float):
    y = np.random.default_rng(0).normal(size=500).cumsum()
    assert weights_of_rows(size * (y + shift)) == pytest.approx(weights_of_rows(y), rel=1e-6)


def test_rows_tell_as_much_as_each_other_where_y_moves_evenly_or_is_noise():
    noise = np.random.default_rng(0).normal(size=8000)
    assert weights_of_rows(3.0 * np.arange(1000.0)) == pytest.approx(1.0)
    assert weights_of_rows(np.full(1000, 2.0)) == pytest.approx(1.0)
    assert weights_of_rows(noise).reshape(8, -1).mean(axis=1) == pytest.approx(1.0, abs=0.1)


def test_gaps_in_the_readings_tell_what_lies_around_them():
    y = np.cumsum(np.random.default_rng(0).normal(size=1000))
    gaps = np.where(np.arange(1000) % 7 == 3, np.nan, y)
    assert weights_of_rows(gaps).mean() == pytest.approx(1.0)
    assert weights_of_rows(np.full(100, np.nan)) == pytest.approx(1.0)


def test_a_step_response_in_a_long_record_has_more_than_one_witness():
    """A lag of a fifth of the plant's own shows in forty rows of two thousand, and the rest rests."""
    u = np.where(np.arange(2000) < 200, 0.0, 1.0)
    errors = np.random.default_rng(3).normal(0.0, 0.002, 2000)
    _, data, without = _fitted(errors, u=u, lag_s=0.4)
    by_rows, by_speed = (np.concatenate(labels) for labels in cuttings_of(data))
    assert np.unique(by_rows[200:250]).size == 1
    assert np.unique(by_speed[200:250]).size >= 3
    right = fit(parametrise(_lags(2.0, 0.4), [], 0.5, 0.1), data)
    said = np.log(held_out_squares(without, data) / held_out_squares(right, data))
    assert np.sum(said > 1.0, axis=1)[1] >= 3 > np.sum(said > 1.0, axis=1)[0]


def test_left_out_errors_of_the_true_model_are_its_noise():
    rng = np.random.default_rng(2)
    _, data, result = _fitted(rng.normal(0.0, 0.05, 2000))
    judged = np.sum(np.concatenate(cuttings_of(data)[0]) >= 0)
    assert np.sqrt(held_out_squares(result, data).sum(axis=1) / judged) == pytest.approx(0.05, rel=0.08)


def _fitted(errors, u=None, lag_s=0.0):
    """Return a first-order lag, behind a further one if asked, with errors on its reading, in one window, fitted."""
    n, dt, T = errors.size, 0.1, 2.0
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 40), 40) if u is None else u
    y, x, drive = np.zeros(n), 0.0, 0.0
    decay, lag = np.exp(-dt / T), np.exp(-dt / lag_s) if lag_s else 0.0
    for k in range(n):
        y[k] = x
        drive = lag * drive + (1.0 - lag) * u[k]
        x = decay * x + (1.0 - decay) * drive
    recording = Recording(t=dt * np.arange(n), u=u, y=y + errors)
    data = cut(_lags(T), [recording], [np.ones(n, dtype=bool)], recording.duration_s, IN_USE)
    return recording, data, fit(parametrise(_lags(T), [], 0.5, dt), data)


def _lags(*times_s):
    lags = (TransferFunction(num=(1.0,), den=(T, 1.0)) for T in times_s)
    blocks = tuple(Block(name=f"lag {k}", place="plant", dynamics=lag) for k, lag in enumerate(lags))
    return Model(name="lags", input=Port(), output=Port(), blocks=blocks)


@given(rows=st.lists(st.integers(600, 900), min_size=1, max_size=8), windows=st.lists(st.integers(0, 12), min_size=8))
def test_no_stretch_is_of_two_recordings(rows: list[int], windows: list[int]) -> None:
    """Whichever way rows are cut; a recording without a window has none."""
    readings = [np.random.default_rng(n).standard_normal(n).cumsum() for n in rows]
    edges = [np.linspace(0, n, many + 1).astype(np.int64) for n, many in zip(rows, windows, strict=False)]
    for labels in cuttings_in(readings, [e[:-1] for e in edges], [e[1:] for e in edges]):
        held = [set(label[label >= 0].tolist()) for label in labels]
        assert sum(map(len, held)) == len(set().union(*held))
        assert [bool(one) for one in held] == [many > 0 for _, many in zip(rows, windows, strict=False)]
        assert set().union(*held) == set(range(STRETCHES if any(held) else 0))
