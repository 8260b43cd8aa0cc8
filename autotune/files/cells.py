"""Cells of a table as numbers: decimal marks, thousands, words between the numbers, quality flags."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np

from autotune.arrays import BoolArray, FloatArray

#: A column as it lies in the file: text, or numbers where the file has numbers.
Cells: TypeAlias = Sequence[str] | FloatArray

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_COMMA_NUMBER = re.compile(r"[+-]?(\d{1,3}(\.\d{3})+|\d+),\d*([eE][+-]?\d+)?")
_COMMA_THOUSANDS = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d+")
_POINT_THOUSANDS = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d*")
#: What historians write for a sample that is good; anything else is a bad one.
GOOD = ("good", "192", "gut", "ok", "valid", "goodnonspecific")
_BAD = ("bad", "0", "uncertain", "64", "schlecht", "invalid", "error", "questionable", "comm fail", "badnonspecific")


def decimal_mark(cells: Iterable[str]) -> str:
    """Return the decimal mark of cells, "." or ",": a comma where numbers have one that does not part thousands."""
    cells = list(cells)
    if any(_COMMA_THOUSANDS.fullmatch(cell) for cell in cells):
        return "."
    return "," if any(_COMMA_NUMBER.fullmatch(cell) for cell in cells) else "."


def is_number(cell: str) -> bool:
    """Return whether a cell is a number under either decimal mark."""
    return bool(NUMBER.fullmatch(cell) or _COMMA_NUMBER.fullmatch(cell) or _COMMA_THOUSANDS.fullmatch(cell))


def numbers(cells: Cells, decimal: str = ".") -> tuple[FloatArray, BoolArray]:
    """Return a column's numbers.

    Parameters
    ----------
    cells : sequence of str, or (N,) array
        The column.
    decimal : str
        Its decimal mark.

    Returns
    -------
    values : (N,) array
        NaN for empty cells and for text that is no finite number.
    empty : (N,) array of bool
        Which cells are empty.
    """
    if isinstance(cells, np.ndarray):
        return np.where(np.isfinite(cells), cells, np.nan), np.isnan(cells)
    text = [cell.strip() for cell in cells]
    empty = np.fromiter((not cell for cell in text), dtype=np.bool_, count=len(text))
    if decimal == ",":
        text = [_with_point(cell) for cell in text]
    return np.fromiter(map(_number, text), dtype=np.float64, count=len(text)), empty


def _with_point(cell: str) -> str:
    if _POINT_THOUSANDS.fullmatch(cell):
        cell = cell.replace(".", "")
    return cell.replace(",", ".")


def _number(cell: str) -> float:
    if NUMBER.fullmatch(cell):
        return float(cell)
    return float(cell.replace(",", "")) if _COMMA_THOUSANDS.fullmatch(cell) else np.nan


def good_samples(cells: Cells, good: Iterable[str] = GOOD) -> BoolArray:
    """Return which flags are good; an empty one says nothing against its sample.

    Parameters
    ----------
    cells : sequence of str, or (N,) array
        A column of flags.
    good : iterable of str
        Flags of good samples, in whatever case.

    Returns
    -------
    (N,) array of bool
        Which are good.
    """
    words = {word.lower() for word in good}
    if isinstance(cells, np.ndarray):
        codes = [float(word) for word in words if NUMBER.fullmatch(word)]
        return np.asarray(np.isin(cells, codes) | np.isnan(cells))
    flags = (cell.strip().lower() for cell in cells)
    return np.fromiter((not flag or flag in words for flag in flags), dtype=np.bool_, count=len(cells))


def are_flags(cells: Cells) -> bool:
    """Return whether a column holds quality flags in words or codes that are known."""
    if isinstance(cells, np.ndarray):
        known = [float(word) for word in (*GOOD, *_BAD) if NUMBER.fullmatch(word)]
        return bool(np.all(np.isin(cells, known) | np.isnan(cells)))
    return {cell.strip().lower() for cell in cells} <= {*GOOD, *_BAD, ""}


def fill_forward(values: FloatArray, missing: BoolArray) -> FloatArray:
    """Return the values with each missing one as the one before it; those at the beginning stay as they are.

    Parameters
    ----------
    values : (N,) array
        A column.
    missing : (N,) array of bool
        Which of them are not known.

    Returns
    -------
    (N,) array
        The column, filled.
    """
    before = np.maximum.accumulate(np.where(missing, 0, np.arange(values.size)))
    return np.asarray(values[before])
