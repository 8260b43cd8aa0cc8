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
from autotune.files.signal_names import Roles, SignalNames, confirm_roles, find_roles
from autotune.files.stamps import StampForm
from autotune.files.stretches import on_change, on_grid, repair_stamps, stretch, stretches
from autotune.files.table import FileForm, Table, list_names
from autotune.files.table_signals import signals_of
from autotune.files.workbook import open_table
from autotune.recording import Recording, is_own_form, read_recording, read_sidecar
from autotune.text_files import check_path

#: What asks somebody for a column: what for, the file's columns, the best guess.
Ask: TypeAlias = Callable[[str, Sequence[str], str], str]

_ROLE = {"t": "time", "u": "command", "y": "measurement", "r": "set-point"}


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
    path, given, form = check_path(path), names or SignalNames(), form or FileForm()
    if given == SignalNames() and form == FileForm() and is_own_form(path):
        return Reading(recordings=(read_recording(path),), names=SignalNames(t="t", u="u", y="y"))
    table = open_table(path, form)
    roles = _confirm(table, find_roles(table, given), ask)
    signals = signals_of(table, roles, form)
    said, notes = _describe(table, roles, signals.stamp), list(signals.notes)
    metadata = {**read_sidecar(path), "units": _units(table, roles), "file": _origin(path, table, roles, signals.stamp)}
    parts = parts_of(signals.columns, longest_gap_s, notes, str(path))
    recordings = tuple(_recording(part, metadata, str(path), i) for i, part in enumerate(parts))
    return Reading(recordings=recordings, names=roles.names, said=said, notes=tuple(notes))


def _confirm(table: Table, roles: Roles, ask: Ask | None) -> Roles:
    """Ask for what is not sure, or refuse the file with the line that would do."""
    if not roles.unsure:
        return roles
    guess = vars(roles.names)
    if ask is None:
        missing = " and ".join(_ROLE[role] for role in roles.unsure)
        options = " ".join(f'--{role} "{guess[role] or "COLUMN"}"' for role in roles.unsure)
        raise InputError(
            f"which column is the {missing} is not sure; it has {list_names(map(table.described, table.names), 12)}",
            where=table.path,
            remedy=f"name them, for example {options}, or write the project's form with autotune import",
        )
    answers = {role: table.name_of(ask(_ROLE[role], table.names, guess[role])) for role in roles.unsure}
    return confirm_roles(roles, answers)


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
    columns = repair_stamps(columns, notes)
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


def _describe(table: Table, roles: Roles, stamp: StampForm) -> str:
    names = {role: name for role, name in vars(roles.names).items() if name and role != "t"}
    taken = ", ".join(f"{role} = {table.described(name)}" for role, name in names.items())
    time = " + ".join(roles.time)
    open_order = "" if stamp.sure else " (day and month could be the other way round: --time-format)"
    return f"{table.form}; t = {time}, {stamp.text}{open_order}; {taken}"
