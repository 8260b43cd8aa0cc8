"""Windows: how a recording is cut, how windows are joined, and what only free start states made possible."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.descent import freed_of
from autotune.diagnosis.fitting.windows import window_rows
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.thresholds import IN_USE
from autotune.effects import ALL
from autotune.recording import Recording
from tests.autotune.diagnosis.servo_rigs import GAIN, servo_model, servo_recording


@pytest.mark.parametrize("length_s", [0.5, 3.0, 40.0, 1e4])
def test_windows_cut_a_recording_without_gap_into_enough_parts(length_s: float) -> None:
    rows = 2000
    recording = Recording(t=0.02 * np.arange(rows), u=np.zeros(rows), y=np.zeros(rows))
    starts, stops = window_rows(recording, length_s, 0.4)
    assert starts[0] == 20
    assert stops[-1] == rows
    np.testing.assert_array_equal(stops[:-1], starts[1:])
    assert len(starts) >= IN_USE.least_windows
    assert np.min(stops - starts) >= IN_USE.least_window_rows - 1


def test_a_spring_that_short_windows_forgive_is_found_on_longer_ones() -> None:
    r = [servo_recording(seed, lambda x, v: -0.00032 * x, rows=3000) for seed in (1, 2)]
    few = ("plant.leak", "sensor.lag", "plant.quadratic_drag", "environment.step_load")
    found = search_chain(servo_model(), r, inspect(r)[0], [k.name for k in ALL if k.name not in few])
    assert found.chosen.names == ("plant.leak",)
    p, covariance = found.chosen.fit.parametrisation, found.chosen.fit.covariance
    (i,) = (k for k, f in enumerate(p.free) if f.kind == "effect")
    rate, sd = found.chosen.fit.model.effects[0].parameters["rate"].value, float(np.sqrt(covariance[i, i]))
    assert sd * p.free[i].size < 0.3 * 0.00032 * GAIN
    assert rate == pytest.approx(0.00032 * GAIN, abs=2.0 * sd * p.free[i].size)


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(4, 30), min_size=1, max_size=6), st.integers(0, 3))
def test_what_is_freed_of_start_states_is_orthogonal_to_what_they_explain_in_every_window(
    seed: int, lengths: list[int], states: int
) -> None:
    random = np.random.default_rng(seed)
    edges = np.cumsum([2, *(n + 1 for n in lengths)])  # a row between windows belongs to none
    windows = np.column_stack([edges[:-1], edges[:-1] + lengths])
    direction, Q = random.normal(size=int(edges[-1])), np.zeros((int(edges[-1]), states))
    for number, (a, b) in enumerate(windows):
        felt = states if number % 2 == 0 else states // 2  # some windows feel fewer of their states
        Q[a:b, :felt] = np.linalg.qr(random.normal(size=(b - a, felt)))[0]
    left = freed_of(direction, Q, windows)
    inside = np.zeros(direction.size, dtype=bool)
    for a, b in windows:
        inside[a:b] = True
        assert np.abs(Q[a:b].T @ left[a:b]).max(initial=0.0) < 1e-12
        assert left[a:b] == pytest.approx(direction[a:b] - Q[a:b] @ (Q[a:b].T @ direction[a:b]))
    assert np.array_equal(left[~inside], direction[~inside])
