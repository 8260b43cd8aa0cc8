"""Rows of a long run: the same from memory and from the disk, in memory that stays as it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from autotune.experiment import rows as module
from autotune.experiment.rows import RecentRows
from autotune.recording import RecordingWriter


def test_rows_that_left_the_memory_come_back_from_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "KEPT_ROWS", 50)
    path = tmp_path / "long.csv"
    writer = RecordingWriter(path, ("t", "u", "y"))
    rows = RecentRows(path)
    t = 0.01 * np.arange(230)
    u, y = np.cos(t), np.where(np.arange(230) % 40 == 7, np.nan, np.sin(t))
    for row in zip(t, u, y, strict=True):
        writer.append(row)
        rows.append(*row)
        assert len(rows._columns[0]) < 100
    assert len(rows) == 230
    assert rows.unusable == np.isnan(y).sum()
    assert rows.last_s == t[-1]
    for start in (0, 10, 149, 150, 200, 229, 230):
        for kept, given in zip(rows.since(start), (t, u, y), strict=True):
            np.testing.assert_allclose(kept, given[start:], rtol=1e-11)
    writer.close()
