"""Recordings of one loop, fit to be analysed: units applied, cut where stamps or samples fail for long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from autotune.arrays import FloatArray
from autotune.batch.export import read_export
from autotune.batch.settings import CampaignSettings, ExportSettings, LoopSettings, matches
from autotune.errors import InputError
from autotune.files.reading import parts_of
from autotune.recording import Recording, is_own_form, read_recording

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
        What was put right or left out.
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
    files = matches(Path(loop.file))
    if settings.export is None and len(files) == 1 and is_own_form(files[0]):
        recording = read_recording(files[0])
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
    good = np.isfinite(columns["u"]) & np.isfinite(columns["y"])
    t0 = columns["t"][np.isfinite(columns["t"])][:1]
    parts = parts_of(columns, settings.longest_gap_s, notes, loop.name, _FEWEST_ROWS)
    pieces = tuple(_piece(part, float(t0[0]), metadata, loop) for part in parts if _good_rows(part) >= _FEWEST_ROWS)
    if not pieces:
        longest = max(map(_good_rows, parts))
        raise InputError(
            f"no stretch of {_FEWEST_ROWS} good rows: the longest of {rows} rows has {longest}",
            where=loop.name,
            remedy="check tags and quality, or raise longest_gap_s",
        )
    return Record(pieces=pieces, rows=rows, bad=int((~good).sum()), notes=tuple(notes))


def _good_rows(part: Mapping[str, FloatArray]) -> int:
    return int(np.isfinite(part["y"]).sum())


def _piece(part: Mapping[str, FloatArray], t0: float, metadata: Mapping[str, Any], loop: LoopSettings) -> Recording:
    """Return a stretch as a recording, units applied already."""
    t = part["t"] - t0
    extra = {name: values for name, values in part.items() if name not in ("t", "u", "y")}
    name = loop.name if t[0] == 0.0 else f"{loop.name} from t = {t[0]:g} s"
    return Recording(t=t, u=part["u"], y=part["y"], extra=MappingProxyType(extra), metadata=metadata, name=name)
