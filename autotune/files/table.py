"""A table as it lies in a file: names, units, and its columns, read when they are asked for."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from autotune.errors import InputError
from autotune.files.cells import Cells


@dataclass(frozen=True, kw_only=True)
class FileForm:
    """What is known, or to be found out (None), of how a file is written.

    Attributes
    ----------
    delimiter : str, optional
        Between the cells of a text file; a blank stands for any white space.
    decimal : str, optional
        Decimal mark, "." or ",".
    encoding : str, optional
        Character encoding of a text file.
    skip_rows : int, optional
        Lines above the header.
    time_format : str, optional
        strptime format of the stamps.
    time_unit_s : float, optional
        Seconds in one unit of numeric stamps.
    empty_unchanged : bool, optional
        An empty cell is the value before it (True) or a missing sample.
    quality : str, optional
        Name of a tag's quality column with {tag} in it; "" for none.
    good : tuple of str, optional
        Words or codes of good quality.
    sheet : str, optional
        Sheet of a workbook.
    """

    delimiter: str | None = None
    decimal: str | None = None
    encoding: str | None = None
    skip_rows: int | None = None
    time_format: str | None = None
    time_unit_s: float | None = None
    empty_unchanged: bool | None = None
    quality: str | None = None
    good: tuple[str, ...] | None = None
    sheet: str | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Columns of a file.

    Attributes
    ----------
    path : str
        The file, for messages.
    names : tuple of str
        Of the columns, in the file's order; numbers from 1 where it has no header.
    units, labels : mapping of str to str
        Of the columns that have one: the unit, and all that the header's rows say.
    form : str
        How the file is written, in words.
    decimal : str
        Decimal mark.
    in_seconds : frozenset of str
        Columns that are stamps in seconds since 1970 already.
    sample : mapping of str to Cells
        Beginning and end of each column.
    load : callable
        Returns whole columns by their names.
    """

    path: str
    names: tuple[str, ...]
    units: Mapping[str, str]
    labels: Mapping[str, str]
    form: str
    decimal: str
    in_seconds: frozenset[str]
    sample: Mapping[str, Cells]
    load: Callable[[Sequence[str]], dict[str, Cells]]

    def name_of(self, asked: str) -> str:
        """Return the column that somebody names: in full, without its unit, in other letters, or by its number.

        Raises
        ------
        InputError
            No such column, or several; shows the nearest.
        """
        for same in (lambda name: name == asked, lambda name: self.bare(name).lower() == asked.strip().lower()):
            found = [name for name in self.names if same(name)]
            if len(found) == 1:
                return found[0]
            if found:
                raise InputError(
                    f"more than one column {asked!r}", where=self.path, remedy=f"it has {list_names(found)}"
                )
        if asked.isdigit() and 1 <= int(asked) <= len(self.names):
            return self.names[int(asked) - 1]
        near = difflib.get_close_matches(asked, self.names, n=1, cutoff=0.5)
        shown = f"did you mean {near[0]!r}?" if near else f"it has {list_names(self.names)}"
        raise InputError(f"no column {asked!r}", where=self.path, remedy=shown)

    def bare(self, name: str) -> str:
        """Return a column's name without a unit in brackets behind it."""
        return bare_and_unit(name)[0]

    def described(self, name: str) -> str:
        """Return a column's name with its unit, for a person."""
        unit = self.units.get(name, "")
        return f"{name} [{unit}]" if unit and not bare_and_unit(name)[1] else name


#: units that names of columns end in behind an underscore, as people write them there
_ENDINGS = {"pct": "%", "percent": "%"} | {unit: unit for unit in ("mA", "degC", "degF", "mbar", "bar", "kPa", "rpm")}


def bare_and_unit(name: str) -> tuple[str, str]:
    """Return the name of a column and its unit, in brackets or an underscore behind it; empty where there is none."""
    for left, right in (("[", "]"), ("(", ")"), ("{", "}")):
        if name.endswith(right) and left in name[1:]:
            at = name.rindex(left)
            return name[:at].strip(" _"), name[at + 1 : -1].strip()
    bare, _, ending = name.strip().rpartition("_")
    return (bare, _ENDINGS[ending]) if bare and ending in _ENDINGS else (name.strip(), "")


def list_names(names: Iterable[str], most: int = 8) -> str:
    """Return names for a message, the first few of many.

    Parameters
    ----------
    names : iterable of str
        What is listed.
    most : int
        How many are written out.
    """
    names = list(names)
    return ", ".join(names[:most]) + (f", ... ({len(names)} in all)" if len(names) > most else "")
