"""Text files: their encoding, delimiter, decimal mark and header, found out from their beginning."""

from __future__ import annotations

import codecs
import csv
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from autotune.errors import InputError
from autotune.files.cells import Cells, decimal_mark, is_number
from autotune.files.header import Header, read_header
from autotune.files.table import FileForm, Table

_DELIMITERS = {"\t": "tabs", ";": "semicolons", "|": "bars", ",": "commas", " ": "white space"}
_COMMENT = ("#", "%", "//")
_LOOKED_AT = 300  # lines from the beginning
_MOST_PREAMBLE = 200
_BEGINNING_BYTES = 1 << 20


def text_table(path: Path, form: FileForm) -> Table:
    """Open a text file as a table.

    Parameters
    ----------
    path : Path
        The file.
    form : FileForm
        What is known of it.

    Raises
    ------
    InputError
        It cannot be read, or nothing in it looks like rows of numbers.
    """
    text, encoding = decode(path, form.encoding)
    layout = _layout(path, text.splitlines(), form)
    return table_of(path, layout, encoding, form)


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Where the data of a text file begin, and how its cells are parted.

    Attributes
    ----------
    delimiter : str
        Between the cells.
    header : Header
        What the header says.
    skip : int
        Lines above the first row of data.
    lines : sequence of str
        From there on.
    """

    delimiter: str
    header: Header
    skip: int
    lines: Sequence[str]


def beginning(path: Path, form: FileForm) -> tuple[Layout, str]:
    """Return layout and encoding of a text file too long to be read whole, from its first megabyte.

    Parameters
    ----------
    path : Path
        The file.
    form : FileForm
        What was said of it.
    """
    text, encoding = decode(path, form.encoding, _BEGINNING_BYTES)
    return _layout(path, text.splitlines()[:-1] or text.splitlines(), form), encoding


def _layout(path: Path, lines: Sequence[str], form: FileForm) -> Layout:
    body = [(number, line) for number, line in enumerate(lines[: _MOST_PREAMBLE + _LOOKED_AT]) if line.strip()]
    body = [(number, line) for number, line in body if not line.lstrip().startswith(_COMMENT)]
    tried = [form.delimiter] if form.delimiter else list(_DELIMITERS)
    best: tuple[float, str, Header] | None = None
    for delimiter in tried:
        rows = [_strip(row) for row in split([line for _, line in body], delimiter)]
        found = read_header(rows, form.skip_rows)
        fit = 0.0 if found is None else _consistency(rows[found.first_row :])
        if found is not None and len(found.names) > 1 and (best is None or fit > best[0] + 0.05):
            best = (fit, delimiter, found)
    if best is None:
        raise InputError(
            "no rows of numbers are found in it",
            where=str(path),
            remedy="give a table with a row of names and at least a time, a command and a measurement in columns",
        )
    _, delimiter, header = best
    header = _with_commented_names(lines, body, header, delimiter)
    skip = body[header.first_row][0]
    return Layout(delimiter=delimiter, header=header, skip=skip, lines=lines[skip:])


def decode(path: Path, encoding: str | None = None, most: int = -1) -> tuple[str, str]:
    """Return a file's text and its encoding: what its first bytes say, UTF-8, or else that of Windows.

    Parameters
    ----------
    path : Path
        The file.
    encoding : str, optional
        Its encoding, where that is known.
    most : int
        Longest part that is read [bytes], cut to whole lines; all where negative.

    Raises
    ------
    InputError
        It cannot be read, or there is no such encoding.
    """
    try:
        with path.open("rb") as file:
            content = file.read(most)
        if most > 0 and len(content) == most:
            content = content[: content.rfind(b"\n") + 1]
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy="check the path") from None
    if encoding is None:
        if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            encoding = "utf-16"
        else:
            try:
                return content.decode("utf-8-sig"), "utf-8"
            except UnicodeDecodeError:
                encoding = "cp1252"
    try:
        return content.decode(encoding, errors="replace"), encoding
    except LookupError:
        raise InputError(f"no encoding {encoding!r}", where=str(path), remedy="give utf-8, cp1252 or utf-16") from None


def split(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    """Yield the cells of each line.

    Parameters
    ----------
    lines : iterable of str
        Lines of a file.
    delimiter : str
        Between its cells; a blank stands for any white space.
    """
    if delimiter == " ":
        return (line.split() for line in lines)
    return _cells_of(lines, delimiter)


def _cells_of(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    try:
        yield from csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    except csv.Error as error:
        raise InputError(
            f"a row cannot be parted ({error})", where="text file", remedy="close its quotation marks"
        ) from None


def _strip(row: Sequence[str]) -> list[str]:
    return [cell.strip().strip('"').strip() for cell in row]


def _consistency(rows: Sequence[Sequence[str]]) -> float:
    """Return the share of rows of the usual width, less for cells that are neither number nor word."""
    width, count = Counter(map(len, rows)).most_common(1)[0]
    if width < 2:
        return 0.0
    filled = [cell for row in rows if len(row) == width for cell in row if cell]
    broken = sum(not is_number(cell) and not cell.isprintable() for cell in filled)
    mixed = sum(";" in cell or "\t" in cell for cell in filled)
    return count / len(rows) * (1.0 - (broken + mixed) / max(len(filled), 1))


def _with_commented_names(
    lines: Sequence[str], body: Sequence[tuple[int, str]], header: Header, delimiter: str
) -> Header:
    """Take the names from the comment right above the data where the file has no other header."""
    at = body[header.first_row][0]
    if header.rows or at == 0 or not lines[at - 1].lstrip().startswith(_COMMENT):
        return header
    above = lines[at - 1].lstrip().lstrip("#%/ ")
    rows = [_strip(row) for row in split([above, *[line for _, line in body[header.first_row :]]], delimiter)]
    found = read_header(rows)
    if found is None or found.rows != 1 or len(found.names) != len(header.names):
        return header
    return Header(first_row=header.first_row, names=found.names, units=found.units, labels=found.labels, rows=1)


def table_of(path: Path, layout: Layout, encoding: str, form: FileForm) -> Table:
    """Return the lines of a layout as a table.

    Parameters
    ----------
    path : Path
        The file, for messages.
    layout : Layout
        Its lines, delimiter and header.
    encoding : str
        How it was decoded, for the notes.
    form : FileForm
        What was said of it.
    """
    lines, delimiter, header = layout.lines, layout.delimiter, layout.header
    names = header.names

    def load(wanted: Sequence[str], among: Sequence[str] = lines) -> dict[str, Cells]:
        at = [names.index(name) for name in wanted]
        columns: list[list[str]] = [[] for _ in at]
        data = (line for line in among if line.strip() and not line.lstrip().startswith(_COMMENT))
        for row in split(data, delimiter):
            for column, i in zip(columns, at, strict=True):
                column.append(row[i].strip() if i < len(row) else "")
        return dict(zip(wanted, columns, strict=True))

    ends = [*lines[:_LOOKED_AT], *lines[max(_LOOKED_AT, len(lines) - _LOOKED_AT) :]]
    sample = load(names, ends)
    decimal = form.decimal or decimal_mark(cell for cells in sample.values() for cell in cells)
    empty = {name for name in names if not any(sample[name]) and name.isdigit()}
    said = [_DELIMITERS.get(delimiter, repr(delimiter)) + " between cells"]
    said += ["decimal comma"] if decimal == "," else []
    said += [encoding] if encoding != "utf-8" else []
    said += {0: ["no header"], 1: []}.get(header.rows, [f"{header.rows} header rows"])
    return Table(
        path=str(path),
        names=tuple(name for name in names if name not in empty),
        units=header.units,
        labels=header.labels,
        form=", ".join(said),
        decimal=decimal,
        in_seconds=frozenset(),
        sample=sample,
        load=load,
    )
