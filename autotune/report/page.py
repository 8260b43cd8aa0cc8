"""One self-contained HTML page: sections of sentences, tables and charts; no request leaves the browser."""

from __future__ import annotations

import base64
import functools
import gzip
import html
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.report.chart import Chart, Scatter
from autotune.report.page_shell import CHARTS, SHELL, TABLES
from autotune.text_files import escape_controls
from autotune.whole_files import write_whole

Tone: TypeAlias = Literal["good", "warn", "bad"]

#: Colours told apart in print and by colour-blind readers (Okabe & Ito), legible on white and on black.
BLUE, ORANGE, GREEN, RED, GREY, PURPLE = "#3b82c4", "#d98200", "#0d9a72", "#d1495b", "#8a8a8a", "#a467b0"

#: Rows of a table from which on it can be sorted and filtered.
_MANY = 12


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A curve as small as a word, for a cell of a table.

    Attributes
    ----------
    values : (N,) array
        The curve, evenly spaced; scaled to the cell.
    says : str
        The same in words, for those who do not see it.
    """

    values: FloatArray
    says: str


@dataclass(frozen=True, kw_only=True)
class Anchor:
    """A cell of a table that links lead to.

    Attributes
    ----------
    says : str
        The cell.
    identity : str
        What a link names after its ``#``.
    """

    says: str
    identity: str


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of cells under a header; numbers are formatted by the caller, with their units in the header."""

    header: tuple[str, ...]
    rows: tuple[tuple[str | Picture | Anchor, ...], ...]
    caption: str = ""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A chart with the sentence that says what is to be seen in it; a square one for axes of equal scale."""

    figure: Chart
    caption: str
    height_px: int = 420
    square: bool = False


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading with formulas (MathML), paragraphs, links (what they say, and where to), figures, tables, the method.

    ``details`` and ``detail_tables`` are for those who want to check the method; they are folded away.
    """

    title: str
    text: tuple[str, ...] = ()
    formulas: tuple[str, ...] = ()
    links: tuple[tuple[str, str], ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    details: tuple[str, ...] = ()
    detail_tables: tuple[Table, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Page:
    """A report: the verdict first, then what it rests on.

    Attributes
    ----------
    title : str
        What was examined.
    verdict : str
        The result in one sentence.
    tone : {"good", "warn", "bad"}
        Colour of the verdict; the sentence says the same without it.
    answers : tuple of (str, str)
        What was found, how sure it is, what to do: a heading of a word or three, and a sentence or two.
    drawing : str
        Inline SVG that says where, above the answers.
    summary : tuple of str
        What else the reader needs to know.
    sections : tuple of Section
        The evidence, in the order of the data's way.
    """

    title: str
    verdict: str
    tone: Tone
    answers: tuple[tuple[str, str], ...] = ()
    drawing: str = ""
    summary: tuple[str, ...] = ()
    sections: tuple[Section, ...] = ()


def thin_curve(t: FloatArray, y: FloatArray, points: int = 3000) -> tuple[FloatArray, FloatArray]:
    """Return at most about ``points`` rows that draw the same curve: the extremes of every bin are kept.

    Parameters
    ----------
    t, y : (N,) array
        Curve to draw.
    points : int
        Rows wanted.
    """
    if t.size <= points:
        return t, y
    width = int(np.ceil(2 * t.size / points))
    bins = t.size // width
    folded = np.where(np.isfinite(y), y, 0.0)[: bins * width].reshape(bins, width)
    offset = np.arange(bins)[:, np.newaxis] * width
    keep = np.sort(
        np.concatenate([(offset + np.column_stack([folded.argmin(1), folded.argmax(1)])).ravel(), [0, t.size - 1]])
    )
    keep = np.unique(keep)
    return t[keep], y[keep]


def lines_figure(x_title: str, y_title: str, *, log_x: bool = False, log_y: bool = False) -> Chart:
    """Return an empty chart with titled axes, for traces to be added.

    Parameters
    ----------
    x_title, y_title : str
        With units.
    log_x, log_y : bool
        Whether the axis is logarithmic.
    """
    figure = Chart()
    figure.update_xaxes(title=x_title, type="log" if log_x else "linear")
    figure.update_yaxes(title=y_title, type="log" if log_y else "linear")
    return figure


def add_line(
    figure: Chart,
    x: FloatArray,
    y: FloatArray,
    name: str,
    colour: str,
    *,
    dash: str = "solid",
    width: float = 1.6,
    **place: Any,
) -> None:
    """Add a curve.

    Parameters
    ----------
    figure : Chart
        The chart, changed in place.
    x, y : (N,) array
        The curve, in the axes' units; NaN interrupts it.
    name : str
        In the legend.
    colour : str
        As of CSS.
    dash : str
        As of plotly.
    width : float
        Of the line [px].
    **place : object
        ``row`` and ``col``, and settings of plotly's scatter such as ``showlegend``.
    """
    at = {key: place.pop(key) for key in ("row", "col") if key in place}
    trace = Scatter(x=x, y=y, name=name, mode="lines", line={"color": colour, "dash": dash, "width": width}, **place)
    figure.add_trace(trace, **at)


def write_page(page: Page, path: str | os.PathLike[str]) -> None:
    """Write the page as one HTML file that needs no network.

    Parameters
    ----------
    page : Page
        What to show.
    path : path
        File to write.
    """
    body = [
        f"<h1>{_text(page.title)}</h1>",
        f'<p class="verdict {page.tone}">{_text(page.verdict)}</p>',
        page.drawing,
        _answers(page.answers),
        *(f"<p>{_text(line)}</p>" for line in page.summary),
    ]
    if len(page.sections) > 3:
        links = (f'<a href="#s{i}">{_text(section.title)}</a>' for i, section in enumerate(page.sections))
        body.append(f'<nav aria-label="Contents">{"".join(links)}</nav>')
    for i, section in enumerate(page.sections):
        body.append(_section(section, i))
    drawn = any(section.figures for section in page.sections)
    charts = CHARTS.replace("@PLOTLY@", _plotly()) if drawn else ""
    tables = TABLES if any("class=many" in part for part in body) else ""
    parts = {"TITLE": _text(page.title), "BODY": "\n".join(body), "CHARTS": tables + charts}
    # in one pass: what a part says is never looked at for the name of another
    write_whole(path, re.sub("@(TITLE|BODY|CHARTS)@", lambda found: parts[found[1]], SHELL))


@functools.cache
def _plotly() -> str:
    """Return the drawing library, packed: it is three quarters of a page otherwise."""
    script = files("autotune.report").joinpath("vendored/plotly-basic.min.js").read_bytes()
    return base64.b64encode(gzip.compress(script, 9, mtime=0)).decode("ascii")


def _answers(answers: tuple[tuple[str, str], ...]) -> str:
    cards = (f"<div><dt>{_text(head)}</dt><dd>{_text(said)}</dd></div>" for head, said in answers)
    return f'<dl class="answers">{"".join(cards)}</dl>' if answers else ""


def _text(text: str) -> str:
    return html.escape(escape_controls(text), quote=False)


def _section(section: Section, number: int) -> str:
    parts = [f'<section id="s{number}"><h2>{_text(section.title)}</h2>']
    parts += [f'<div class="wide">{formula}</div>' for formula in section.formulas]
    parts += [f"<p>{_text(line)}</p>" for line in section.text]
    parts += [f'<p><a href="{html.escape(target)}">{_text(label)}</a></p>' for label, target in section.links]
    parts += [_figure(figure, f"f{number}_{i}") for i, figure in enumerate(section.figures)]
    parts += [_table(table) for table in section.tables]
    if section.details or section.detail_tables:
        inside = [f"<p>{_text(line)}</p>" for line in section.details] + [_table(t) for t in section.detail_tables]
        parts.append(f"<details><summary>Method details</summary>{''.join(inside)}</details>")
    return "\n".join([*parts, "</section>"])


def _table(table: Table) -> str:
    many = len(table.rows) > _MANY
    cells = (f"<button type='button'>{_text(cell)}</button>" if many else _text(cell) for cell in table.header)
    head = "".join(f'<th scope="col">{cell}</th>' for cell in cells)
    rows = "".join("<tr>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
    caption = f'<p class="caption">{_text(table.caption)}</p>' if table.caption else ""
    sought = '<input type="search" class="sought" placeholder="Filter rows" aria-label="Filter rows">' if many else ""
    drawn = f"<table{' class=many' * many}><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
    return f'{caption}{sought}<div class="wide">{drawn}</div>'


def _cell(cell: str | Picture | Anchor) -> str:
    if isinstance(cell, str):
        return _text(cell)
    if isinstance(cell, Anchor):
        return f'<span id="{html.escape(cell.identity)}">{_text(cell.says)}</span>'
    low, high = float(np.min(cell.values)), float(np.max(cell.values))
    x = np.linspace(1.0, 99.0, cell.values.size)
    y = 27.0 - 25.0 * (cell.values - low) / ((high - low) or 1.0)
    path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    drawn = f'<polyline points="{path}" fill="none" stroke="{BLUE}" stroke-width="1.6"/>'
    return f'<svg class="small" viewBox="0 0 100 28" role="img" aria-label="{html.escape(cell.says)}">{drawn}</svg>'


def _figure(figure: Figure, identity: str) -> str:
    drawn = figure.figure
    grid = "rgba(128,128,128,0.25)"
    drawn.update_layout(
        margin={"l": 8, "r": 12, "t": 22, "b": 8},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        hoverlabel={"font": {"color": "#fff"}},
        showlegend=False,
        autosize=True,
        **({} if figure.square else {"height": figure.height_px}),
    )
    axis: dict[str, Any] = {
        "gridcolor": grid,
        "zerolinecolor": "rgba(128,128,128,0.45)",
        "automargin": True,
        "tickangle": 0,
    }
    drawn.update_xaxes(**axis)
    drawn.update_yaxes(**axis)
    content = drawn.to_json().replace("</", "<\\/")
    return (
        f"<figure>{_legend(drawn, identity)}"
        f'<div class="chart{" square" * figure.square}" id="{identity}"{_height(figure)}></div>'
        f'<script type="application/json" data-chart="{identity}">{content}</script>'
        f"<figcaption>{_text(figure.caption)}</figcaption></figure>"
    )


def _height(figure: Figure) -> str:
    return "" if figure.square else f' style="height:{figure.height_px}px"'


def _legend(drawn: Chart, identity: str) -> str:
    """Return the names of the curves above the chart, where they hide nothing; pressing one hides its curves."""
    keys: dict[str, tuple[str, list[int]]] = {}
    for i, trace in enumerate(drawn.data):
        name = str(trace.get("name", ""))
        if name and (name in keys or trace.get("showlegend", True)):
            keys.setdefault(name, (_swatch(trace), []))[1].append(i)
    if len(keys) < 2:
        return ""
    buttons = (
        f'<button type="button" aria-pressed="true" data-of="{identity}" data-traces="{",".join(map(str, at))}">'
        f"{swatch}{_text(name)}</button>"
        for name, (swatch, at) in keys.items()
    )
    return f'<div class="legend">{"".join(buttons)}</div>'


def _swatch(trace: Mapping[str, Any]) -> str:
    line, marker = trace.get("line", {}), trace.get("marker", {})
    if trace.get("fill") and "fillcolor" in trace:
        return f'<svg viewBox="0 0 26 10"><rect width="26" height="10" fill="{trace["fillcolor"]}"/></svg>'
    if trace["type"] == "bar" or "markers" in str(trace.get("mode")):
        colour = marker.get("color") or line.get("color", GREY)
        if marker.get("symbol") == "cross":
            return f'<svg viewBox="0 0 26 10"><path d="M13 0V10M8 5H18" stroke="{colour}" stroke-width="3"/></svg>'
        if "lines" in str(trace.get("mode")):
            bar = f'<path d="M3 5H23" stroke="{colour}" stroke-width="2.4"/>'
            ends = "".join(f'<circle cx="{x}" cy="5" r="3" fill="{colour}"/>' for x in (3, 23))
            return f'<svg viewBox="0 0 26 10">{bar}{ends}</svg>'
        return f'<svg viewBox="0 0 26 10"><circle cx="13" cy="5" r="4" fill="{colour}"/></svg>'
    dash = {"dash": "6 3", "dot": "2 3", "dashdot": "6 3 2 3"}.get(line.get("dash", ""), "")
    colour = line.get("color", GREY)
    stroke = f'stroke="{colour}" stroke-width="2.4" stroke-dasharray="{dash}"'
    return f'<svg viewBox="0 0 26 10"><path d="M0 5H26" {stroke}/></svg>'
