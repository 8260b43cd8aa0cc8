"""Recordings of one loop, fit to be analysed: units applied, cut where stamps or samples fail for long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.batch.export import read_export
from autotune.batch.settings import CampaignSettings, ExportSettings, LoopSettings
from autotune.errors import InputError
from autotune.recording import Recording, read_recording

#: A gap this many usual steps long cuts a record, unless the campaign says otherwise.
_LONGEST_GAP_STEPS = 10.0
#: Fewer rows in one piece tell no method anything.
_FEWEST_ROWS = 60


@dataclass(frozen=True, kw_only=True, eq=False)
class Record:
    """What a file holds of a loop.

    Attributes
    ----------
    pieces : tuple of Recording
        Uninterrupted stretches in the order of time, in engineering units, t from the record's first row on.
    rows : int
        Rows of the file, within the loop's interval.
    bad : int
        Rows whose u or y is missing, no number, or of bad quality.
    notes : tuple of str
        What was corrected or left out.
    """

    pieces: tuple[Recording, ...]
    rows: int
    bad: int
    notes: tuple[str, ...]


def read_record(loop: LoopSettings, settings: CampaignSettings, prepared: Sequence[Path] = ()) -> Record:
    """Read the record of a loop and cut it into pieces.

    Parameters
    ----------
    loop, settings : LoopSettings, CampaignSettings
        What to read and how.
    prepared : sequence of Path
        Parquet files that stand for the loop's export.

    Returns
    -------
    Record
        At least one piece.

    Raises
    ------
    InputError
        Nothing that can be read, or no piece of 60 rows.

    Notes
    -----
    A row without a usable command is left out: the command before it is taken as held. So is a row without a usable y
    where the command stays as it was; where it changes, the row stays, with NaN. Where stamps go back (a clock set to
    winter time) the record is cut, so no row is put out of its order.
    """
    metadata: Mapping[str, Any] = MappingProxyType({})
    notes: list[str] = []
    if settings.export is None and loop.file.endswith(".csv"):
        recording = read_recording(loop.file)
        columns = {"t": recording.t, "u": recording[loop.u], "y": recording[loop.y], **recording.extra}
        if loop.r:
            columns["r"] = recording[loop.r]
        metadata = recording.metadata
    else:
        columns, flagged = read_export(loop, settings.export or ExportSettings(), prepared)
        if flagged.any():
            notes.append(f"{int(flagged.sum())} rows are flagged as bad")
    for signal, scale, offset in (
        ("u", loop.u_scale, loop.u_offset),
        ("y", loop.y_scale, loop.y_offset),
        ("r", loop.y_scale, loop.y_offset),
    ):
        if signal in columns:
            columns[signal] = scale * columns[signal] + offset
    rows = columns["t"].size
    columns = _stamped(columns, notes)
    good = np.isfinite(columns["u"]) & np.isfinite(columns["y"])
    stretches = _stretches(columns["t"], good, settings.longest_gap_s, notes)
    pieces = tuple(_piece(columns, at, metadata, loop) for at in stretches if at.size >= _FEWEST_ROWS)
    if len(pieces) < len(stretches):
        notes.append(f"{len(stretches) - len(pieces)} pieces of fewer than {_FEWEST_ROWS} good rows are left out")
    if not pieces:
        longest = max(at.size for at in stretches)
        raise InputError(
            f"no stretch of {_FEWEST_ROWS} good rows: the longest of {rows} rows has {longest}",
            where=loop.name,
            remedy="check tags and quality, or raise longest_gap_s",
        )
    return Record(pieces=pieces, rows=rows, bad=int((~good).sum()), notes=tuple(notes))


def _stamped(columns: dict[str, FloatArray], notes: list[str]) -> dict[str, FloatArray]:
    """Leave out rows without a stamp and rows that repeat the stamp before them."""
    stamped = np.isfinite(columns["t"])
    columns = {name: values[stamped] for name, values in columns.items()}
    repeats = np.concatenate([[False], np.diff(columns["t"]) == 0.0])
    for lost, what in ((~stamped, "have no stamp"), (repeats, "repeat the stamp before them")):
        if lost.any():
            notes.append(f"{int(lost.sum())} rows {what} and are left out")
    return {name: values[~repeats] for name, values in columns.items()}


def _stretches(t: FloatArray, good: BoolArray, longest_gap_s: float | None, notes: list[str]) -> list[IntArray]:
    """Return the good rows of each stretch, in which no gap between them is longer and no stamp goes back."""
    at: IntArray = np.flatnonzero(good)
    if at.size < 2:
        return [at]
    back = np.concatenate([[0], np.cumsum(np.diff(t) < 0.0)])
    steps = np.diff(t[at])
    longest = longest_gap_s or _LONGEST_GAP_STEPS * float(np.median(np.abs(steps)))
    goes_back, gap = np.diff(back[at]) > 0, steps > longest
    for cut, what in ((goes_back, "stamps go back"), (gap & ~goes_back, f"a gap is longer than {longest:g} s")):
        if cut.any():
            notes.append(f"cut {int(cut.sum())} times where {what}")
    return np.split(at, np.flatnonzero(goes_back | gap) + 1)


def _piece(columns: dict[str, FloatArray], at: IntArray, metadata: Mapping[str, Any], loop: LoopSettings) -> Recording:
    """Return the rows from the first to the last good one, units applied already."""
    span = slice(int(at[0]), int(at[-1]) + 1)
    t0 = columns["t"][0]
    part = {name: values[span] for name, values in columns.items()}
    part = {name: values[np.isfinite(part["u"])] for name, values in part.items()}
    tells = np.isfinite(part["y"]) | np.concatenate([[True], np.diff(part["u"]) != 0.0])
    part = {name: values[tells] for name, values in part.items()}
    t, u, y = part.pop("t") - t0, part.pop("u"), part.pop("y")
    if "r" in part:
        part["r"] = _held(part["r"])
    name = loop.name if span.start == 0 else f"{loop.name} from t = {t[0]:g} s"
    return Recording(t=t, u=u, y=y, extra=MappingProxyType(part), metadata=metadata, name=name)


def _held(r: FloatArray) -> FloatArray:
    """Return the set-point with the value before each missing one; those at the beginning stay missing."""
    before = np.maximum.accumulate(np.where(np.isfinite(r), np.arange(r.size), 0))
    return np.asarray(r[before])
