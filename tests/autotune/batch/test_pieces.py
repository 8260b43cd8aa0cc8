"""Records of a plant as they are: clocks set back, gaps, lost samples, raw units."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from autotune.batch.pieces import read_record
from autotune.batch.settings import CampaignSettings, ExportSettings, LoopSettings
from autotune.errors import InputError
from tests.autotune.batch.plant_files import plant_file, signals, write

EXPORT = CampaignSettings(name="a", export=ExportSettings())


def record_of(tmp_path, settings=EXPORT, **columns):
    path = write(tmp_path / "a.csv", columns)
    return read_record(LoopSettings(name="a", file=str(path)), settings)


def test_a_clock_set_back_by_an_hour_cuts_the_record_and_reorders_nothing(tmp_path):
    t, u, y = signals(0, 400)
    record = record_of(tmp_path, t=np.where(np.arange(400) < 200, 7200.0 + t, 3600.0 + t), u=u, y=y)
    first, second = record.pieces
    np.testing.assert_allclose(np.concatenate([first.y, second.y]), y, rtol=1e-7)
    assert any("stamps go back" in note for note in record.notes)


def test_a_long_gap_cuts_the_record_and_a_short_one_does_not(tmp_path):
    t, u, y = signals(0, 400)
    y[100:105] = np.nan
    y[200:250] = np.nan
    record = record_of(tmp_path, t=t, u=u, y=y)
    assert [round(piece.t[0] / 0.1) for piece in record.pieces] == [0, 250]
    assert record.bad == 55
    whole = record_of(tmp_path, EXPORT.model_copy(update={"longest_gap_s": 6.0}), t=t, u=u, y=y)
    assert len(whole.pieces) == 1


def test_a_lost_measurement_stays_as_missing_only_where_the_command_changes(tmp_path):
    t, y = 0.1 * np.arange(200), np.ones(200)
    u = np.where(t < 10.0, 1.0, 2.0)
    y[[50, 100]] = np.nan
    (piece,) = record_of(tmp_path, t=t, u=u, y=y).pieces
    assert len(piece) == 199
    assert piece.u[np.isnan(piece.y)] == [2.0]


def test_units_are_applied_before_anything_else(tmp_path):
    t, u, y = signals(0, 200)
    path = write(tmp_path / "a.csv", {"t": t, "u": u, "y": y, "r": y})
    loop = LoopSettings(name="a", file=str(path), u_scale=0.01, y_scale=2.0, y_offset=-40.0)
    (piece,) = read_record(loop, CampaignSettings(name="a")).pieces
    np.testing.assert_allclose(piece.u, 0.01 * u, rtol=1e-7)
    np.testing.assert_allclose(piece.y, 2.0 * y - 40.0, atol=1e-5)
    np.testing.assert_allclose(piece.extra["r"], piece.y)


def test_a_set_point_recorded_on_change_is_held(tmp_path):
    t, u, y = signals(0, 200)
    r = np.full(200, np.nan)
    r[[0, 120]] = 1.0, 2.0
    (piece,) = record_of(tmp_path, t=t, u=u, y=y, r=r).pieces
    np.testing.assert_array_equal(piece.extra["r"], np.where(np.arange(200) < 120, 1.0, 2.0))


def test_metadata_of_a_recording_stays_with_its_pieces(tmp_path):
    path = plant_file(tmp_path / "a.csv", 0, 200)
    path.with_suffix(".toml").write_text('[units]\ny = "m"\n')
    (piece,) = read_record(LoopSettings(name="a", file=str(path)), CampaignSettings(name="a")).pieces
    assert piece.metadata["units"] == {"y": "m"}


def test_too_few_good_rows_are_refused_with_what_there_is(tmp_path):
    t, u, y = signals(0, 200)
    y[40:] = np.nan
    with pytest.raises(InputError, match="longest of 200 rows has 40"):
        record_of(tmp_path, t=t, u=u, y=y)


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), faults=st.floats(0.0, 0.1), missing=st.floats(0.0, 0.9))
@example(seed=115, faults=0.0078125, missing=0.890625)  # less than a tenth of the rows have a measurement
def test_pieces_are_recordings_whatever_the_stamps(tmp_path_factory, seed, faults, missing):
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.1, 0.0, 50.0, -9.0], 299, p=[1.0 - faults, *[faults / 3.0] * 3])
    t, u = np.concatenate([[0.0], np.cumsum(steps)]), np.arange(300.0)
    y = np.where(rng.random(300) < missing, np.nan, 1.0)
    try:
        record = record_of(tmp_path_factory.mktemp("a"), t=t, u=u, y=y)
    except InputError as error:
        assert "no stretch" in str(error)  # noqa: PT017 - the one reason there may be
        return
    assert all(np.all(np.diff(piece.t) > 0) and np.isfinite(piece.y).sum() >= 60 for piece in record.pieces)
    assert np.all(np.diff(np.concatenate([piece.u for piece in record.pieces])) > 0)  # no row twice, none out of order
