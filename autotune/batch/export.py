"""Columns of a historian's export: CSV or Parquet, stamps of any kind, text between the numbers, quality flags."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.dataset
import pyarrow.parquet

from autotune.arrays import BoolArray, FloatArray
from autotune.batch.settings import ExportSettings, LoopSettings, matches
from autotune.errors import InputError

Column: TypeAlias = Any  # pyarrow.ChunkedArray, which has no type information

_NUMBER = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
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
        How the file is written.
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
    names = columns_of(paths[0], export)
    tags = {"u": loop.u, "y": loop.y} | ({"r": loop.r or "r"} if loop.r or "r" in names else {})
    require(names, [export.time, *tags.values()], loop.file)
    flags = {signal: flag for signal, tag in tags.items() if (flag := _flag_of(tag, export)) in names}
    wanted = sorted({export.time, *tags.values(), *flags.values()})
    table = _within(_table(paths, wanted, export, loop.file), loop, export)
    columns = {"t": seconds(table[export.time], export, loop.file)}
    flagged = np.zeros(columns["t"].size, dtype=np.bool_)
    for signal, tag in tags.items():
        values, empty = _numbers(table[tag], export)
        if signal in flags:
            bad = ~_is_good(table[flags[signal]], export) & ~empty
            flagged |= bad & (signal != "r")
            values = np.where(bad, np.nan, values)
        columns[signal] = _held(values, empty) if export.empty == "unchanged" else values
    return columns, flagged


def _flag_of(tag: str, export: ExportSettings) -> str:
    return export.quality.replace("{tag}", tag)


def columns_of(path: Path, export: ExportSettings) -> list[str]:
    """Return the names of a file's columns."""
    try:
        if path.suffix == ".parquet":
            return list(pyarrow.parquet.read_schema(path).names)
        read, parse, _ = _csv_options(export)
        with pyarrow.csv.open_csv(path, read_options=read, parse_options=parse) as reader:
            return list(reader.schema.names)
    except (pa.ArrowInvalid, UnicodeError) as error:
        raise InputError(_first_line(error), where=str(path), remedy="check [export]: delimiter, encoding") from None


def require(names: Sequence[str], wanted: Iterable[str], where: str) -> None:
    """Refuse a file that lacks one of the columns, or has it twice; names the nearest."""
    for name in wanted:
        if names.count(name) == 1:
            continue
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
        shown = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(names[:8])}{', ...' * (len(names) > 8)}"
        what = "no column" if name not in names else "more than one column"
        raise InputError(f"{what} {name!r}", where=where, remedy=shown)


def _csv_options(export: ExportSettings, wanted: Sequence[str] | None = None) -> tuple[Any, Any, Any]:
    """Return how pyarrow is to read a CSV file: every cell as text, since one word among numbers would end it."""
    return (
        pyarrow.csv.ReadOptions(encoding=export.encoding, skip_rows=export.skip_rows, block_size=_BLOCK_BYTES),
        pyarrow.csv.ParseOptions(delimiter=export.delimiter),
        pyarrow.csv.ConvertOptions(
            column_types=dict.fromkeys(wanted or (), pa.string()),
            include_columns=list(wanted or ()),
            strings_can_be_null=True,
            null_values=[""],
        ),
    )


def _table(paths: Sequence[Path], wanted: Sequence[str], export: ExportSettings, where: str) -> Any:
    try:
        if paths[0].suffix == ".parquet":
            return pyarrow.dataset.dataset([str(path) for path in paths], format="parquet").to_table(columns=wanted)
        read, parse, convert = _csv_options(export, wanted)
        return pa.concat_tables(pyarrow.csv.read_csv(path, read, parse, convert) for path in paths)
    except (pa.ArrowInvalid, pa.ArrowKeyError) as error:
        raise InputError(_first_line(error), where=where, remedy="correct the line, or leave the file out") from None


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]


def _within(table: Any, loop: LoopSettings, export: ExportSettings) -> Any:
    """Return the rows from ``start`` up to, not with, ``end``."""
    if not (loop.start or loop.end):
        return table
    t = seconds(table[export.time], export, loop.file)
    keep = np.ones(t.size, dtype=np.bool_)
    for stamp, outside in ((loop.start, np.less), (loop.end, np.greater_equal)):
        if stamp:
            limit = seconds(pa.chunked_array([[stamp]]), export, f"start or end of {loop.name}")[0]
            keep &= ~outside(t, limit)
    return table.filter(pa.array(keep))


def seconds(column: Column, export: ExportSettings, where: str) -> FloatArray:
    """Return stamps in seconds: since 1970 for dates, since their own zero for numbers; NaN for empty ones.

    Raises
    ------
    InputError
        A stamp that is neither; shows it.
    """
    try:
        if _is_number(column.type):
            return np.asarray(_float(column) * export.time_unit_s)
        if pa.types.is_timestamp(column.type) or pa.types.is_date(column.type):
            return _since_1970(column)
        text = pc.utf8_trim_whitespace(_text(column))
        if export.time_format is not None:
            return _strptime(text, export.time_format)
        number = pc.match_substring_regex(text, _NUMBER)
        if pc.all(number).as_py():
            return np.asarray(_float(pc.cast(text, pa.float64())) * export.time_unit_s)
        return _iso_8601(text)
    except pa.ArrowInvalid as error:
        raise InputError(
            f"the stamps of column {export.time!r} cannot be read ({_first_line(error)})",
            where=where,
            remedy="set export.time_format to their form, for example %d.%m.%Y %H:%M:%S",
        ) from None


def _strptime(text: Column, form: str) -> FloatArray:
    """Return seconds since 1970; fractions of a second, which pyarrow does not parse, are taken off first."""
    fraction: float | FloatArray = 0.0
    if form.endswith("%f"):
        mark, form = form[-3], form[:-3]
        parts = pc.extract_regex(text, rf"^(?P<whole>.*)[{mark}](?P<fraction>\d+)$")
        fraction = _float(pc.cast(pc.binary_join_element_wise("0", pc.struct_field(parts, "fraction"), "."), "double"))
        text = pc.struct_field(parts, "whole")
    return np.asarray(_since_1970(pc.strptime(text, format=form, unit="us")) + fraction)


def _iso_8601(text: Column) -> FloatArray:
    try:
        return _since_1970(pc.cast(text, pa.timestamp("us", "UTC")))
    except pa.ArrowInvalid:  # stamps without a zone
        return _since_1970(pc.cast(text, pa.timestamp("us")))


def _since_1970(column: Column) -> FloatArray:
    zone = column.type.tz if pa.types.is_timestamp(column.type) else None
    return np.asarray(1e-6 * _float(pc.cast(pc.cast(column, pa.timestamp("us", zone)), pa.int64())))


def _is_number(kind: Any) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind))


def _text(column: Column) -> Column:
    if pa.types.is_dictionary(column.type):
        column = pc.cast(column, column.type.value_type)
    return pc.cast(column, pa.string())


def _float(column: Column) -> FloatArray:
    return np.asarray(pc.cast(column, pa.float64(), safe=False).to_numpy(), dtype=np.float64)


def _numbers(column: Column, export: ExportSettings) -> tuple[FloatArray, BoolArray]:
    """Return the values, NaN for text that is no number, and which cells are empty."""
    if _is_number(column.type) or pa.types.is_boolean(column.type):
        return _float(column), np.asarray(column.is_null().to_numpy())
    text = pc.utf8_trim_whitespace(_text(column))
    empty = pc.fill_null(pc.equal(text, ""), True).to_numpy()
    if export.decimal == ",":
        text = pc.replace_substring(text, ",", ".")
    text = pc.if_else(pc.match_substring_regex(text, _NUMBER), text, pa.scalar(None, pa.string()))
    return _float(pc.cast(text, pa.float64())), np.asarray(empty)


def _is_good(column: Column, export: ExportSettings) -> BoolArray:
    """Return which flags are good; an empty one says nothing against its sample."""
    words = {word.lower() for word in export.good}
    if _is_number(column.type):
        codes = [float(word) for word in words if word.replace(".", "", 1).isdigit()]
        flags = _float(column)
        return np.asarray(np.isin(flags, codes) | np.isnan(flags))
    text = pc.utf8_lower(pc.utf8_trim_whitespace(_text(column)))
    good = pc.or_(pc.is_in(text, value_set=pa.array([*sorted(words), ""])), pc.is_null(text))
    return np.asarray(good.to_numpy())


def _held(values: FloatArray, empty: BoolArray) -> FloatArray:
    """Return the values with each empty cell as the one before it, bad or not."""
    before = np.maximum.accumulate(np.where(empty, 0, np.arange(values.size)))
    return np.asarray(values[before])


def to_parquet(
    path: Path, out: Path, wanted: Sequence[str], export: ExportSettings, advance: Callable[[float], None]
) -> None:
    """Turn a CSV export into Parquet, block by block, so that each loop reads its own columns only.

    Parameters
    ----------
    path : Path
        The export.
    out : Path
        File to write; it appears when it is complete.
    wanted : sequence of str
        Columns that some loop needs; the others are left behind.
    export : ExportSettings
        How the export is written. Stamps are written as timestamps, all other cells as the text they are.
    advance : callable
        Told the share of the file that has been read.

    Raises
    ------
    InputError
        A column that is not there, a line of another length than the header, stamps that cannot be read.
    """
    names = columns_of(path, export)
    require(names, [export.time], str(path))
    wanted = [export.time, *(name for name in wanted if name in names and name != export.time)]
    read, parse, convert = _csv_options(export, wanted)
    part, size = out.with_suffix(".part"), max(path.stat().st_size, 1)
    try:
        with path.open("rb") as file, pyarrow.csv.open_csv(file, read, parse, convert) as reader:
            fields = [pa.field(name, pa.timestamp("us") if name == export.time else pa.string()) for name in wanted]
            with pyarrow.parquet.ParquetWriter(part, pa.schema(fields), compression="zstd") as writer:
                for batch in reader:
                    table = pa.Table.from_batches([batch])
                    stamps = np.rint(1e6 * seconds(table[export.time], export, str(path)))
                    micro = pa.array(stamps, from_pandas=True).cast(pa.int64()).cast(pa.timestamp("us"))
                    writer.write_table(table.set_column(0, fields[0], micro))
                    advance(file.tell() / size)
    except pa.ArrowInvalid as error:
        raise InputError(
            _first_line(error), where=str(path), remedy="correct the line, or leave the file out"
        ) from None
    part.replace(out)
