"""Short gaps of a record are bridged: what lies between them is used together, as if all of it were there."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.identification.closed_loop.gaps import LONGEST, bridged
from autotune.identification.closed_loop.identify import identify_closed_loop, usable_stretch
from autotune.recording import Recording
from tests.autotune.identification.test_closed_loop import DT, ball_loop

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
    found = bridged(Recording(t=t, u=u, y=10.0 * t), 0.25)
    assert found.gaps == 0  # two of six rows: what is put in would speak for the plant
    rows = np.arange(60.0)
    sparse = np.delete(rows, [20, 21])
    found = bridged(Recording(t=sparse, u=sparse, y=10.0 * sparse), 0.25)
    assert (found.gaps, found.rows) == (1, 2)
    assert found.recording.t == pytest.approx(rows)
    assert found.recording.u[18:24] == pytest.approx([18.0, 19.0, 19.0, 19.0, 22.0, 23.0])
    assert found.recording.y == pytest.approx(10.0 * rows)


def test_a_sample_that_came_late_counts_by_the_time_its_command_acted() -> None:
    rows = np.arange(60.0)
    late = rows.copy()
    late[20] += 0.4
    found = bridged(Recording(t=late, u=rows, y=10.0 * rows), 0.25)
    assert (found.gaps, found.rows) == (1, 1)
    assert found.recording.u[19:22] == pytest.approx([19.0, 0.4 * 19.0 + 0.6 * 20.0, 21.0])


def test_a_long_gap_still_cuts_the_record() -> None:
    t = np.arange(200.0) + np.where(np.arange(200) > 120, 20.0, 0.0)
    recording = Recording(t=t, u=np.sin(t), y=np.cos(t))
    assert bridged(recording, 0.25).recording is recording
    assert len(usable_stretch(recording)[0]) == 121
