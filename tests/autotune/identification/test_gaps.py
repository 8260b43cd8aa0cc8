"""Short gaps of a record are bridged: what lies between them is used together, as if all of it were there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.arrays import FloatArray
from autotune.identification.closed_loop.confidence import response_covariance
from autotune.identification.closed_loop.gaps import LONGEST, bridge_gaps, usable_stretch, usable_stretches
from autotune.identification.closed_loop.identify import identify_closed_loop
from autotune.identification.closed_loop.order import choose_order, fit_order
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.recording import Recording
from tests.autotune.identification.test_closed_loop import DT, ball_loop
from tests.loop_example import inside_region

GAPS = 30


def with_gaps(recording: Recording, *, late: bool, longest: int = LONGEST, seed: int = 5) -> Recording:
    """Lose up to three samples in a row here and there; the last of them may come late instead, off the grid."""
    rng = np.random.default_rng(seed)
    t, kept = recording.t.copy(), np.ones(len(recording), dtype=bool)
    for start in rng.choice(np.arange(50, len(recording) - 50, 20), GAPS, replace=False):
        count = int(rng.integers(1, longest + 1))
        kept[start : start + count] = False
        if late:
            kept[start + count - 1] = True
            t[start + count - 1] += 0.4 * DT
    extra = {name: values[kept] for name, values in recording.extra.items()}
    return Recording(t=t[kept], u=recording.u[kept], y=recording.y[kept], extra=extra)


@pytest.mark.parametrize("late", [False, True], ids=["lost", "come late"])
def test_a_record_with_gaps_gives_the_plant_that_the_whole_record_gives(late: bool) -> None:
    whole = ball_loop()
    gappy = with_gaps(whole, late=late)
    stretch, warnings = usable_stretch(gappy)
    assert len(stretch) == len(whole)  # one piece of 100 rows before
    assert any(f"{GAPS} gap(s)" in warning for warning in warnings)
    found, known = identify_closed_loop(gappy, order=2), identify_closed_loop(whole, order=2)
    for one, other in zip(found.points, known.points, strict=True):
        if 0.5 < one.omega_rad_s < 6.0:
            assert abs(one.response / other.response - 1.0) < 0.02


def test_the_command_over_a_gap_is_what_was_held() -> None:
    t = np.array([0.0, 1.0, 2.0, 5.0, 6.0, 7.0])
    u = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    found = bridge_gaps(Recording(t=t, u=u, y=10.0 * t), 0.25)
    assert found.gaps == 0  # two of six rows: what is put in would speak for the plant
    rows = np.arange(60.0)
    sparse = np.delete(rows, [20, 21])
    found = bridge_gaps(Recording(t=sparse, u=sparse, y=10.0 * sparse), 0.25)
    assert (found.gaps, found.rows) == (1, 2)
    assert found.recording.t == pytest.approx(rows)
    assert found.recording.u[18:24] == pytest.approx([18.0, 19.0, 19.0, 19.0, 22.0, 23.0])
    assert found.recording.y == pytest.approx(10.0 * rows)


def test_a_sample_that_came_late_counts_by_the_time_its_command_acted() -> None:
    rows = np.arange(60.0)
    late = rows.copy()
    late[20] += 0.4
    found = bridge_gaps(Recording(t=late, u=rows, y=10.0 * rows), 0.25)
    assert (found.gaps, found.rows) == (1, 1)
    assert found.recording.u[19:22] == pytest.approx([19.0, 0.4 * 19.0 + 0.6 * 20.0, 21.0])


def test_a_long_gap_still_cuts_the_record() -> None:
    t = np.arange(200.0) + np.where(np.arange(200) > 120, 20.0, 0.0)
    recording = Recording(t=t, u=np.sin(t), y=np.cos(t))
    assert bridge_gaps(recording, 0.25).recording is recording
    assert len(usable_stretch(recording)[0]) == 121


def with_holes(recording: Recording, *, count: int, rows: int, nan: bool, seed: int = 7) -> Recording:
    """Lose as many stretches of rows, or their measurements."""
    rng = np.random.default_rng(seed)
    gone = np.zeros(len(recording), dtype=bool)
    for start in rng.choice(np.arange(60, len(recording) - 60, 2 * rows), count, replace=False):
        gone[start : start + rows] = True
    if nan:
        return replace(recording, y=np.where(gone, np.nan, recording.y))
    extra = {name: values[~gone] for name, values in recording.extra.items()}
    return Recording(t=recording.t[~gone], u=recording.u[~gone], y=recording.y[~gone], extra=extra)


@pytest.mark.parametrize("nan", [False, True], ids=["rows lost", "no measurement"])
def test_stretches_between_long_gaps_are_used_together(nan: bool) -> None:
    whole = ball_loop()
    cut = with_holes(whole, count=20, rows=12, nan=nan)
    pieces, warnings = usable_stretches(cut, 30)
    used = sum(map(len, pieces))
    assert used > 0.8 * len(whole)
    assert f"{len(pieces)} stretches between gaps are used together" in warnings[0]
    omega = np.geomspace(0.5, 6.0, 8)
    found, known = (identify_closed_loop(one, order=2, omega_rad_s=omega) for one in (cut, whole))
    assert found.estimate.rows == used
    for one, other in zip(found.response, known.response, strict=True):
        assert abs(one.response / other.response - 1.0) < 0.04


def test_a_measurement_that_is_missing_is_bridged_like_a_sample_that_is() -> None:
    whole = ball_loop()
    rng = np.random.default_rng(3)
    y = whole.y.copy()
    y[rng.choice(np.arange(1, len(whole) - 1), len(whole) // 50, replace=False)] = np.nan
    pieces, warnings = usable_stretches(replace(whole, y=y), 30)
    assert [len(piece) for piece in pieces] == [len(whole)]
    assert f"{np.isnan(y).sum()} of {len(whole)} rows" in warnings[0]


@settings(max_examples=25)
@given(st.lists(st.integers(0, 399), max_size=30), st.lists(st.integers(0, 399), max_size=5))
def test_what_is_used_was_measured_and_nothing_that_can_be_used_is_left(nan: list[int], jumps: list[int]) -> None:
    rows = np.arange(400)
    t = rows + 20.0 * np.sum(rows[:, None] > np.array([*jumps, 400]), axis=1)
    y = np.where(np.isin(rows, nan), np.nan, np.sin(0.1 * rows))
    recording = Recording(t=t, u=np.cos(0.3 * rows), y=y)
    pieces, _ = usable_stretches(recording, 2)
    for piece in pieces:
        assert np.diff(piece.t) == pytest.approx(1.0)
        assert np.isfinite(piece.y).all()
    taken = np.concatenate([piece.t for piece in pieces])
    pairs = np.flatnonzero(np.isfinite(y[1:] + y[:-1]) & (np.diff(t) == 1.0))
    assert np.isin(t[pairs], taken).all()
    assert np.isin(t[pairs + 1], taken).all()


def test_with_gaps_the_regions_cover_and_the_order_is_found() -> None:
    inside = []
    for seed in range(30):
        u, y = _simulated(seed)
        starts = (0, 400, 700, 1500, 1560)
        kept = np.concatenate(
            [np.arange(a, b) for a, b in ((0, 400), (420, 720), (800, 1600), (1700, 1760), (1800, 2000))]
        )
        estimate = fit_order(u[kept], y[kept], 2, starts=starts)
        omega = np.geomspace(0.05, 2.0, 6)
        error = estimate.model.response(omega)[:, 0, 0] - TRUE.response(omega)[:, 0, 0]
        inside.append(inside_region(error, response_covariance(estimate, omega)[:, 0, 0]))
        if seed < 3:
            assert choose_order(u[kept], y[kept], max_order=4, starts=starts).estimate.model.order == 2
    assert np.mean(inside) > 0.9  # of 95 %; 180 regions, in part of the same noise


TRUE = InnovationModel(
    A=np.array([[1.5, -0.7], [1.0, 0.0]]), B=np.array([[0.5], [0.0]]), C=np.array([[1.0, 0.5]]), D=np.zeros((1, 1)),
    K=np.array([[0.4], [0.2]]), innovation_covariance=np.array([[0.04]]), sample_time_s=1.0,
)  # fmt: skip


def _simulated(seed: int, rows: int = 2000) -> tuple[FloatArray, FloatArray]:
    """Return u and y of a loop with feedback u = -0.1 y + r."""
    rng = np.random.default_rng(seed)
    r, e = rng.choice((-1.0, 1.0), rows), 0.2 * rng.standard_normal(rows)
    u, y, x = np.zeros((rows, 1)), np.zeros((rows, 1)), np.zeros(2)
    for k in range(rows):
        y[k] = TRUE.C @ x + e[k]
        u[k] = r[k] - 0.1 * y[k]
        x = TRUE.A @ x + TRUE.B[:, 0] * u[k] + TRUE.K[:, 0] * e[k]
    return u, y
