"""Where a table begins in a file, and what its header's rows say: names, units, types, descriptions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from autotune.files.cells import is_number
from autotune.files.stamps import UNITS_S, looks_like_date
from autotune.files.table import bare_and_unit

#: Rows of one header at most: group, name, description, type, unit.
_MOST_HEADER_ROWS = 5


def words(text: str) -> set[str]:
    """Return the words of a text, for vocabularies."""
    return set(text.split())


_UNITS = {*UNITS_S, "n m", "grad c"} | words(
    "% °c c degc °f degf k v mv kv a ma w kw mw n kn nm pa kpa mpa hpa bar mbar psi m mm cm km µm l l/s l/min l/h m3 m³"
    " m3/h m³/h kg g kg/h kg/s t/h rad deg ° rad/s rpm 1/min u/min hz khz m/s mm/s m/s2 m/s² ph ppm - 1 ohm j kj kwh"
    " nl/min sccm lpm gpm dd.mm.yyyy counts digits steps volt volts ampere celsius percent grad"
)
_TYPES = words(
    "bool byte word dword int sint dint lint uint usint udint real lreal float double float32 float64 int16 int32"
    " uint16 uint32 time ltime date_and_time dt string single bit16 bit32"
)


@dataclass(frozen=True, kw_only=True)
class Header:
    """What stands above the data.

    Attributes
    ----------
    first_row : int
        Row of the first data, counted from 0.
    names : tuple of str
        One for each column, each only once.
    units, labels : dict of str to str
        By name, of the columns that have them.
    rows : int
        How many rows the header has; 0 where the names are made up.
    """

    first_row: int
    names: tuple[str, ...]
    units: dict[str, str]
    labels: dict[str, str]
    rows: int


def read_header(rows: Sequence[Sequence[str]], header_at: int | None = None) -> Header | None:
    """Find header and data.

    Parameters
    ----------
    rows : sequence of sequence of str
        Beginning of the file, cells stripped.
    header_at : int, optional
        Row of the header, where it is known.

    Returns
    -------
    Header or None
        None where nothing looks like data.
    """
    begin = 0 if header_at is None else header_at + 1
    first = next((i for i in range(begin, len(rows)) if all(map(_is_data, rows[i : i + 3])) and rows[i]), None)
    if first is None:
        return None
    width = Counter(len(row) for row in rows[first : first + 50]).most_common(1)[0][0]
    above: list[list[str]] = []
    for row in reversed(rows[max(first - _MOST_HEADER_ROWS, 0 if header_at is None else header_at) : first]):
        if abs(len(row) - width) > 1 or (width > 1 and sum(map(bool, row)) < min(2, width - 1)):
            break
        if _is_data(row):
            break
        above.insert(0, [*row, *[""] * (width - len(row))][:width])
    return _name_columns(above, first, width)


def _is_data(row: Sequence[str]) -> bool:
    """Return whether half of a row's cells are numbers or stamps, and one beyond the first is a number."""
    filled = [cell for cell in row if cell]
    if len(filled) < 2:
        return bool(filled) and len(row) > 1 and (is_number(filled[0]) or looks_like_date(filled[0]))
    values = sum(is_number(cell) for cell in filled)
    stamps = sum(looks_like_date(cell) for cell in filled if not is_number(cell))
    return 2 * (values + stamps) >= len(filled) and (values > 0 or stamps > 0)


def _name_columns(above: Sequence[Sequence[str]], first: int, width: int) -> Header:
    kinds = [_kind(row) for row in above]
    texts = [row for row, kind in zip(above, kinds, strict=True) if kind == "names"]
    if not texts and above:  # one row whose names look like units, such as t,u,y
        texts, kinds = [above[0]], ["names", *kinds[1:]]
    chosen = next((row for row in texts if len(set(filter(None, row))) == sum(map(bool, row)) >= width - 1), None)
    if chosen is None and texts:  # groups above names: both together tell the columns apart
        chosen = [".".join(filter(None, dict.fromkeys(cells))) for cells in zip(*map(_fill_groups, texts), strict=True)]
    names = _unique([name or str(i) for i, name in enumerate(chosen or [""] * width, start=1)])
    units = {name: unit for name in names if (unit := bare_and_unit(name)[1])}
    for row, kind in zip(above, kinds, strict=True):
        if kind == "units":
            found = {name: cell.strip("[]() ") for name, cell in zip(names, row, strict=True)}
            units |= {name: unit for name, unit in found.items() if unit and unit.lower() not in _TYPES}
    labels = {name: " ".join(filter(None, cells)) for name, *cells in zip(names, *texts, strict=True)}
    return Header(first_row=first, names=tuple(names), units=units, labels=labels, rows=len(above))


def _fill_groups(row: Sequence[str]) -> list[str]:
    """Return a row of groups with each empty cell as the one before it, as merged cells are written."""
    filled: list[str] = []
    for cell in row:
        filled.append(cell or (filled[-1] if filled else ""))
    return filled if sum(map(bool, row)) > 1 else list(row)


def _kind(row: Sequence[str]) -> str:
    words = [cell.strip("[](){} ").lower() for cell in row if cell]
    if not words:
        return "empty"
    bracketed = sum(cell[:1] in "[({" and cell[-1:] in "])}" for cell in row if cell)
    if sum(word in _TYPES for word in words) > 0.5 * len(words) and any(word not in ("time", "t") for word in words):
        return "types"
    if bracketed == len(words) or sum(word in _UNITS for word in words) >= max(1.0, 0.6 * len(words)):
        return "units"
    return "names"


def _unique(names: Sequence[str]) -> list[str]:
    """Return the names with a number behind those that were there before."""
    seen: Counter[str] = Counter()
    unique = []
    for name in names:
        seen[name] += 1
        unique.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return unique
