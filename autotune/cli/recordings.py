"""Recordings that somebody names on the command line: which column is what, and what was made of the file."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from autotune.cli import app

if TYPE_CHECKING:
    from autotune.files import Reading, SignalNames
    from autotune.files.table import FileForm
    from autotune.recording import Recording

#: Options of every command that reads recordings.
T: TypeAlias = Annotated[str | None, typer.Option("--t", metavar="COLUMN", help="the file's column of time stamps")]
U: TypeAlias = Annotated[str | None, typer.Option("--u", metavar="COLUMN", help="the file's column of the command")]
Y: TypeAlias = Annotated[str | None, typer.Option("--y", metavar="COLUMN", help="the file's column of the measurement")]
R: TypeAlias = Annotated[str | None, typer.Option("--r", metavar="COLUMN", help="the file's column of the set-point")]


def signal_names(t: str | None, u: str | None, y: str | None, r: str | None) -> SignalNames:
    """Return the columns that the options name.

    Parameters
    ----------
    t, u, y, r : str or None
        Time, command, measurement and set-point; None where the file's own names say it.
    """
    from autotune.files import SignalNames

    return SignalNames(t=t or "", u=u or "", y=y or "", r=r or "")


def read_all(paths: Iterable[Path], names: SignalNames) -> list[Recording]:
    """Return the recordings of all files, each uninterrupted stretch one, and say how the files were read.

    Parameters
    ----------
    paths : iterable of Path
        The files.
    names : SignalNames
        Which column is which.

    Raises
    ------
    InputError
        A file that is no recording, or units that differ.
    """
    from autotune.recorded_units import require_units_of_each_other
    from autotune.recording import usable

    recordings = [usable(recording) for path in paths for recording in _read(path, names).recordings]
    require_units_of_each_other(recordings)
    return recordings


def read_one(path: Path, names: SignalNames, *, moving: bool = True) -> Recording:
    """Return the recording of a file, its longest stretch where it has several, and say how it was read.

    A y that does not move is refused, unless ``moving`` is false.

    Parameters
    ----------
    path : Path
        The file.
    names : SignalNames
        Which column is which.
    moving : bool
        Whether a y that does not move is refused.

    Raises
    ------
    InputError
        The file is no recording.
    """
    from autotune.recording import usable

    reading = _read(path, names)
    if len(reading.recordings) > 1:
        first = reading.longest.t[0], reading.longest.t[-1]
        _say(f"{path}: the longest of {len(reading.recordings)} stretches is used, {first[1] - first[0]:.6g} s")
    return usable(reading.longest, moving=moving)


def _read(path: Path, names: SignalNames, form: FileForm | None = None, gap_s: float | None = None) -> Reading:
    from autotune.files import read_recordings

    asks = sys.stdin.isatty() and sys.stderr.isatty()
    reading = read_recordings(path, names, form=form, ask=_ask if asks else None, longest_gap_s=gap_s)
    for line in (reading.said, *reading.notes):
        if line:
            _say(f"{path}: {line}")
    return reading


def _say(line: str) -> None:
    typer.echo(line, err=True)


def _ask(role: str, columns: Sequence[str], guess: str) -> str:
    _say(f"columns: {', '.join(columns)}")
    return str(typer.prompt(f"which column is the {role}", default=guess or None, err=True))


@app.command("import")
def import_file(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="text of any delimiter, Excel, OpenDocument, Parquet, MATLAB, HDF5 or MDF"),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="REC.csv", help="recording to write; default the file's name with _recording")
    ] = None,
    t: T = None,
    u: U = None,
    y: Y = None,
    r: R = None,
    sheet: Annotated[str | None, typer.Option(help="sheet of a workbook; default the one with most rows")] = None,
    delimiter: Annotated[str | None, typer.Option(help="between the cells; found out when absent")] = None,
    decimal: Annotated[str | None, typer.Option(help="decimal mark, . or ,; found out when absent")] = None,
    encoding: Annotated[str | None, typer.Option(help="such as cp1252; found out when absent")] = None,
    time_format: Annotated[
        str | None, typer.Option(help="strptime format of the stamps; found out when absent")
    ] = None,
    time_unit: Annotated[float | None, typer.Option(min=1e-9, help="seconds in one unit of numeric stamps")] = None,
    gap: Annotated[
        float | None, typer.Option(min=0.0, help="a longer gap cuts the record [s]; ten usual steps when absent")
    ] = None,
) -> None:
    """Turn a file as engineers have it into recordings of the project's form, with a sidecar that says how."""
    from dataclasses import replace

    from autotune.errors import InputError
    from autotune.files.table import FileForm
    from autotune.outputs import OutputFolder
    from autotune.recording import write_recording

    if decimal not in (None, ".", ","):
        raise InputError(f"decimal mark {decimal!r}", where="--decimal", remedy="give . or ,")
    form = FileForm(
        delimiter={"tab": "\t", "\\t": "\t"}.get(delimiter or "", delimiter), decimal=decimal, encoding=encoding,
        time_format=time_format, time_unit_s=time_unit, sheet=sheet,
    )  # fmt: skip
    reading = _read(file, signal_names(t, u, y, r), form, gap)
    first = out or Path(f"{file.stem}_recording.csv")
    paths = [first, *(first.with_stem(f"{first.stem}_{i}") for i in range(2, len(reading.recordings) + 1))]
    names = [name for path in paths for name in (path.name, path.with_suffix(".toml").name)]
    with OutputFolder(first.parent, names, inputs=(file,)).write_all() as folder:
        for path, recording in zip(paths, reading.recordings, strict=True):
            kept = replace(recording, metadata={**recording.metadata, "notes": list(reading.notes)})
            write_recording(kept, folder / path.name)
    for path, one in zip(paths, reading.recordings, strict=True):
        typer.echo(f"wrote {path}: {len(one)} rows, {one.duration_s:.6g} s, {one.sample_time_s:.6g} s apart")
    typer.echo(f"now: autotune tune {' '.join(map(str, paths))} --out DIR")
