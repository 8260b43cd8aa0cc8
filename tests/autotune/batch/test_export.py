"""Exports of historians: stamps, words between the numbers, quality flags, decimal commas, Parquet."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from autotune.batch.export import read_export, to_parquet
from autotune.batch.settings import ExportSettings, LoopSettings
from autotune.errors import InputError

GERMAN = (
    "Zeit;TIC1.PV;TIC1.PV.Q;TIC1.OP\n"
    "01.02.2024 03:04:05,250;20,5;Good;50\n"
    "01.02.2024 03:04:05,500;20,6;Bad;50\n"
    "01.02.2024 03:04:05,750;I/O Timeout;Good;51,5\n"
    "01.02.2024 03:04:06,000;;Good;\n"
)
AS_GERMAN = ExportSettings(
    time="Zeit", time_format="%d.%m.%Y %H:%M:%S,%f", delimiter=";", decimal=",", quality="{tag}.Q"
)


def german_loop(tmp_path, **keys):
    path = tmp_path / "export.csv"
    path.write_text(GERMAN, encoding="utf-8")
    return LoopSettings(name="TIC1", file=str(path), u="TIC1.OP", y="TIC1.PV", **keys)


def test_words_and_bad_quality_are_missing_samples(tmp_path):
    columns, flagged = read_export(german_loop(tmp_path), AS_GERMAN)
    np.testing.assert_allclose(columns["t"] - columns["t"][0], [0.0, 0.25, 0.5, 0.75], atol=1e-6)
    np.testing.assert_array_equal(columns["y"], [20.5, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(columns["u"], [50.0, 50.0, 51.5, np.nan])
    np.testing.assert_array_equal(flagged, [False, True, False, False])


def test_an_empty_cell_of_a_tag_recorded_on_change_is_the_value_before_it_even_where_that_is_bad(tmp_path):
    columns, _ = read_export(german_loop(tmp_path), AS_GERMAN.model_copy(update={"empty": "unchanged"}))
    np.testing.assert_array_equal(columns["u"], [50.0, 50.0, 51.5, 51.5])
    np.testing.assert_array_equal(columns["y"], [20.5, np.nan, np.nan, np.nan])


def test_numeric_quality_codes(tmp_path):
    path = tmp_path / "opc.parquet"
    pq.write_table(pa.table({"t": [0, 1, 2], "u": [1, 2, 3], "y": [4.0, 5.0, 6.0], "y.q": [192, 0, 192]}), path)
    columns, _ = read_export(LoopSettings(name="a", file=str(path)), ExportSettings(quality="{tag}.q"))
    np.testing.assert_array_equal(columns["y"], [4.0, np.nan, 6.0])
    np.testing.assert_array_equal(columns["u"], [1.0, 2.0, 3.0])


def test_only_the_interval_asked_for_is_used(tmp_path):
    loop = german_loop(tmp_path, start="01.02.2024 03:04:05,500", end="01.02.2024 03:04:06,000")
    columns, _ = read_export(loop, AS_GERMAN)
    np.testing.assert_array_equal(columns["u"], [50.0, 51.5])


def test_files_that_follow_in_time_are_one_record(tmp_path):
    for month, values in (("01", [1, 2]), ("02", [3, 4])):
        pq.write_table(pa.table({"t": values, "u": values, "y": values}), tmp_path / f"2024-{month}.parquet")
    columns, _ = read_export(LoopSettings(name="a", file=str(tmp_path / "2024-*.parquet")), ExportSettings())
    np.testing.assert_array_equal(columns["t"], [1.0, 2.0, 3.0, 4.0])


def test_a_csv_export_turned_into_parquet_says_the_same(tmp_path):
    loop, shares = german_loop(tmp_path), []
    out = tmp_path / "export.parquet"
    wanted = ["TIC1.PV", "TIC1.PV.Q", "TIC1.OP", "elsewhere"]
    to_parquet(tmp_path / "export.csv", out, wanted, AS_GERMAN, lambda _, share: shares.append(share))
    assert pq.read_schema(out).names == ["Zeit", "TIC1.PV", "TIC1.PV.Q", "TIC1.OP"]
    direct, _ = read_export(loop, AS_GERMAN)
    prepared, _ = read_export(loop, AS_GERMAN, [out])
    for name, values in direct.items():
        np.testing.assert_allclose(prepared[name], values, rtol=0.0, atol=1e-6)
    assert shares[-1] == 1.0


def test_a_tag_that_is_not_there_names_the_nearest(tmp_path):
    loop = german_loop(tmp_path).model_copy(update={"y": "TIC1.PW"})
    with pytest.raises(InputError, match=r"'TIC1\.PW'; did you mean 'TIC1\.PV'"):
        read_export(loop, AS_GERMAN)


def test_nothing_need_be_said_of_a_historians_export(tmp_path):
    said, _ = read_export(german_loop(tmp_path), AS_GERMAN)
    found, flagged = read_export(german_loop(tmp_path), ExportSettings())
    for name, values in said.items():
        np.testing.assert_array_equal(found[name], values)
    assert flagged.sum() == 1
