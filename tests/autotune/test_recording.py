from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from autotune.errors import InputError
from autotune.recording import Recording, RecordingWriter, read_recording, write_recording

finite = st.floats(-1e6, 1e6, allow_nan=False)


def test_comments_extra_columns_and_the_sidecar_are_read(tmp_path: Path) -> None:
    path = tmp_path / "rec.csv"
    path.write_text("# a person's note\nt,u,y,r\n0,1,2,3\n# another\n0.5,1,2.5,3\n")
    path.with_suffix(".toml").write_text('rig = "ball"\n')
    recording = read_recording(path)
    assert recording.y.tolist() == [2.0, 2.5]
    assert recording["r"].tolist() == [3.0, 3.0]
    assert recording.metadata["rig"] == "ball"


@pytest.mark.parametrize("cut", range(1, 8))
def test_a_recording_cut_off_mid_line_is_read_up_to_the_cut(tmp_path: Path, cut: int) -> None:
    whole = "t,u,y\n0,1,2\n1,1,2.25\n2,1,2.75\n"
    path = tmp_path / "rec.csv"
    path.write_text(whole[:-cut])
    assert read_recording(path).y.tolist() == [2.0, 2.25]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("t,u\n0,1\n1,1\n", "lacks y"),
        ("", "lacks t, u, y"),
        ("t,u,y\n0,1,2\n", "1 row"),
        ("t,u,y\n0,1,2\n0,1,2\n", "does not increase at data row 2"),
        ("t,u,y\n0,1,2\nnan,1,2\n", "does not increase"),
        ("t,u,y\n0,1,2\n1,one,2\n", "line 3"),
        ("t,u,y\n0,1,2\n1,2\n", "2 cells where the header has 3"),
        ("t,u,y,u\n0,1,2,3\n", "names a column twice"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_its_place(tmp_path: Path, content: str, says: str) -> None:
    path = tmp_path / "rec.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=says) as caught:
        read_recording(path)
    assert str(path) in str(caught.value)


def test_an_empty_cell_is_not_a_number_and_named_when_a_method_needs_one(tmp_path: Path) -> None:
    path = tmp_path / "rec.csv"
    path.write_text("t,u,y\n0,1,2\n1,1,\n2,1,3\n")
    recording = read_recording(path)
    assert np.isnan(recording.y[1])
    with pytest.raises(InputError, match=r"'y' is not a number in 1 row\(s\), first at t = 1 s"):
        recording.require_finite()


@given(
    steps=arrays(float, st.integers(2, 30), elements=st.floats(1e-3, 10)),
    values=st.data(),
)
def test_what_is_written_reads_back(
    tmp_path_factory: pytest.TempPathFactory, steps: object, values: st.DataObject
) -> None:
    t = np.cumsum(np.asarray(steps))
    u, y, r = (values.draw(arrays(float, t.size, elements=finite)) for _ in range(3))
    path = tmp_path_factory.mktemp("rec") / "rec.csv"
    write_recording(Recording(t=t, u=u, y=y, extra={"r": r}, metadata={"rig": "x"}), path)
    back = read_recording(path)
    for column, sent in {"t": t, "u": u, "y": y, "r": r}.items():
        np.testing.assert_allclose(back[column], sent, rtol=1e-11)
    assert back.metadata["rig"] == "x"


def test_resampling_holds_commands_and_interpolates_measurements() -> None:
    recording = Recording(t=np.array([0.0, 1.0, 3.0]), u=np.array([0.0, 1.0, 2.0]), y=np.array([0.0, 2.0, 4.0]))
    finer = recording.resampled(0.5)
    assert finer.t.tolist() == [0, 0.5, 1, 1.5, 2, 2.5, 3]
    assert finer.u.tolist() == [0, 0, 1, 1, 1, 1, 2]
    assert finer.y.tolist() == [0, 1, 2, 2.5, 3, 3.5, 4]


def test_a_killed_process_leaves_every_appended_row_readable(tmp_path: Path) -> None:
    path = tmp_path / "rec.csv"
    program = (
        "import os, signal, sys\n"
        "from autotune.recording import RecordingWriter\n"
        "writer = RecordingWriter(sys.argv[1], ['t', 'u', 'y'], {'ended': 'running'})\n"
        "for k in range(1000): writer.append([k * 0.01, 1.0, float(k)])\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, os.fspath(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    recording = read_recording(path)
    assert len(recording) == 1000
    assert recording.metadata["ended"] == "running"


def test_a_recording_is_never_overwritten_by_an_experiment(tmp_path: Path) -> None:
    path = tmp_path / "rec.csv"
    with RecordingWriter(path, ["t", "u", "y"]) as writer:
        writer.append([0.0, 1.0, 2.0])
    with pytest.raises(InputError, match="already there"):
        RecordingWriter(path, ["t", "u", "y"])


@given(arrays(float, 40, elements=finite), arrays(bool, 40))
def test_commands_stand_still_at_their_mean_in_the_rows_that_are_asked_for(u: np.ndarray, rows: np.ndarray) -> None:
    r = Recording(t=np.arange(40.0), u=u, y=np.zeros(40))
    still = r.standing_still(rows)
    np.testing.assert_array_equal(still.u[~rows], u[~rows])
    edges = np.flatnonzero(np.diff(rows)) + 1
    for part, asked in zip(np.split(np.arange(40), edges), np.split(rows, edges), strict=True):
        if asked.all():
            np.testing.assert_allclose(still.u[part], u[part].mean(), atol=1e-9 * np.abs(u).max())
    assert (still is r) == np.array_equal(still.u, u)
