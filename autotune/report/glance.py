"""All loops of a campaign at one glance: a square each, in groups by area, coloured by what needs attention."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from itertools import groupby

from autotune.batch.row import ATTENTION, Attention, Row
from autotune.text_files import escape_controls

#: Fewer loops are seen at a glance in the tables.
FEWEST = 13
#: Area that all squares take together, and the sides between which one lies [px].
_AREA_PX2, _SIDES_PX = 500_000.0, (5.0, 20.0)


def glance(rows: Sequence[Row], colours: Mapping[Attention, str], titles: Mapping[Attention, str]) -> str:
    """Return a square for each loop as HTML, a link to its row; empty for few loops.

    Parameters
    ----------
    rows : sequence of Row
        In the order of the table of results.
    colours, titles : mapping
        Of each kind of attention.
    """
    if len(rows) < FEWEST:
        return ""
    side = min(max(math.sqrt(_AREA_PX2 / len(rows)), _SIDES_PX[0]), _SIDES_PX[1])
    key = "".join(
        f'<span><i style="background:{colours[kind]}"></i>{html.escape(titles[kind])}</span>'
        for kind in ATTENTION
        if any(row.attention == kind for row in rows)
    )
    # the area in which most of the loops need action comes first
    areas = {area: list(found) for area, found in groupby(sorted(rows, key=lambda row: row.area), lambda row: row.area)}
    ordered = sorted(areas.items(), key=lambda pair: (-_urgency(pair[1]), pair[0]))
    groups = "".join(_group(area, found, colours, named=len(areas) > 1) for area, found in ordered)
    return f'<div class="glance" style="--side:{side:.1f}px"><div class="key">{key}</div><div>{groups}</div></div>'


def identity(row: Row) -> str:
    """Return the id of a loop's row on the page.

    Parameters
    ----------
    row : Row
        Of the loop.
    """
    return f"loop-{row.loop.encode().hex()}"


def _urgency(rows: Sequence[Row]) -> float:
    return sum(row.attention == "act" for row in rows) / len(rows)


def _group(area: str, rows: Sequence[Row], colours: Mapping[Attention, str], *, named: bool) -> str:
    squares = "".join(
        f'<a href="#{identity(row)}" title="{html.escape(escape_controls(_words(row)))}"'
        f' style="background:{colours[row.attention]}"></a>'
        for row in sorted(rows, key=lambda row: row.order)
    )
    name = f"<h3>{html.escape(escape_controls(area)) or 'no area'} ({len(rows)})</h3>" if named else ""
    return f"<section>{name}<div>{squares}</div></section>"


def _words(row: Row) -> str:
    return f"{row.loop}: {row.reason.removeprefix(f'{row.loop}: ') or row.attention}"
