"""From a table's columns to signals over stamps: which rows are flagged, how the stamps are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.errors import InputError
from autotune.files.cells import GOOD, Cells, are_flags, fill_forward, good_samples, numbers
from autotune.files.signal_names import Roles
from autotune.files.stamps import StampForm, detect_form, form_of_strptime, seconds
from autotune.files.table import FileForm, Table, list_names

_MOST_OTHERS = 8
#: what the name of a column of quality has behind that of its signal
_FLAG_ENDS = (".q", "_q", ".quality", "_quality", " quality", ".status", " status", "_status")


@dataclass(frozen=True, kw_only=True, eq=False)
class Signals:
    """Signals of a table as they are in the file.

    Attributes
    ----------
    columns : dict of str to (N,) array
        t in seconds since 1970 (or since the zero of numeric stamps), u, y, r where there is one, and others under the
        file's names; NaN for what is missing, no number, or of bad quality.
    flagged : (N,) array of bool
        Samples of u or y that hold a value and are of bad quality.
    stamp : StampForm
        How the stamps are written.
    notes : tuple of str
        What was left out.
    """

    columns: dict[str, FloatArray]
    flagged: BoolArray
    stamp: StampForm
    notes: tuple[str, ...]


def signals_of(table: Table, roles: Roles, form: FileForm) -> Signals:
    """Return the signals of a table.

    Parameters
    ----------
    table : Table
        As it was opened.
    roles : Roles
        Which column is what.
    form : FileForm
        What was said of the file.

    Raises
    ------
    InputError
        Stamps that cannot be read.
    """
    notes: list[str] = []
    others = roles.others if len(roles.others) <= _MOST_OTHERS else ()
    if len(roles.others) > _MOST_OTHERS:
        notes.append(f"{len(roles.others)} further columns are left out: {list_names(roles.others, 4)}")
    signals = {role: name for role in ("u", "y", "r") if (name := getattr(roles.names, role))}
    signals |= {table.bare(name): name for name in others if table.bare(name) not in ("t", "u", "y", "r")}
    flags = {name: flag for name in signals.values() if (flag := _flag_of(table, name, form.quality))}
    signals = {key: name for key, name in signals.items() if name not in flags.values()}
    cells = table.load(list(dict.fromkeys([*roles.time, *signals.values(), *flags.values()])))
    stamp = stamp_form(table, roles.time, form)
    columns = {"t": stamps_of(table, roles.time, cells, stamp)}
    flagged = np.zeros(columns["t"].size, dtype=np.bool_)
    for key, name in signals.items():
        values, empty = numbers(cells[name], table.decimal)
        if name in flags:
            bad = ~good_samples(cells[flags[name]], form.good or GOOD) & ~empty
            values = np.where(bad, np.nan, values)
            flagged |= bad & (key in ("u", "y"))
        columns[key] = fill_forward(values, empty) if form.empty_unchanged else values
    if flagged.any():
        notes.append(f"{int(flagged.sum())} rows are flagged as bad")
    return Signals(columns=columns, flagged=flagged, stamp=stamp, notes=tuple(notes))


def _flag_of(table: Table, name: str, pattern: str | None) -> str:
    """Return the column that holds the quality of another, empty where there is none."""
    if pattern:
        flag = pattern.replace("{tag}", name)
        return flag if flag in table.names else ""
    by_name = {other.lower(): other for other in table.names}
    found = (by_name.get(table.bare(name).lower() + end, "") for end in _FLAG_ENDS)
    return next((flag for flag in found if flag and are_flags(table.sample[flag])), "")


def stamp_form(table: Table, time: Sequence[str], form: FileForm) -> StampForm:
    """Return how a table's stamps are written: as is said, or as is found out.

    Parameters
    ----------
    table : Table
        As it was opened.
    time : sequence of str
        Columns of the stamp.
    form : FileForm
        What was said of the file.

    Raises
    ------
    InputError
        They are of no form that is known.
    """
    if form.time_format is not None:
        return form_of_strptime(form.time_format)
    if form.time_unit_s is not None and time[0] not in table.in_seconds:
        return StampForm(text=f"numbers, {form.time_unit_s:g} s each", unit_s=form.time_unit_s, decimal=table.decimal)
    if time[0] in table.in_seconds:
        return StampForm(text="time stamps")
    found = detect_form(_join_stamps(table.sample, time[:2]), time[0], table.units.get(time[0], ""), table.decimal)
    if found is not None:
        return found
    cells = [str(cell) for cell in table.sample[time[0]] if str(cell).strip()]
    raise InputError(
        f"the stamps of column {time[0]!r} cannot be read ({cells[0] if cells else 'all are empty'!r})",
        where=table.path,
        remedy="set time_format to their form, for example %d.%m.%Y %H:%M:%S",
    )


def stamps_of(table: Table, time: Sequence[str], cells: Mapping[str, Cells], form: StampForm) -> FloatArray:
    """Return a table's stamps in seconds.

    Parameters
    ----------
    table : Table
        As it was opened.
    time : sequence of str
        Columns of the stamp.
    cells : mapping of str to cells
        N rows of these columns.
    form : StampForm
        How they are written.

    Returns
    -------
    (N,) array
        Stamps [s]; dates since 1970, numbers since their own zero.
    """
    if isinstance(cells[time[0]], np.ndarray) and time[0] in table.in_seconds:
        return np.asarray(cells[time[0]])
    clock = [name for name in time if _is_clock(table, name)]
    t = seconds(_join_stamps(cells, [time[0], *clock]) if clock else cells[time[0]], form, table.path)
    for name in time[1:]:
        if name not in clock:
            t = t + 1e-3 * numbers(cells[name], table.decimal)[0]
    return t


def _is_clock(table: Table, name: str) -> bool:
    found = detect_form(table.sample[name], name, "", table.decimal)
    return found is not None and found.text == "time of day" and table.names.index(name) > 0


def _join_stamps(cells: Mapping[str, Cells], time: Sequence[str]) -> Cells:
    """Return date and time of day as one stamp where they stand in two columns."""
    first = cells[time[0]]
    if len(time) < 2 or isinstance(first, np.ndarray) or not any(":" in str(cell) for cell in cells[time[1]]):
        return first
    return [f"{date} {clock}".strip() for date, clock in zip(first, cells[time[1]], strict=True)]
