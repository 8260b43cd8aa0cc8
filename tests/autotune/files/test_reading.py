"""Files as engineers have them become recordings: text of any form, workbooks, Parquet, gaps, change of value."""

from __future__ import annotations

import datetime

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from openpyxl import Workbook

from autotune.errors import InputError
from autotune.files import SignalNames, read_recordings

START = datetime.datetime(2024, 2, 1, 3, 4, 5)
N = 400
T = 0.5 * np.arange(N)
RNG = np.random.default_rng(20)
U = np.repeat(RNG.choice([45.0, 55.0], N // 20), 20)
Y = np.round(60.0 + np.cumsum(RNG.normal(0.0, 0.05, N)), 3)


def stamp(t, form):
    return (START + datetime.timedelta(seconds=float(t))).strftime(form)


def number(value, decimal="."):
    return f"{value:.3f}".replace(".", decimal)


def german(decimal=","):
    lines = ["Datum/Zeit;Temperatur [°C];Stellgröße [%];Sollwert [°C]"]
    lines += [
        f"{stamp(t, '%d.%m.%Y %H:%M:%S,%f')[:-3]};{number(y, decimal)};{number(u, decimal)};60"
        for t, u, y in zip(T, U, Y, strict=True)
    ]
    return "\r\n".join(lines) + "\r\n"


def historian():
    lines = ["Timestamp,TIC101.PV,TIC101.OP,TIC101.SP,FI200.PV", ",degC,%,degC,m3/h"]
    lines += [
        f"{stamp(t, '%Y-%m-%dT%H:%M:%S.%f')},{number(y)},{number(u)},60,12.5" for t, u, y in zip(T, U, Y, strict=True)
    ]
    return "\n".join(lines)


def matlab():
    lines = ["Time,input,output", *(f"{t:g},{u:g},{number(y)}" for t, u, y in zip(T, U, Y, strict=True))]
    return "\n".join(lines)


def plc():
    lines = [
        "Trace;Oven PLC_1",
        "Start;01.02.2024 03:04:05",
        "",
        "Time;Heater.Cmd;Oven.Temp",
        "ms;%;°C",
        "DINT;REAL;REAL",
    ]
    lines += [f"{1000 * t:.0f};{number(u)};{number(y)}" for t, u, y in zip(T, U, Y, strict=True)]
    return "\n".join(lines)


def codesys():
    """Two header rows; names have the prefix of their type, and the row of units names a type where there is none."""
    lines = ["Time\tGVL.fbPid.rActualValue\tGVL.fbPid.rManipulatedValue\tGVL.fbPid.bManual", "ms\tdegC\tV\tBOOL"]
    lines += [f"{1000 * t:.0f}\t{number(y)}\t{number(u)}\tTRUE" for t, u, y in zip(T, U, Y, strict=True)]
    return "\n".join(lines)


def own_names():
    rows = (f"{t:g},{u:g},{number(y)}" for t, u, y in zip(T, U, Y, strict=True))
    return "\n".join(["time,voltage_in,sensor_out", *rows])


def logger():
    lines = ["Date\tTime\tms\tValve\tLevel"]
    for t, u, y in zip(T, U, Y, strict=True):
        lines.append(f"{stamp(t, '%m/%d/%Y')}\t{stamp(t, '%I:%M:%S %p')}\t{t % 1 * 1000:.0f}\t{number(u)}\t{number(y)}")
    return "\n".join(lines)


def one_row_per_sample():
    lines = ['"VarName";"TimeString";"VarValue";"Validity"']
    for t, u, y in zip(T, U, Y, strict=True):
        at = stamp(t, "%d.%m.%Y %H:%M:%S.%f")
        lines += [f'"Oven_PV";"{at}";{number(y, ",")};1', f'"Oven_OP";"{at}";{number(u, ",")};1']
    return "\n".join(lines)


def no_header():
    return "\n".join(f"{t:g} {u:g} {number(y)}" for t, u, y in zip(T, U, Y, strict=True))


@pytest.mark.parametrize(
    ("name", "content", "encoding", "units"),
    [
        ("german.csv", german(), "cp1252", {"u": "%", "y": "°C", "r": "°C"}),
        ("german.csv", german(), "utf-16", {"u": "%", "y": "°C", "r": "°C"}),
        ("historian.csv", historian(), "utf-8", {"u": "%", "y": "degC", "r": "degC", "FI200.PV": "m3/h"}),
        ("matlab.csv", matlab(), "utf-8", {}),
        ("trace.csv", plc(), "utf-8-sig", {"u": "%", "y": "°C"}),
        ("trace.txt", codesys(), "utf-8", {"u": "V", "y": "degC"}),
        ("own.csv", own_names(), "utf-8", {}),
        ("logger.txt", logger(), "utf-8", {}),
        ("hmi.csv", one_row_per_sample(), "utf-16", {}),
    ],
)
def test_a_usual_file_is_read_without_a_word_about_it(tmp_path, name, content, encoding, units):
    path = tmp_path / name
    path.write_text(content, encoding=encoding)
    reading = read_recordings(path)
    (recording,) = reading.recordings
    np.testing.assert_allclose(recording.t, T, atol=1e-6)
    np.testing.assert_array_equal(recording.u, U)
    np.testing.assert_allclose(recording.y, Y)
    assert recording.metadata["units"] == units
    assert reading.said


def test_a_sheet_with_rows_of_names_and_units_is_found_among_others(tmp_path):
    book = Workbook()
    book.active.append(["Loop", "oven"])
    sheet = book.create_sheet("Data")
    sheet.append(["Zeit", "Ventil", "Temperatur"])
    sheet.append(["", "%", "°C"])
    for t, u, y in zip(T, U, Y, strict=True):
        sheet.append([START + datetime.timedelta(seconds=float(t)), float(u), float(y)])
    book.save(tmp_path / "oven.xlsx")
    (recording,) = read_recordings(tmp_path / "oven.xlsx").recordings
    np.testing.assert_allclose(recording.t, T, atol=2e-3)  # a sheet keeps milliseconds
    np.testing.assert_array_equal(recording.u, U)
    np.testing.assert_allclose(recording.y, Y)
    assert recording.metadata["units"] == {"u": "%", "y": "°C"}


def test_parquet_with_time_stamps(tmp_path):
    stamps = [START + datetime.timedelta(seconds=float(t)) for t in T]
    pq.write_table(pa.table({"time": stamps, "u_cmd": U, "pv": Y}), tmp_path / "a.parquet")
    (recording,) = read_recordings(tmp_path / "a.parquet").recordings
    np.testing.assert_allclose(recording.t, T, atol=1e-6)
    np.testing.assert_array_equal(recording.y, Y)


@given(
    delimiter=st.sampled_from([";", "\t", "|", ","]),
    decimal=st.sampled_from([".", ","]),
    form=st.sampled_from(["%Y-%m-%d %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f", "%d-%b-%Y %H:%M:%S.%f", "s"]),
    digits=st.integers(0, 4),
    scale=st.sampled_from([0.01, 1.0, 1e3]),
    units=st.booleans(),
)
def test_every_way_to_write_a_table_says_the_same(tmp_path_factory, delimiter, decimal, form, digits, scale, units):
    def cell(value, places):
        text = f"{value:.{places}f}".replace(".", decimal)
        return f'"{text}"' if delimiter == decimal else text

    u, y = np.round(scale * U, 4), np.round(scale * Y, digits)
    rows = [delimiter.join(["time", "PV", "OP"]), *([delimiter.join(["", "bar", "%"])] if units else [])]
    for k in range(60):
        at = cell(T[k], 3) if form == "s" else stamp(T[k], form)
        rows.append(delimiter.join([at, cell(y[k], digits), cell(u[k], 4)]))
    path = tmp_path_factory.mktemp("written") / "a.csv"
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    (recording,) = read_recordings(path).recordings
    np.testing.assert_allclose(recording.t, T[:60], atol=1e-6)
    np.testing.assert_allclose(recording.u, u[:60])
    np.testing.assert_allclose(recording.y, y[:60])


@pytest.mark.parametrize(
    ("header", "named"),
    [
        ("Zeit;w;x;y", SignalNames(u="y", y="x")),  # DIN writes y for the command; elsewhere it is the measurement
        ("Time;TIC1.PV;TIC1.OP;TIC2.PV;TIC2.OP", SignalNames(y="TIC1.PV")),
        ("a;b;c;d", SignalNames(u="c", y="b")),
        ("Time;Out1;In1", SignalNames(u="In1", y="Out1")),  # of the plant, or of the controller
    ],
)
def test_what_names_leave_open_is_asked_for_and_never_guessed(tmp_path, header, named):
    path = tmp_path / "a.csv"
    width = header.count(";")
    rows = [
        ";".join([f"{t:g}", *[f"{y:.3f}", f"{u:g}", f"{y:.3f}", f"{u:g}"][:width]])
        for t, u, y in zip(T, U, Y, strict=True)
    ]
    path.write_text("\n".join([header, *rows]))
    with pytest.raises(InputError, match=r"not sure; it has .*--u .*--y .*autotune import"):
        read_recordings(path)
    asked = []
    read_recordings(path, ask=lambda role, columns, guess: asked.append(role) or columns[len(asked)])
    assert asked == ["command", "measurement"]
    assert read_recordings(path, named).names.y == named.y


def _columns(path, header, *columns):
    rows = (";".join(f"{value:.4f}" for value in row) for row in zip(*columns, strict=True))
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    "header",
    ["time [s];level [%];inflow valve [%]", "t_ms;PT101_mA;YV101_pct", "Time;LIT-3;FCV-2", "t;FT1;XV1"],
)
def test_the_words_of_a_column_and_the_letters_of_its_tag_say_what_it_is(tmp_path, header):
    (recording,) = read_recordings(_columns(tmp_path / "a.csv", header, T, Y, U)).recordings
    np.testing.assert_allclose(recording.u, U)


def test_units_at_the_end_of_names_are_units(tmp_path):
    (recording,) = read_recordings(_columns(tmp_path / "a.csv", "t_ms;PT101_mA;YV101_pct", T, Y, U)).recordings
    assert recording.metadata["units"] == {"u": "%", "y": "mA"}


@pytest.mark.parametrize("header", ["Time;Input;Output;Setpoint", "t;in;out;sp", "Zeit;y;x;w"])
@pytest.mark.parametrize("swapped", [False, True])
def test_the_signal_that_keeps_to_the_set_point_is_the_measurement(tmp_path, header, swapped):
    rng = np.random.default_rng(4)
    w = np.repeat(rng.choice([58.0, 62.0], 4), 100)
    x = np.round(w + rng.normal(0.0, 0.2, N), 3)
    signals = (U, x) if swapped else (x, U)
    (recording,) = read_recordings(_columns(tmp_path / "a.csv", header, T, *signals, w)).recordings
    np.testing.assert_allclose(recording.y, x)
    np.testing.assert_allclose(recording.u, U)


def test_a_pid_block_whose_signals_both_leave_the_set_point_is_asked_about(tmp_path):
    path = _columns(tmp_path / "a.csv", "Time;Input;Output;Setpoint", T, Y, Y[::-1], np.full(N, 80.0))
    with pytest.raises(InputError, match="command and measurement is not sure"):
        read_recordings(path)


def test_columns_without_a_header_are_named_by_number(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(no_header())
    (recording,) = read_recordings(path, SignalNames(u="2", y="3")).recordings
    np.testing.assert_allclose(recording.y, Y)


def test_a_column_that_is_not_there_names_the_nearest(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(historian())
    with pytest.raises(InputError, match=r"no column 'TIC101.PVV'; did you mean 'TIC101.PV'"):
        read_recordings(path, SignalNames(y="TIC101.PVV"))


def test_words_and_flags_of_bad_quality_are_missing_samples(tmp_path):
    path = tmp_path / "a.csv"
    rows = [
        f"{t:g},{'I/O Timeout' if k == 9 else y},{'Bad' if k == 19 else 'Good'},{u}"
        for k, (t, u, y) in enumerate(zip(T, U, Y, strict=True))
    ]
    path.write_text("\n".join(["Time,A.PV,A.PV.Q,A.OP", *rows]))
    reading = read_recordings(path)
    assert len(reading.longest) == N - 2
    assert any("flagged" in note for note in reading.notes)


def test_a_gap_cuts_the_record_in_two_and_is_said(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "\n".join(["time_s,cmd,meas", *(f"{t},{u},{y}" for t, u, y in zip(T, U, Y, strict=True) if not 50 < t < 120)])
    )
    reading = read_recordings(path)
    assert [len(one) for one in reading.recordings] == [101, 160]
    assert any("a gap is longer than 5 s" in note for note in reading.notes)


def test_a_record_on_change_of_value_is_put_on_a_grid_within_its_dead_band(tmp_path):
    t = 0.5 * np.arange(4000)
    u = np.repeat(RNG.choice([45.0, 55.0], 40), 100)
    y = 60.0 + 5.0 * np.sin(0.01 * t) + 0.02 * t
    band, last = 0.25, (np.nan, np.nan)
    rows = []
    for k in range(t.size):
        changed = not abs(y[k] - last[1]) < band
        if u[k] != last[0] or changed:
            rows.append(f"{t[k]},{u[k] if u[k] != last[0] else ''},{y[k] if changed else ''}")
            last = (u[k], y[k] if changed else last[1])
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time,A.OP,A.PV", *rows]))
    reading = read_recordings(path)
    (recording,) = reading.recordings
    assert recording.is_uniform
    assert any("change of value" in note for note in reading.notes)
    at = np.round(recording.t / 0.5).astype(int)
    assert np.max(np.abs(recording.y - y[at])) < 1.5 * band
    np.testing.assert_array_equal(recording.u, u[at])


def test_stamps_of_whole_seconds_for_several_rows_are_spread(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "\n".join(["Time,CO,PV", *(f"{stamp(t, '%H:%M:%S')},{u},{y}" for t, u, y in zip(0.5 * T, U, Y, strict=True))])
    )
    (recording,) = read_recordings(path).recordings
    np.testing.assert_allclose(np.diff(recording.t), 0.25, atol=1e-9)


@pytest.mark.parametrize("content", ["", "a,b,c\n", "hello\nworld\n", "\x00\x01\x02" * 50])
def test_what_is_no_table_is_refused(tmp_path, content):
    path = tmp_path / "a.dat"
    path.write_text(content)
    with pytest.raises(InputError, match="no rows of numbers"):
        read_recordings(path)


def test_a_recording_of_the_projects_own_form_stays_as_it_is(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,u,y,r\n5,1,2,3\n6,1,2,3\n900,1,2,3\n")
    reading = read_recordings(path)
    assert reading.recordings[0].t.tolist() == [5.0, 6.0, 900.0]
    assert not reading.said
