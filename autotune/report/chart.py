"""Charts as plotly.js takes them: traces on a grid of axes, in plain dictionaries; nothing is drawn here.

The names are those of plotly's own Python package (``Scatter``, ``Bar``, ``make_subplots``, ``add_trace``,
``update_xaxes``, ``add_vline``), of which a report needs these few, at a thousandth of its size.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from autotune.arrays import FloatArray

Trace: TypeAlias = dict[str, Any]

#: What plotly writes with an underscore for a setting inside a group.
_GROUPS = ("line", "marker", "title", "font")
#: decades up to which 2 and 5 have a tick as well, and powers of ten that an axis has numbers for at most
_DIGITS_SHOWN, _MOST_DECADES = 3.0, 8.0
_DIGITS = 7


def Scatter(**settings: Any) -> Trace:  # noqa: N802 - plotly's own name
    """Return a trace of points or lines; the settings are plotly's, ``line_shape`` for ``line: {shape}``."""
    return {"type": "scatter", **_nest(settings)}


def Bar(**settings: Any) -> Trace:  # noqa: N802 - plotly's own name
    """Return a trace of bars."""
    return {"type": "bar", **_nest(settings)}


def make_subplots(
    *,
    rows: int = 1,
    cols: int = 1,
    shared_xaxes: bool = False,
    vertical_spacing: float = 0.08,
    horizontal_spacing: float = 0.06,
    row_heights: Sequence[float] | None = None,
    subplot_titles: Sequence[str] = (),
) -> Chart:
    """Return a chart with a grid of axes, rows from the top.

    Parameters
    ----------
    rows, cols : int
        Grid of axes.
    shared_xaxes : bool
        Whether the x axes of a column are zoomed together.
    vertical_spacing, horizontal_spacing : float
        Between rows and columns, as shares of the chart.
    row_heights : sequence of float, optional
        Relative heights from the top; equal when absent.
    subplot_titles : sequence of str
        Row by row.
    """
    chart = Chart(rows=rows, cols=cols)
    heights = np.array(row_heights if row_heights is not None else np.ones(rows), dtype=np.float64)
    heights *= (1.0 - vertical_spacing * (rows - 1)) / heights.sum()
    width = (1.0 - horizontal_spacing * (cols - 1)) / cols
    for row in range(rows):
        top = 1.0 - float(heights[:row].sum()) - row * vertical_spacing
        for col in range(cols):
            name = _suffix(row * cols + col)
            left = col * (width + horizontal_spacing)
            x: dict[str, Any] = {"domain": [left, left + width], "anchor": f"y{name}"}
            if shared_xaxes and row < rows - 1:
                x |= {"matches": f"x{_suffix((rows - 1) * cols + col)}", "showticklabels": False}
            chart.layout[f"xaxis{name}"] = x
            chart.layout[f"yaxis{name}"] = {"domain": [max(top - heights[row], 0.0), top], "anchor": f"x{name}"}
    for i, title in enumerate(subplot_titles):
        name = _suffix(i)
        chart.add_annotation(
            x=0.5, xref=f"x{name} domain", y=1.0, yref=f"y{name} domain", yanchor="bottom", text=title, showarrow=False
        )
    return chart


def _suffix(index: int) -> str:
    return "" if index == 0 else str(index + 1)


class Chart:
    """Traces and layout of one chart, with the few methods of plotly's figures that the reports use.

    Parameters
    ----------
    rows, cols : int
        Grid of axes.
    """

    def __init__(self, *, rows: int = 1, cols: int = 1) -> None:
        self.rows, self.cols = rows, cols
        self.data: list[Trace] = []
        self.layout: dict[str, Any] = {"xaxis": {}, "yaxis": {}, "shapes": [], "annotations": []}

    def add_trace(self, trace: Trace, row: int = 1, col: int = 1) -> None:
        """Add a trace to the axes in a row and a column.

        Parameters
        ----------
        trace : Trace
            From :func:`Scatter` and its like.
        row, col : int
            Counted from 1.
        """
        name = self._name(row, col)
        self.data.append({**trace, "xaxis": f"x{name}", "yaxis": f"y{name}"})

    def add_scatter(self, *, row: int = 1, col: int = 1, **settings: Any) -> None:
        """Add a trace of points or lines.

        Parameters
        ----------
        row, col : int
            Counted from 1.
        **settings : object
            Of plotly's scatter.
        """
        self.add_trace(Scatter(**settings), row, col)

    def update_layout(self, **settings: Any) -> None:
        """Set what holds for the whole chart."""
        self.layout |= _nest(settings)

    def update_xaxes(self, row: int | None = None, col: int | None = None, **settings: Any) -> None:
        """Set horizontal axes: all, or those of a row or a column.

        Parameters
        ----------
        row, col : int, optional
            Counted from 1; all where absent.
        **settings : object
            Of plotly's x axis.
        """
        self._update("xaxis", row, col, settings)

    def update_yaxes(self, row: int | None = None, col: int | None = None, **settings: Any) -> None:
        """Set vertical axes: all, or those of a row or a column.

        Parameters
        ----------
        row, col : int, optional
            Counted from 1; all where absent.
        **settings : object
            Of plotly's y axis.
        """
        self._update("yaxis", row, col, settings)

    def add_vline(self, x: float, **settings: Any) -> None:
        """Draw a line over the whole height at an x of the first axis.

        Parameters
        ----------
        x : float
            Place on the axis.
        **settings : object
            Of plotly's shape.
        """
        self.add_shape(type="line", x0=x, x1=x, y0=0, y1=1, yref="paper", **settings)

    def add_hline(self, y: float, **settings: Any) -> None:
        """Draw a line over the whole width at a y of the first axis.

        Parameters
        ----------
        y : float
            Place on the axis.
        **settings : object
            Of plotly's shape.
        """
        self.add_shape(type="line", y0=y, y1=y, x0=0, x1=1, xref="paper", **settings)

    def add_vrect(self, x0: float, x1: float, **settings: Any) -> None:
        """Shade what lies between two x of the first axis.

        Parameters
        ----------
        x0, x1 : float
            Places on the axis.
        **settings : object
            Of plotly's shape.
        """
        self.add_shape(type="rect", x0=x0, x1=x1, y0=0, y1=1, yref="paper", **settings)

    def add_shape(self, **settings: Any) -> None:
        """Draw a shape."""
        self.layout["shapes"].append(_nest(settings))

    def add_annotation(self, **settings: Any) -> None:
        """Write a text at a place, of the first axes where none are named."""
        self.layout["annotations"].append(_nest(settings))

    def to_json(self) -> str:
        """Return traces and layout as JSON, numbers to seven digits, no number as null."""
        layout = {key: self._with_ticks(key, value) for key, value in self.layout.items()}
        return json.dumps({"data": _plain(self.data), "layout": _plain(layout)}, separators=(",", ":"))

    def _with_ticks(self, key: str, axis: Any) -> Any:
        """Return a logarithmic axis with numbers of one size at its ticks: plotly's own between decades are tiny."""
        if not isinstance(axis, dict) or axis.get("type") != "log" or "tickvals" in axis:
            return axis
        letter, name = key[0], key.replace("axis", "")
        axes = [one for one in self.layout.values() if isinstance(one, dict)]
        shares = "matches" in axis or any(one.get("matches") == name for one in axes)
        drawn = [
            np.asarray(trace[letter], dtype=np.float64)
            for trace in self.data
            if letter in trace and (shares or trace.get(f"{letter}axis", letter) == name)
        ]
        if letter == "y" and any(trace["type"] == "bar" for trace in self.data):
            drawn.append(np.ones(1))  # bars stand on a count of one
        values, texts = log_ticks(drawn)
        return {**axis, "tickvals": values, "ticktext": texts}

    def _name(self, row: int, col: int) -> str:
        return _suffix((row - 1) * self.cols + col - 1)

    def _update(self, axis: str, row: int | None, col: int | None, settings: Mapping[str, Any]) -> None:
        for i in range(self.rows * self.cols):
            if row in (None, i // self.cols + 1) and col in (None, i % self.cols + 1):
                own = self.layout.setdefault(f"{axis}{_suffix(i)}", {})
                own |= _nest(settings)


def log_ticks(drawn: Sequence[FloatArray]) -> tuple[list[float], list[str]]:
    """Return the ticks of a logarithmic axis and their numbers: 1, 2, 5 up to three decades, then powers of ten.

    Parameters
    ----------
    drawn : sequence of (N,) array
        What is drawn along the axis, in any unit.
    """
    values = np.concatenate([*drawn, np.empty(0)])
    values = values[np.isfinite(values) & (values > 0.0)]
    if not values.size:
        return [], []
    low, high = math.floor(math.log10(values.min())), math.ceil(math.log10(values.max()))
    decades = math.log10(values.max() / values.min())
    every = max(1, round(decades / _MOST_DECADES))
    digits = (1, 2, 5) if decades < _DIGITS_SHOWN else (1,)
    # one decade beyond either end is for error bars; what is not in the picture is not drawn
    ticks = [(digit, power) for power in range(low - 1, high + 2) if power % every == 0 for digit in digits]
    return [digit * 10.0**power for digit, power in ticks], [_tick_text(digit, power) for digit, power in ticks]


def _tick_text(digit: int, power: int) -> str:
    if -4 < power < 5:
        return f"{digit * 10.0**power:g}"
    return (f"{digit}·" if digit > 1 else "") + f"10<sup>{power}</sup>".replace("-", "−")


def _nest(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings with ``line_shape`` and the like inside their group, and a title as plotly.js wants it."""
    nested: dict[str, Any] = {}
    for key, value in settings.items():
        group, mark, rest = key.partition("_")
        if mark and group in _GROUPS:
            nested[group] = {**nested.get(group, {}), rest: value}
        elif key == "title" and isinstance(value, str):
            nested["title"] = {**nested.get("title", {}), "text": value}
        elif isinstance(value, Mapping) and isinstance(nested.get(key), Mapping):
            nested[key] = {**nested[key], **value}
        else:
            nested[key] = value
    return nested


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    if isinstance(value, float | np.floating):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return value
