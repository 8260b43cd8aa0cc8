"""From a file as engineers have it to recordings, with all that was found out and done on the way."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.errors import InputError
from autotune.files.cells import GOOD, Cells, are_flags, good_samples, held, numbers
from autotune.files.signal_names import Roles, SignalNames, confirmed, find_roles
from autotune.files.stamps import StampForm, detect_form, form_of_strptime, seconds
from autotune.files.stretches import on_change, on_grid, stamped, stretch, stretches
from autotune.files.table import FileForm, Table, listed
from autotune.files.workbook import open_table
from autotune.recording import Recording, is_own_form, read_recording, read_sidecar
from autotune.text_files import checked_path

#: What asks somebody for a column: what for, the file's columns, the best guess.
Ask: TypeAlias = Callable[[str, Sequence[str], str], str]

_ROLE = {"t": "time", "u": "command", "y": "measurement", "r": "set-point"}
_MOST_OTHERS = 8
_FLAG_NAMES = (
    "{tag}.q",
    "{tag}_q",
    "{tag}.quality",
    "{tag}_quality",
    "{tag} quality",
    "{tag}.status",
    "{tag} status",
    "{tag}_status",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """What a file gave.

    Attributes
    ----------
    recordings : tuple of Recording
        Uninterrupted stretches in the order of time; at least one.
    names : SignalNames
        The file's columns that were taken.
    said : str
        How the file was read, in one line; empty for a recording in the project's own form.
    notes : tuple of str
        What was left out, cut, or put on a grid.
    """

    recordings: tuple[Recording, ...]
    names: SignalNames
    said: str = ""
    notes: tuple[str, ...] = ()

    @property
    def longest(self) -> Recording:
        """The stretch with the most rows."""
        return max(self.recordings, key=len)


def read_recordings(
    path: str | os.PathLike[str],
    names: SignalNames | None = None,
    *,
    form: FileForm | None = None,
    ask: Ask | None = None,
    longest_gap_s: float | None = None,
) -> Reading:
    """Read a file of any form: the project's own, text with any delimiter, a workbook, Parquet, arrays.

    Parameters
    ----------
    path : path
        The file.
    names : SignalNames, optional
        Its columns, as far as somebody says them.
    form : FileForm, optional
        How it is written, as far as somebody says it.
    ask : callable, optional
        Asked for a column where names and values leave it open.
    longest_gap_s : float, optional
        A longer gap cuts the record [s]; ten usual steps when absent.

    Returns
    -------
    Reading
        Recordings with t from the first row on, and what was found out.

    Raises
    ------
    InputError
        The file cannot be read, or a column is not sure and nobody is there to ask.
    """
    path, given, form = checked_path(path), names or SignalNames(), form or FileForm()
    if given == SignalNames() and form == FileForm() and is_own_form(path):
        return Reading(recordings=(read_recording(path),), names=SignalNames(t="t", u="u", y="y"))
    table = open_table(path, form)
    roles = _confirmed(table, find_roles(table, given), ask)
    signals = signals_of(table, roles, form)
    said, notes = _said(table, roles, signals.stamp), list(signals.notes)
    metadata = {**read_sidecar(path), "units": _units(table, roles), "file": _origin(path, table, roles, signals.stamp)}
    parts = parts_of(signals.columns, longest_gap_s, notes, str(path))
    recordings = tuple(_recording(part, metadata, str(path), i) for i, part in enumerate(parts))
    return Reading(recordings=recordings, names=roles.names, said=said, notes=tuple(notes))


def _confirmed(table: Table, roles: Roles, ask: Ask | None) -> Roles:
    """Ask for what is not sure, or refuse the file with the line that would do."""
    if not roles.unsure:
        return roles
    guess = vars(roles.names)
    if ask is None:
        missing = " and ".join(_ROLE[role] for role in roles.unsure)
        options = " ".join(f'--{role} "{guess[role] or "COLUMN"}"' for role in roles.unsure)
        raise InputError(
            f"which column is the {missing} is not sure; it has {listed(map(table.described, table.names), 12)}",
            where=table.path,
            remedy=f"name them, for example {options}, or write the project's form with autotune import",
        )
    answers = {role: table.name_of(ask(_ROLE[role], table.names, guess[role])) for role in roles.unsure}
    return confirmed(roles, answers)


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
        notes.append(f"{len(roles.others)} further columns are left out: {listed(roles.others, 4)}")
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
        columns[key] = held(values, empty) if form.empty_unchanged else values
    if flagged.any():
        notes.append(f"{int(flagged.sum())} rows are flagged as bad")
    return Signals(columns=columns, flagged=flagged, stamp=stamp, notes=tuple(notes))


def _flag_of(table: Table, name: str, pattern: str | None) -> str:
    """Return the column that holds the quality of another, empty where there is none."""
    if pattern:
        flag = pattern.replace("{tag}", name)
        return flag if flag in table.names else ""
    by_name = {other.lower(): other for other in table.names}
    found = (by_name.get(pattern.replace("{tag}", table.bare(name).lower()), "") for pattern in _FLAG_NAMES)
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
    found = detect_form(_joined(table.sample, time[:2]), time[0], table.units.get(time[0], ""), table.decimal)
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
    t = seconds(_joined(cells, [time[0], *clock]) if clock else cells[time[0]], form, table.path)
    for name in time[1:]:
        if name not in clock:
            t = t + 1e-3 * numbers(cells[name], table.decimal)[0]
    return t


def _is_clock(table: Table, name: str) -> bool:
    found = detect_form(table.sample[name], name, "", table.decimal)
    return found is not None and found.text == "time of day" and table.names.index(name) > 0


def _joined(cells: Mapping[str, Cells], time: Sequence[str]) -> Cells:
    """Return date and time of day as one stamp where they stand in two columns."""
    first = cells[time[0]]
    if len(time) < 2 or isinstance(first, np.ndarray) or not any(":" in str(cell) for cell in cells[time[1]]):
        return first
    return [f"{date} {clock}".strip() for date, clock in zip(first, cells[time[1]], strict=True)]


def parts_of(
    columns: dict[str, FloatArray], longest_gap_s: float | None, notes: list[str], where: str, fewest: int = 20
) -> list[dict[str, FloatArray]]:
    """Return the stretches of a record, or all of it on a grid where it was recorded on change.

    Parameters
    ----------
    columns : dict of str to (N,) array
        t, u, y and others as they are in the file.
    longest_gap_s : float or None
        A longer gap cuts [s]; ten usual steps when None.
    notes : list of str
        What was done is added.
    where : str
        The file, for messages.
    fewest : int
        Rows below which a stretch is left out, unless all are shorter.

    Raises
    ------
    InputError
        Fewer than two rows, or none with both a command and a measurement.
    """
    columns = stamped(columns, notes)
    if columns["t"].size < 2:
        raise InputError(f"{columns['t'].size} row(s)", where=where, remedy="a recording needs at least two rows")
    if np.all(np.diff(columns["t"]) > 0.0) and on_change(columns["t"], columns["u"], columns["y"]):
        return [on_grid(columns, notes)]
    good: BoolArray = np.isfinite(columns["u"]) & np.isfinite(columns["y"])
    if not good.any():
        raise InputError(
            f"no stretch of {fewest} good rows: no row has both a command and a measurement",
            where=where,
            remedy="check the columns, and their quality where it is given",
        )
    found = stretches(columns["t"], good, longest_gap_s, notes)
    fewest = min(fewest, max(map(len, found)))
    kept = [at for at in found if at.size >= fewest]
    if len(kept) < len(found):
        notes.append(f"{len(found) - len(kept)} stretches of fewer than {fewest} good rows are left out")
    if (steps := np.diff(columns["t"][kept[0]])).size:
        usual = float(np.median(steps))
        if np.percentile(np.abs(steps - usual), 90) > 0.01 * usual:
            notes.append(f"stamps are uneven, {usual:.4g} s apart as a rule; they are kept as they are")
    return [stretch(columns, at) for at in kept]


def _recording(part: dict[str, FloatArray], metadata: Mapping[str, Any], name: str, number: int) -> Recording:
    t, u, y = part["t"] - part["t"][0], part["u"], part["y"]
    extra = {key: values for key, values in part.items() if key not in ("t", "u", "y")}
    return Recording(
        t=t, u=u, y=y, extra=MappingProxyType(extra), metadata=MappingProxyType(dict(metadata)),
        name=name if number == 0 else f"{name} stretch {number + 1}",
    )  # fmt: skip


def _units(table: Table, roles: Roles) -> dict[str, str]:
    units = {role: table.units.get(name, "") for role, name in vars(roles.names).items() if name and role != "t"}
    units |= {table.bare(name): table.units.get(name, "") for name in roles.others}
    return {name: unit for name, unit in units.items() if unit}


def _origin(path: Path, table: Table, roles: Roles, stamp: StampForm) -> dict[str, Any]:
    columns = {role: name for role, name in vars(roles.names).items() if name}
    return {"name": path.name, "columns": columns, "form": table.form, "stamps": stamp.text}


def _said(table: Table, roles: Roles, stamp: StampForm) -> str:
    names = {role: name for role, name in vars(roles.names).items() if name and role != "t"}
    taken = ", ".join(f"{role} = {table.described(name)}" for role, name in names.items())
    time = " + ".join(roles.time)
    open_order = "" if stamp.sure else " (day and month could be the other way round: --time-format)"
    return f"{table.form}; t = {time}, {stamp.text}{open_order}; {taken}"
