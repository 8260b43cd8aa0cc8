"""Workbooks (Excel, OpenDocument) and Parquet files as tables."""

from __future__ import annotations

import datetime
import re
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from autotune.errors import InputError, require_extra
from autotune.files.cells import Cells
from autotune.files.header import Header, read_header
from autotune.files.long_form import one_column_per_tag
from autotune.files.measurement_file import KINDS as MEASUREMENTS
from autotune.files.measurement_file import measurement_table
from autotune.files.table import FileForm, Table, bare_and_unit, list_names
from autotune.files.text_file import text_table

PARQUET = (".parquet", ".pq")
WORKBOOKS = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods")
_LOOKED_AT = 300
#: Of a workbook: cells of a sheet from its first to its farthest, bytes unpacked.
_MOST_CELLS, _MOST_BYTES = 20_000_000, 1_000_000_000
_REFERENCE = re.compile(rb'<c [^>]{0,80}?r="([A-Z]+)(\d+)"')


def open_table(path: Path, form: FileForm | None = None) -> Table:
    """Open a file of any kind as a table; its kind follows from the ending of its name.

    Parameters
    ----------
    path : Path
        The file.
    form : FileForm, optional
        What is known of how it is written.

    Raises
    ------
    InputError
        It cannot be read, or holds no rows of numbers.
    """
    form = form or FileForm()
    kind = path.suffix.lower()
    if not path.is_file():
        raise InputError("no such file", where=str(path), remedy="check the path")
    if kind in WORKBOOKS:
        return one_column_per_tag(_of_workbook(path, form))
    if kind in MEASUREMENTS:
        return measurement_table(path)
    return one_column_per_tag(parquet_table([path]) if kind in PARQUET else text_table(path, form))


def _of_workbook(path: Path, form: FileForm) -> Table:
    import python_calamine

    _require_bounded(path)
    try:
        book = python_calamine.CalamineWorkbook.from_path(path)
        names = book.sheet_names if form.sheet is None else [form.sheet]
        if form.sheet is not None and form.sheet not in book.sheet_names:
            raise InputError(
                f"no sheet {form.sheet!r}", where=str(path), remedy=f"it has {list_names(book.sheet_names)}"
            )
        sheets = {name: book.get_sheet_by_name(name).to_python() for name in names}
    except InputError:
        raise
    except BaseException as error:  # what is written in Rust panics outside of Exception
        if isinstance(error, KeyboardInterrupt | SystemExit | MemoryError):
            raise
        said = str(error).strip().splitlines()[:1] or [type(error).__name__]
        raise InputError(
            f"cannot be read as a workbook ({said[0]})", where=str(path), remedy="save it as CSV"
        ) from None
    found: dict[str, tuple[Header, list[list[str]]]] = {}
    for name, content in sheets.items():
        rows = [[_as_text(cell) for cell in row] for row in content]
        rows = [row for row in rows if any(row)]
        header = read_header(rows[: 2 * _LOOKED_AT], form.skip_rows)
        if header is not None and len(header.names) > 1:
            found[name] = (header, rows[header.first_row :])
    if not found:
        raise InputError("no sheet holds rows of numbers", where=str(path), remedy="give a sheet with a row of names")
    name = max(found, key=lambda one: len(found[one][1]))
    return _sheet(path, name, *found[name])


def _require_bounded(path: Path) -> None:
    """Refuse a workbook whose sheets would take more memory than a table has: a stray cell far out, a bomb.

    A sheet is held whole, from its first cell to the row and the column of its farthest.
    """
    if not zipfile.is_zipfile(path):
        return
    try:
        _require_bounded_archive(path)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:  # or encrypted
        raise InputError(
            f"cannot be read as a workbook ({error})", where=str(path), remedy="save it as CSV, without a password"
        ) from None


def _require_bounded_archive(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        if sum(part.file_size for part in archive.infolist()) > _MOST_BYTES:
            raise InputError("is larger than 1 GB unpacked", where=str(path), remedy="save the sheet as CSV")
        for part in archive.namelist():
            if part.startswith("xl/worksheets/") and part.endswith(".xml"):
                rows, columns = _extent(archive, part)
                if rows * columns > _MOST_CELLS:
                    raise InputError(
                        f"{part.rpartition('/')[2]} reaches to row {rows} and column {columns}", where=str(path),
                        remedy="delete the stray cell far from the table, or save the table as CSV",
                    )  # fmt: skip


def _extent(archive: zipfile.ZipFile, part: str) -> tuple[int, int]:
    """Return the farthest row and column of a sheet of an Excel workbook."""
    row = column = 0
    kept = b""
    with archive.open(part) as file:
        while block := file.read(1 << 20):
            text = kept + block
            for letters, digits in _REFERENCE.findall(text):
                row = max(row, int(digits[:9]))
                column = max(column, sum(26**i * (code - 64) for i, code in enumerate(reversed(letters[:4]))))
            kept = text[-40:]
    return row, column


def _as_text(cell: Any) -> str:
    """Return a cell as a text file would have it, with a decimal point and stamps of ISO 8601."""
    if isinstance(cell, bool):
        return str(int(cell))
    if isinstance(cell, float):
        return repr(int(cell)) if cell.is_integer() and abs(cell) < 1e15 else repr(cell)
    if isinstance(cell, datetime.datetime):
        return cell.isoformat(sep=" ")
    if isinstance(cell, datetime.timedelta):
        return repr(cell.total_seconds())
    return str(cell).strip()


def _sheet(path: Path, sheet: str, header: Header, rows: Sequence[Sequence[str]]) -> Table:
    def load(wanted: Sequence[str], among: Sequence[Sequence[str]] = rows) -> dict[str, Cells]:
        at = {name: header.names.index(name) for name in wanted}
        return {name: [row[i] if i < len(row) else "" for row in among] for name, i in at.items()}

    sample = load(header.names, [*rows[:_LOOKED_AT], *rows[max(_LOOKED_AT, len(rows) - _LOOKED_AT) :]])
    return Table(
        path=str(path),
        names=tuple(name for name in header.names if any(sample[name]) or not name.isdigit()),
        units=header.units,
        labels=header.labels,
        form=f"sheet {sheet!r}" + (f", {header.rows} header rows" if header.rows > 1 else ""),
        decimal=".",
        in_seconds=frozenset(),
        sample=sample,
        load=load,
    )


def parquet_table(paths: Sequence[Path]) -> Table:
    """Open Parquet files that follow in time as one table.

    Raises
    ------
    InputError
        A file is not Parquet, or the package that reads Parquet is not installed.
    """
    require_extra("parquet", "pyarrow")
    import pyarrow as pa
    import pyarrow.dataset

    try:
        data = pyarrow.dataset.dataset([str(path) for path in paths], format="parquet")
        schema = data.schema
        plain = [field.name for field in schema if not pa.types.is_nested(field.type)]
    except (pa.ArrowInvalid, UnicodeDecodeError, OSError) as error:
        said = str(error).strip().splitlines()[0]
        raise InputError(f"cannot be read ({said})", where=str(paths[0]), remedy="save it as CSV or Parquet") from None
    stamped = {field.name for field in schema if pa.types.is_timestamp(field.type) or pa.types.is_date(field.type)}

    def cells(rows: Callable[[], Any]) -> dict[str, Cells]:
        try:
            table = rows()
            return {name: _cells(column) for name, column in zip(table.column_names, table.columns, strict=True)}
        except (pa.ArrowException, UnicodeDecodeError, OSError) as error:
            said = str(error).strip().splitlines()[0]
            raise InputError(f"cannot be read ({said})", where=str(paths[0]), remedy="write the file anew") from None

    def load(wanted: Sequence[str]) -> dict[str, Cells]:
        return cells(lambda: data.to_table(columns=list(wanted)))

    sample = cells(lambda: data.head(2 * _LOOKED_AT, columns=plain))
    units = {name: unit for name in plain if (unit := bare_and_unit(name)[1])}
    for field in schema:
        if field.metadata and b"unit" in field.metadata:
            units[field.name] = field.metadata[b"unit"].decode(errors="replace")
    return Table(
        path=str(paths[0]), names=tuple(plain), units=units, labels={}, form="Parquet", decimal=".",
        in_seconds=frozenset(stamped), sample=sample, load=load,
    )  # fmt: skip


def _cells(column: Any) -> Cells:
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
        micro = pc.cast(pc.cast(column, pa.timestamp("us", getattr(kind, "tz", None)), safe=False), pa.int64())
        return np.asarray(1e-6 * np.asarray(pc.cast(micro, pa.float64(), safe=False).to_numpy(), dtype=np.float64))
    if (
        pa.types.is_integer(kind)
        or pa.types.is_floating(kind)
        or pa.types.is_decimal(kind)
        or pa.types.is_boolean(kind)
    ):
        if pa.types.is_boolean(kind):
            column = pc.cast(column, pa.int8())
        return np.asarray(pc.cast(column, pa.float64(), safe=False).to_numpy(), dtype=np.float64)
    if pa.types.is_dictionary(kind):
        column = pc.cast(column, kind.value_type)
    return ["" if cell is None else cell for cell in pc.cast(column, pa.string()).to_pylist()]
