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
from autotune.outputs import write_whole
from autotune.report.chart import Chart, Scatter
from autotune.text_files import shown

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
class Table:
    """Rows of cells under a header; numbers are formatted by the caller, with their units in the header."""

    header: tuple[str, ...]
    rows: tuple[tuple[str | Picture, ...], ...]
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
    """A heading with paragraphs, links (what they say, and where they lead), then figures and tables, then the method.

    ``details`` and ``detail_tables`` are for those who want to check the method; they are folded away.
    """

    title: str
    text: tuple[str, ...] = ()
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


def thinned(t: FloatArray, y: FloatArray, points: int = 3000) -> tuple[FloatArray, FloatArray]:
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
    charts = _CHARTS.replace("@PLOTLY@", _plotly()) if drawn else ""
    tables = _TABLES if any("class=many" in part for part in body) else ""
    parts = {"TITLE": _text(page.title), "BODY": "\n".join(body), "CHARTS": tables + charts}
    # in one pass: what a part says is never looked at for the name of another
    write_whole(path, re.sub("@(TITLE|BODY|CHARTS)@", lambda found: parts[found[1]], _SHELL))


@functools.cache
def _plotly() -> str:
    """Return the drawing library, packed: it is three quarters of a page otherwise."""
    script = files("autotune.report").joinpath("vendored/plotly-basic.min.js").read_bytes()
    return base64.b64encode(gzip.compress(script, 9, mtime=0)).decode("ascii")


def _answers(answers: tuple[tuple[str, str], ...]) -> str:
    cards = (f"<div><dt>{_text(head)}</dt><dd>{_text(said)}</dd></div>" for head, said in answers)
    return f'<dl class="answers">{"".join(cards)}</dl>' if answers else ""


def _text(text: str) -> str:
    return html.escape(shown(text), quote=False)


def _section(section: Section, number: int) -> str:
    parts = [f'<section id="s{number}"><h2>{_text(section.title)}</h2>']
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


def _cell(cell: str | Picture) -> str:
    if isinstance(cell, str):
        return _text(cell)
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
        return f'<svg viewBox="0 0 26 10"><circle cx="13" cy="5" r="4" fill="{colour}"/></svg>'
    dash = {"dash": "6 3", "dot": "2 3", "dashdot": "6 3 2 3"}.get(line.get("dash", ""), "")
    colour = line.get("color", GREY)
    stroke = f'stroke="{colour}" stroke-width="2.4" stroke-dasharray="{dash}"'
    return f'<svg viewBox="0 0 26 10"><path d="M0 5H26" {stroke}/></svg>'


_SHELL = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>@TITLE@</title>
<style>
:root { color-scheme: light dark; --ink: #1c1f23; --paper: #fff; --faint: #667; --line: #d5d8de; --card: #f6f7f9; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e6ea; --paper: #15171a; --faint: #9aa1ad; --line: #363b43; --card: #1e2126; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1180px; padding: 1.2rem clamp(0.7rem, 3vw, 2.2rem) 4rem; color: var(--ink);
  background: var(--paper); font: 16px/1.55 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.65rem; line-height: 1.25; margin: 0.6rem 0 0.8rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 0.5rem; padding-top: 0.5rem; border-top: 1px solid var(--line); }
p { max-width: 78ch; margin: 0.5rem 0; }
.verdict { font-size: 1.1rem; font-weight: 600; padding: 0.7rem 1rem; border-left: 6px solid; background: var(--card); }
.good { border-color: #0d9a72; } .warn { border-color: #d98200; } .bad { border-color: #d1495b; }
nav { display: flex; flex-wrap: wrap; gap: 0.3rem 1rem; margin: 1rem 0; font-size: 0.93rem; }
a { color: inherit; }
.wide { overflow-x: auto; margin: 0.8rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.93rem; }
.caption { color: var(--faint); font-size: 0.93rem; margin-top: 1.2rem; }
th, td { text-align: left; padding: 0.3rem 0.9rem 0.3rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; } th button { all: unset; cursor: pointer; }
th button:focus-visible { outline: 2px solid var(--faint); }
th[aria-sort="ascending"] button::after { content: " \\2191"; }
th[aria-sort="descending"] button::after { content: " \\2193"; }
.sought { font: inherit; padding: 0.25rem 0.6rem; margin-top: 0.6rem; width: min(100%, 22rem); }
@media print { .sought { display: none; } }
.answers { display: grid; gap: 0.8rem; margin: 1rem 0; }
.answers { grid-template-columns: repeat(auto-fit, minmax(min(17rem, 100%), 1fr)); }
.answers div { background: var(--card); padding: 0.6rem 0.9rem; border-radius: 6px; }
.answers dt { color: var(--faint); font-size: 0.86rem; } .answers dd { margin: 0.15rem 0 0; overflow-wrap: anywhere; }
.square { width: min(100%, 560px); aspect-ratio: 1; } .small { width: 100px; height: 28px; }
.chain { margin: 1.1rem 0; } .chain svg { width: 100%; height: auto; display: block; } .upright { display: none; }
.chain rect { fill: var(--card); stroke: var(--line); stroke-width: 1.5; } .chain text { fill: var(--ink); }
.chain rect.lit { fill: #d9820033; stroke: #d98200; stroke-width: 3; } .chain rect.may { stroke: #d98200; }
.chain rect.added { stroke-dasharray: 6 4; } .chain .small-print { fill: var(--faint); font-size: 12px; }
.chain .note { font-weight: 600; } .wire { stroke: var(--faint); stroke-width: 1.5; } .tip { fill: var(--faint); }
details { margin: 0.8rem 0; } summary { cursor: pointer; color: var(--faint); font-size: 0.93rem; }
.legend { display: flex; flex-wrap: wrap; gap: 0.1rem 0.4rem; }
.legend button { all: unset; cursor: pointer; font-size: 0.86rem; padding: 0.1rem 0.4rem; border-radius: 4px; }
.legend button:focus-visible { outline: 2px solid var(--faint); } .legend button[aria-pressed="false"] { opacity: 0.4; }
.legend svg { width: 26px; height: 10px; margin-right: 0.4rem; fill: none; }
figure { margin: 1.1rem 0 1.6rem; } figcaption { color: var(--faint); font-size: 0.9rem; max-width: 84ch; }
@media (max-width: 760px) { .lying { display: none; } .upright { display: block; } }
@media (max-width: 520px) { body { font-size: 15px; } h1 { font-size: 1.35rem; } table { font-size: 0.85rem; }
  td, th { padding-right: 0.45rem; } }
</style>
</head>
<body><main>
@BODY@
</main>
@CHARTS@</body></html>
"""

_TABLES = """<script>
const value = (row, at) => row.cells[at].textContent.trim();
for (const table of document.querySelectorAll("table.many")) {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, at) => head.firstChild.addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") !== "ascending";
    heads.forEach(one => one.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const rows = [...body.rows].map(row => [value(row, at), parseFloat(value(row, at)), row]);
    const order = ([a, x], [b, y]) => isNaN(x) || isNaN(y) ? isNaN(x) - isNaN(y) || a.localeCompare(b) : x - y;
    rows.sort((a, b) => up ? order(a, b) : order(b, a));
    body.append(...rows.map(([, , row]) => row));
  }));
  table.parentElement.previousElementSibling.addEventListener("input", event => {
    const words = event.target.value.toLowerCase().split(/\\s+/);
    for (const row of body.rows) row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word));
  });
}
</script>
"""

_CHARTS = """<noscript><p>The charts need JavaScript, all of which is in this file; no request is sent.</p></noscript>
<script type="text/plain" id="plotly">@PLOTLY@</script>
<script>
const own = id => JSON.parse(document.querySelector(`[data-chart="${id}"]`).textContent);
const ink = () => ({"font.color": getComputedStyle(document.body).color, "font.family": "inherit"});
async function unpacked(id) {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), one => one.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
}
function narrow(layout, width) {
  if (width > 520) return;
  for (const key of Object.keys(layout).filter(key => /^[xy]axis/.test(key))) {
    const axis = layout[key], part = axis.domain ? axis.domain[1] - axis.domain[0] : 1;
    if (key[0] === "x" && axis.dtick === undefined) axis.nticks = Math.max(2, Math.floor(6 * part));
    if (axis.title) axis.title.font = {size: 11};
  }
  layout.font.size = 11;
}
function draw(div) {
  const {data, layout} = own(div.id);
  layout.font = {size: 13, color: getComputedStyle(document.body).color};
  narrow(layout, div.clientWidth);
  return Plotly.newPlot(div, data, layout, {responsive: true, displaylogo: false, displayModeBar: false});
}
async function drawAll() {
  const script = document.createElement("script");
  script.textContent = await unpacked("plotly");
  document.head.append(script);
  for (const div of document.querySelectorAll(".chart")) await draw(div);
  document.body.dataset.drawn = "yes";
}
drawAll();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () =>
  document.querySelectorAll(".chart").forEach(div => Plotly.relayout(div, ink())));
document.querySelectorAll(".legend button").forEach(button => button.addEventListener("click", () => {
  const shown = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", shown);
  Plotly.restyle(button.dataset.of, {visible: shown}, button.dataset.traces.split(",").map(Number));
}));
</script>
"""
