"""Stamps: numbers with their unit, dates of several countries, times of day."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.errors import InputError
from autotune.files.stamps import detect_form, form_of_strptime, seconds

NEW_YEAR = 86400.0 * 19723  # 2024-01-01 in seconds since 1970


def read(cells, name="t", unit=""):
    form = detect_form(cells, name, unit)
    assert form is not None
    return seconds(cells, form, "file")


@pytest.mark.parametrize(
    "stamps",
    [
        ["2024-01-01T00:00:00", "2024-01-01 00:00:00.250"],
        ["2024-01-01T00:00:00Z", "2024-01-01T02:00:00.250+02:00"],
        ["01.01.2024 00:00:00,000", "01.01.2024 00:00:00,250"],
        ["1.1.24 0:00:00", "1.1.24 0:00:00.25"],
        ["01/01/2024 12:00:00.000 AM", "01/01/2024 12:00:00.250 AM"],
        ["01-Jan-24 00:00:00", "01-JAN-2024 00:00:00.25"],
        ["1. Januar 2024 00:00:00", "1. Januar 2024 00:00:00,25"],
        ["2024/01/01 00:00:00:000", "2024/01/01 00:00:00:250"],
        ["1704067200", "1704067200.25"],
        ["1704067200000", "1704067200250"],
    ],
)
def test_stamps_of_every_form_are_the_same_seconds(stamps):
    assert read(stamps) == pytest.approx([NEW_YEAR, NEW_YEAR + 0.25], abs=1e-6)


@pytest.mark.parametrize(
    ("name", "unit", "unit_s"),
    [("t", "ms", 1e-3), ("Time (min)", "", 60.0), ("time_ms", "", 1e-3), ("Zeit", "h", 3600.0), ("t", "", 1.0)],
)
def test_a_unit_in_the_header_or_in_the_name_holds_for_numbers(name, unit, unit_s):
    assert read(["0", "10", "20"], name, unit) == pytest.approx([0.0, 10 * unit_s, 20 * unit_s])


@given(st.datetimes(datetime.datetime(1971, 1, 1), datetime.datetime(2068, 12, 31)))
def test_a_date_in_any_usual_order_is_the_second_that_the_calendar_says(moment):
    moment = moment.replace(microsecond=moment.microsecond // 1000 * 1000)
    true = (moment - datetime.datetime(1970, 1, 1)).total_seconds()
    for form in ("%Y-%m-%d %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S,%f", "%d-%b-%y %H:%M:%S.%f", "%m/%d/%Y %I:%M:%S.%f %p"):
        text = moment.strftime(form)
        assert read([text])[0] == pytest.approx(true, abs=1e-5)
        assert seconds([text], form_of_strptime(form), "f")[0] == pytest.approx(true, abs=1e-5)


def test_a_time_of_day_goes_on_past_midnight():
    assert np.diff(read(["23:59:59", "00:00:00.5", "00:00:02"])) == pytest.approx([1.5, 1.5])


def test_day_and_month_that_could_be_either_are_not_sure_and_a_day_past_twelve_decides():
    assert not detect_form(["01/02/2024 00:00", "02/02/2024 00:00"], "t").sure
    assert detect_form(["12/02/2024 00:00", "13/02/2024 00:00"], "t").sure
    assert detect_form(["02/12/2024 00:00", "02/13/2024 00:00"], "t").text == "month/day/year"


def test_a_stamp_of_another_form_is_shown():
    form = detect_form(["2024-01-01 00:00:00"], "t")
    with pytest.raises(InputError, match=r"yesterday.*time_format"):
        seconds(["2024-01-01 00:00:00", "yesterday"], form, "file")


@pytest.mark.parametrize("cells", [["a", "b"], ["45.13.2024", "46.13.2024"], ["", ""]])
def test_what_is_no_stamp_is_none(cells):
    assert detect_form(cells, "t") is None
