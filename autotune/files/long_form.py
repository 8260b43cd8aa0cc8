"""Exports with one row for each sample, its tag beside its value: turned into one column for each tag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.files.cells import Cells
from autotune.files.table import Table

_TAG = {
    "varname",
    "tag",
    "tagname",
    "variable",
    "point",
    "pointname",
    "signal",
    "name",
    "messstelle",
    "item",
    "itemid",
    "metric",
}
_VALUE = {"varvalue", "value", "wert", "val", "messwert", "_value"}
_STAMP = {"timestring", "timestamp", "time", "datetime", "date", "zeit", "zeitstempel", "t", "_time"}
_MOST_TAGS = 500
_LOOKED_AT = 300


def one_column_per_tag(table: Table) -> Table:
    """Return the table as it is, or, where each row is one sample of one tag, with a column for each tag."""
    tag, value, stamp = (_find_column(table, words) for words in (_TAG, _VALUE, _STAMP))
    if not (tag and value and stamp) or len({tag, value, stamp}) < 3:
        return table
    tags = table.sample[tag]
    if isinstance(tags, np.ndarray) or len(set(tags)) > max(0.2 * len(tags), 2):
        return table
    cells = table.load([tag, value, stamp])
    wide = _wide([str(name) for name in cells[tag]], _texts(cells[value]), _texts(cells[stamp]), stamp)
    if len(wide) - 1 > _MOST_TAGS:
        return table
    sample = {name: [*column[:_LOOKED_AT], *column[_LOOKED_AT:][-_LOOKED_AT:]] for name, column in wide.items()}
    return replace(
        table,
        names=tuple(wide),
        units={},
        labels={},
        form=f"{table.form}, one row per sample of {len(wide) - 1} tags",
        in_seconds=frozenset(),
        sample=sample,
        load=lambda wanted: {name: wide[name] for name in wanted},
    )


def _find_column(table: Table, words: set[str]) -> str:
    return next((name for name in table.names if table.bare(name).lower() in words), "")


def _texts(cells: Cells) -> Sequence[str]:
    return [repr(cell) for cell in cells.tolist()] if isinstance(cells, np.ndarray) else cells


def _wide(tags: Sequence[str], values: Sequence[str], stamps: Sequence[str], stamp: str) -> dict[str, list[str]]:
    row_of: dict[str, int] = {}
    for text in stamps:
        row_of.setdefault(text, len(row_of))
    wide = {stamp: list(row_of)} | {tag: [""] * len(row_of) for tag in dict.fromkeys(tags) if tag and tag != stamp}
    for tag, value, text in zip(tags, values, stamps, strict=True):
        if tag in wide and tag != stamp:
            wide[tag][row_of[text]] = value
    return wide
