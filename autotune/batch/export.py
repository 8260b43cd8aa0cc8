"""Signals of one loop from an export of many: its tags, its interval, and the Parquet file that all loops share."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.batch.settings import ExportSettings, LoopSettings, matches
from autotune.errors import InputError
from autotune.files.cells import Cells
from autotune.files.signal_names import Roles, SignalNames, find_roles
from autotune.files.stamps import seconds
from autotune.files.table import Table, list_names
from autotune.files.table_signals import Signals, signals_of, stamp_form, stamps_of
from autotune.files.text_file import beginning
from autotune.files.workbook import PARQUET, open_table, parquet_table
from autotune.progress import Progress

_BLOCK_BYTES = 16 << 20


def read_export(
    loop: LoopSettings, export: ExportSettings, prepared: Sequence[Path] = ()
) -> tuple[dict[str, FloatArray], BoolArray]:
    """Read the columns of one loop.

    Parameters
    ----------
    loop : LoopSettings
        Its file, tags and interval.
    export : ExportSettings
        What is said of how the file is written.
    prepared : sequence of Path
        What :func:`to_parquet` made of the file, read in its place.

    Returns
    -------
    columns : dict of str to (N,) array
        t in seconds since 1970 (or since the zero of numeric stamps), u, y, and r where there is one, as they are in
        the file; NaN for what is missing, no number, or of bad quality.
    flagged : (N,) array of bool
        Samples of u or y that hold a value and are of bad quality.

    Raises
    ------
    InputError
        No such file or tag, stamps that cannot be read.
    """
    paths = list(prepared) or matches(Path(loop.file))
    if not paths:
        raise InputError("no such file", where=loop.file, remedy="check the key file of the loop")
    together = paths[0].suffix.lower() in PARQUET
    tables = [parquet_table(paths)] if together else [open_table(path, export.form()) for path in paths]
    read = [_signals(table, loop, export) for table in tables]
    names = [name for name in ("t", "u", "y", "r") if all(name in signals.columns for signals in read)]
    columns = {name: np.concatenate([signals.columns[name] for signals in read]) for name in names}
    return columns, np.concatenate([signals.flagged for signals in read])


def _signals(table: Table, loop: LoopSettings, export: ExportSettings) -> Signals:
    found = _roles(table, loop, export)
    form = export.form()
    signals = signals_of(table, found, form)
    if not (loop.start or loop.end):
        return signals
    t = signals.columns["t"]
    keep = np.ones(t.size, dtype=np.bool_)
    for stamp, outside in ((loop.start, np.less), (loop.end, np.greater_equal)):
        if stamp:
            limit = seconds([stamp], signals.stamp, f"start or end of {loop.name}")[0]
            keep &= ~outside(t, limit)
    columns = {name: values[keep] for name, values in signals.columns.items()}
    return Signals(columns=columns, flagged=signals.flagged[keep], stamp=signals.stamp, notes=signals.notes)


def _roles(table: Table, loop: LoopSettings, export: ExportSettings) -> Roles:
    """Return the columns that the loop names; the others as they are found out, where only one choice fits."""
    r = loop.r or ("r" if "r" in table.names else "")
    usual = {"u": "u", "y": "y"}
    said = {key: getattr(loop, key) for key in ("u", "y") if getattr(loop, key) != usual[key] or key in table.names}
    found = find_roles(table, SignalNames(t=export.time, r=r, **said))
    if found.unsure:
        raise InputError(
            f"which column is {' and '.join(found.unsure)} is not sure; it has {list_names(table.names)}",
            where=table.path,
            remedy="name them with u and y of the loop, and time in [export]",
        )
    return Roles(time=found.time, names=found.names, unsure=(), others=())


def to_parquet(path: Path, out: Path, wanted: Sequence[str], export: ExportSettings, advance: Progress) -> None:
    """Turn a text export into Parquet, block by block, so that each loop reads its own columns only.

    Parameters
    ----------
    path : Path
        The export.
    out : Path
        File to write; it appears when it is complete.
    wanted : sequence of str
        Columns that some loop needs; the others are left behind.
    export : ExportSettings
        What is said of how the export is written. Stamps are written as timestamps, all other cells as the text they
        are, with a decimal point.
    advance : callable
        Told the file and the share of it that has been read.

    Raises
    ------
    InputError
        A column that is not there, a line of another length than the header, stamps that cannot be read.
    """
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    table, options = _head(path, export)
    time = table.name_of(export.time) if export.time else find_roles(table, SignalNames()).time
    time = (time,) if isinstance(time, str) else time
    if not time:
        raise InputError("no column of time stamps is found", where=str(path), remedy="name it with time in [export]")
    stamp = stamp_form(table, time, export.form())
    kept = [name for name in wanted if name in table.names and name not in time]
    read, parse, convert = options([*time, *kept])
    part, size = out.with_name(f".part-{out.stem}"), max(path.stat().st_size, 1)
    try:
        with path.open("rb") as file, pyarrow.csv.open_csv(file, read, parse, convert) as reader:
            fields = [pa.field(time[0], pa.timestamp("us")), *(pa.field(name, pa.string()) for name in kept)]
            with pyarrow.parquet.ParquetWriter(part, pa.schema(fields), compression="zstd") as writer:
                for batch in reader:
                    cells: Mapping[str, Cells] = {name: _texts(batch.column(name)) for name in time}
                    micro = np.rint(1e6 * stamps_of(table, time, cells, stamp))
                    stamps = pa.array(micro, from_pandas=True).cast(pa.int64()).cast(pa.timestamp("us"))
                    columns = [stamps, *(_with_decimal_point(batch.column(name), table.decimal) for name in kept)]
                    writer.write_table(pa.Table.from_arrays(columns, schema=pa.schema(fields)))
                    advance(path.name, file.tell() / size)
        with part.open("rb+") as written:
            os.fsync(written.fileno())
        part.replace(out)
    except pa.ArrowInvalid as error:
        said = str(error).strip().splitlines()[0]
        raise InputError(said, where=str(path), remedy="correct the line, or leave the file out") from None
    finally:
        part.unlink(missing_ok=True)


def _head(path: Path, export: ExportSettings) -> tuple[Table, Callable[[Sequence[str]], tuple[Any, Any, Any]]]:
    """Return an export's beginning as a table, and how pyarrow is to read some of its columns, every cell as text."""
    import pyarrow as pa
    import pyarrow.csv

    from autotune.files.text_file import table_of

    layout, encoding = beginning(path, export.form())
    table = table_of(path, layout, encoding, export.form())

    def options(columns: Sequence[str]) -> tuple[Any, Any, Any]:
        return (
            pyarrow.csv.ReadOptions(
                encoding="utf8" if encoding == "utf-8" else encoding,
                skip_rows=layout.skip,
                block_size=_BLOCK_BYTES,
                column_names=list(layout.header.names),
            ),
            pyarrow.csv.ParseOptions(delimiter=layout.delimiter),
            pyarrow.csv.ConvertOptions(
                column_types=dict.fromkeys(columns, pa.string()),
                include_columns=list(columns),
                strings_can_be_null=True,
                null_values=[""],
            ),
        )  # fmt: skip

    return table, options


def _texts(column: Any) -> list[str]:
    return ["" if cell is None else cell for cell in column.to_pylist()]


def _with_decimal_point(column: Any, decimal: str) -> Any:
    """Return numbers with a decimal point; a Parquet file no longer says which mark its text has."""
    import pyarrow.compute as pc

    if decimal == ".":
        return column
    plain = r"^\s*([+-]?\d+),(\d*(?:[eE][+-]?\d+)?)\s*$"
    return pc.replace_substring_regex(column, plain, r"\1.\2")
