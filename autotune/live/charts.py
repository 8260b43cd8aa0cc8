"""The page's charts as options of Apache ECharts; pure functions of the story.

A key with a leading colon is evaluated in the browser: text takes the colour of the page, which is light or dark there.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.live.axis_ends import linear_ends, log_ends, phase_ends
from autotune.live.story import Story
from autotune.report.figures import (
    axis_title,
    frequencies,
    gain_phase,
    gain_phase_bars,
    ratio_title,
    region,
    usual_range,
)
from autotune.report.page import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, thin_curve

#: regions of the points are drawn so many times larger, in every direction, where they would be too small to see
MAGNIFIED = 10.0
#: part of the picture that a region's axis must reach to be drawn in its true size
SEEN_SHARE = 0.03
ROWS = 900
TIME, FREQUENCY = "time [s]", "angular frequency [rad/s]"
#: room on the right for what stands beside a trace [px]
BESIDE = 44
#: part of the time shown that a state must last for its name to have room above a narrow picture
LABEL_SHARE = 0.3
INK = "getComputedStyle(document.body).color"

Options = dict[str, Any]

#: names stand beside the picture, where no curve crosses them
LABEL: Options = {"fontSize": 12, "position": "end", "rotate": 0, "align": "left", "distance": 3, ":color": INK}
#: where y may swing is shaded; the page's note says how far that is, as a name in the picture would lie on the trace
SWING: Options = {"silent": True, "itemStyle": {"color": "rgba(128,128,128,0.10)"}}
#: the band is its width on its lower edge, which may be negative
STACK = {"stack": "band", "stackStrategy": "all"}


class Pictures:
    """The charts of a story, computed once for all pages that show the same.

    Parameters
    ----------
    story : Story
        What is drawn.
    """

    def __init__(self, story: Story) -> None:
        self._story = story
        self._strips: dict[float, tuple[tuple[int, int], Options]] = {}
        self._news = -1
        self._facts: tuple[Options, Options, float, Options] = ({}, {}, 1.0, {})

    def strip(self, span_s: float) -> Options:
        """Return the strip chart of the last ``span_s`` [s]."""
        state = (len(self._story.rows.t), self._story.news)
        if self._strips.get(span_s, (None, {}))[0] != state:
            self._strips[span_s] = (state, strip_options(self._story, span_s))
        return self._strips[span_s][1]

    def facts(self) -> tuple[Options, Options, float, Options]:
        """Return Bode diagram, regions, how many times larger these are drawn, and steps, empty where none are."""
        story = self._story
        if self._news != story.news:
            self._news = story.news
            self._facts = (bode_options(story), *regions_options(story), steps_options(story) if story.steps else {})
        return self._facts


def strip_options(story: Story, span_s: float) -> Options:
    """Return y with its limits and the set-point over u with its limits, for the last seconds of a run.

    Parameters
    ----------
    story : Story
        The run as read so far.
    span_s : float
        How far back the chart reaches [s].
    """
    now_s = story.now_s
    t, u, y, r = story.rows.since(now_s - span_s)
    u_unit, y_unit = story.units
    limits, centre = story.limits, story.centre
    marks = [(at, name) for at, name in story.marks if t.size and at >= t[0]]
    spaced = [
        (at, name if later - at > LABEL_SHARE * (now_s - t[0]) else "")
        for (at, name), (later, _) in pairwise([*marks, (now_s, "")])
    ]
    y_lines = [(limits["y_min"], "y_min"), (limits["y_max"], "y_max")] if limits else []
    u_lines = [(limits["u_min"], "u_min"), (limits["u_max"], "u_max")] if limits else []
    low, high = (centre - limits["swing"], centre + limits["swing"]) if limits else (0.0, 1.0)
    shown = np.concatenate([y[np.isfinite(y)], [low, high], _near([value for value, _ in y_lines], low, high)])
    u_range = usual_range(u)
    y_line = _line("y", t, y, BLUE, width=1.4) | {
        "markLine": _marks(y_lines, spaced),
        "markArea": SWING | {"data": [[{"yAxis": low}, {"yAxis": high}]]} if limits else {},
    }
    u_line = _line("u", t, u, ORANGE, grid=1, step=True) | {"markLine": _marks(u_lines, [(at, "") for at, _ in marks])}
    seconds = _seconds(max(0.0, now_s - span_s) if t.size else 0.0, max(now_s, 1.0), grid=1)
    return _options(
        grids=[{"top": 48, "height": "51%", "right": BESIDE}, {"top": "67%", "bottom": 30, "right": BESIDE}],
        x_axes=[seconds | {"gridIndex": 0, "name": "", ":axisLabel": "({show: false})"}, seconds],
        y_axes=[
            _axis(axis_title("y", y_unit)) | linear_ends(float(shown.min()), float(shown.max())),
            _axis(axis_title("u", u_unit), grid=1) | linear_ends(*u_range),
        ],
        series=[y_line, _line("set-point", t, r, GREY, dash="dashed", width=1.2), u_line],
        legend=["y", "set-point", "u"],
    )


def bode_options(story: Story) -> Options:
    """Return gain and phase of the points with their 95 % bars, and of the models once there are any."""
    sign = story.sign
    u_unit, y_unit = story.units
    at = np.array([point.omega_rad_s for point in story.points])
    gain, phase_deg = gain_phase(np.array([sign * point.response for point in story.points], dtype=np.complex128))
    bars = np.array([gain_phase_bars(point) for point in story.points]).reshape(-1, 2)
    series = [
        _dots("points", at, gain, BLUE), _dots("points", at, phase_deg, BLUE, grid=1),
        _bars(at, gain, bars[:, 0], BLUE), _bars(at, phase_deg, np.degrees(bars[:, 1]), BLUE, grid=1),
    ]  # fmt: skip
    names = ["points"]
    if story.points:
        omega = frequencies(story.points, decades=0.25, count=80)
        for name, model, colour in (("fitted plant", story.plant, GREEN), ("reduced model", story.reduced, PURPLE)):
            if model is not None:
                curve = gain_phase(sign * model.response(omega))
                series += [_line(name, omega, curve[0], colour), _line(name, omega, curve[1], colour, grid=1)]
                names.append(name)
    frequency = _axis(FREQUENCY, grid=1) | {"type": "log", **log_ends(at)}
    return _options(
        grids=[{"top": 34, "height": "38%"}, {"top": "55%", "bottom": 30}],
        x_axes=[frequency | {"gridIndex": 0, "name": "", ":axisLabel": "({show: false})"}, frequency],
        y_axes=[
            _axis(ratio_title("gain", y_unit, u_unit)) | {"type": "log", **log_ends(gain)},
            _axis("phase [deg]", grid=1) | phase_ends(phase_deg),
        ],
        series=series,
        legend=names,
    )


def regions_options(story: Story) -> tuple[Options, float]:
    """Return the points in the complex plane with their 95 % regions, and how many times larger these are drawn."""
    sign = story.sign
    centres = np.array([sign * point.response for point in story.points], dtype=np.complex128)
    extent = float(np.ptp(np.concatenate([centres.real, centres.imag, [0.0]]))) or 1.0
    largest = max((float(point.region_radii()[0].max()) for point in story.points), default=0.0)
    times = MAGNIFIED if largest < SEEN_SHARE * extent else 1.0
    series = [_dots("points", centres.real, centres.imag, BLUE)]
    for point, centre in zip(story.points, centres, strict=True):
        edge = centre + times * (region(point, complex(sign)) - centre)
        series.append(_region_edge(edge[:-1], f"{point.omega_rad_s:.3g}"))
    if story.plant is not None and story.points:
        omega = frequencies(story.points, decades=0.15, count=80)
        curve = sign * story.plant.response(omega)
        series.append(_line("fitted plant", curve.real, curve.imag, GREEN))
    axis = {"scale": True, "splitNumber": 4}
    options = _options(
        grids=[{"top": 34, "bottom": 30, "right": BESIDE}],
        x_axes=[_axis("real part") | axis],
        y_axes=[_axis("imaginary part") | axis],
        series=series,
        legend=["points", "95 % region", *(["fitted plant"] if story.plant is not None else [])],
    )
    return options, times


def steps_options(story: Story) -> Options:
    """Return the measured response to set-point and load step in the band of what was predicted."""
    steps = {name: np.array(values) for name, values in story.steps.items()}
    t = steps["t"]
    band = _line("95 % band", t, steps["high"] - steps["low"], GREEN, width=0.0)
    band |= STACK | {"areaStyle": {"color": GREEN, "opacity": 0.2}, "symbol": "roundRect", "showSymbol": False}
    return _options(
        grids=[{"top": 34, "bottom": 30}],
        x_axes=[_seconds(0.0, float(t[-1]))],
        y_axes=[_axis(axis_title("y - operating point", story.units[1])) | {"scale": True}],
        series=[
            _line("low", t, steps["low"], GREEN, width=0.0) | STACK,
            band,
            _line("measured, smoothed", t, steps["measured"], BLUE, width=2.0),
            _line("predicted", t, steps["predicted"], RED, width=1.6),
            _line("set-point", t, steps["setpoint"], GREY, dash="dashed", width=1.2),
        ],
        legend=["95 % band", "measured, smoothed", "predicted", "set-point"],
    )


def _options(
    *, grids: list[Options], x_axes: list[Options], y_axes: list[Options], series: list[Options], legend: list[str]
) -> Options:
    return {
        "animation": False,
        "textStyle": {"fontFamily": "inherit", ":color": INK},
        "legend": {"data": legend, "top": 0, "left": 0, "itemGap": 8, "itemWidth": 14, "textStyle": {":color": INK}},
        "tooltip": {"trigger": "axis", "axisPointer": {"type": "line"}, "confine": True},
        "grid": [{"left": 62, "right": 16} | grid for grid in grids],
        "xAxis": x_axes,
        "yAxis": y_axes,
        "series": series,
    }


def _axis(name: str, *, grid: int = 0) -> Options:
    return {
        "type": "value",
        "gridIndex": grid,
        "name": name,
        "nameLocation": "middle",
        "nameGap": 20 if name in (TIME, FREQUENCY, "real part") else 46,
        "nameTextStyle": {":color": INK},
        "axisLabel": {":color": INK, "hideOverlap": True, ":formatter": "v => +v.toPrecision(3)"},
        "axisLine": {"lineStyle": {"color": GREY}},
        "splitLine": {"lineStyle": {"color": "rgba(128,128,128,0.25)"}},
    }


def _seconds(first_s: float, last_s: float, *, grid: int = 0) -> Options:
    """Return an axis of time, whose ends move on with the run: where they are no round numbers they get no labels."""
    axis = _axis(TIME, grid=grid)
    ends = {"showMinLabel": first_s == 0.0, "showMaxLabel": False}
    return axis | {"min": first_s, "max": last_s, "axisLabel": axis["axisLabel"] | ends}


def _line(
    name: str, x: FloatArray, y: FloatArray, colour: str, *, grid: int = 0, dash: str = "solid",
    width: float = 1.4, step: bool = False,
) -> Options:  # fmt: skip
    if x.size > ROWS:
        x, y = thin_curve(x, y, ROWS)
    line: Options = {
        "name": name,
        "type": "line",
        "xAxisIndex": grid,
        "yAxisIndex": grid,
        "symbol": "none",  # in the legend, too, where a hollow one is filled with white on any ground
        "lineStyle": {"color": colour, "width": width, "type": dash},
        "itemStyle": {"color": colour},
        "data": _pairs(x, y),
    }
    return line | {"step": "end"} if step else line


def _dots(name: str, x: FloatArray, y: FloatArray, colour: str, *, grid: int = 0) -> Options:
    return _line(name, x, y, colour, grid=grid) | {"type": "scatter", "symbol": "circle", "symbolSize": 8}


def _region_edge(edge: ComplexArray, name: str) -> Options:
    """Return an open edge closed where it is furthest right, and its name below that: off region, point and curve."""
    turned = np.roll(edge, -int(edge.real.argmax()))
    closed = np.concatenate([turned[-1:], turned, turned[:1]])  # the end's label hides the last piece: it is first, too
    return _line("95 % region", closed.real, closed.imag, ORANGE, width=1.6) | {
        "endLabel": {"show": True, "formatter": name, ":color": INK, "offset": [0, 9]},
        "labelLayout": {"hideOverlap": True},
    }


def _bars(x: FloatArray, y: FloatArray, half: FloatArray, colour: str, *, grid: int = 0) -> Options:
    """Return vertical bars as one line with gaps."""
    data: list[list[float | None]] = []
    for at, middle, length in zip(x, y, half, strict=True):
        data += [[float(at), float(middle - length)], [float(at), float(middle + length)], [float(at), None]]
    return _line("95 %", np.empty(0), np.empty(0), colour, grid=grid, width=2.0) | {"data": data}


def _marks(lines: list[tuple[float, str]], instants: list[tuple[float, str]]) -> Options:
    def mark(axis: str, value: float, text: str, colour: str) -> Options:
        label = LABEL | {"formatter": text, "show": bool(text)}
        return {axis: value, "lineStyle": {"color": colour, "type": "dotted"}, "label": label}

    limits = [mark("yAxis", value, text, RED) for value, text in lines]
    begins = [mark("xAxis", at, text, GREY) for at, text in instants]
    return {"symbol": "none", "silent": True, "animation": False, "data": [*limits, *begins]}


def _pairs(x: FloatArray, y: FloatArray) -> list[list[float | None]]:
    """Return the rows as the browser takes them, six digits each; a gap where y is not a number."""
    xs = [float(f"{value:.6g}") for value in x]
    ys = [float(f"{value:.6g}") if np.isfinite(value) else None for value in y]
    return [list(pair) for pair in zip(xs, ys, strict=True)]


def _near(limits: list[float], low: float, high: float) -> list[float]:
    """Return the limits that the axis can reach without making the swing small."""
    return [limit for limit in limits if low - (high - low) <= limit <= high + (high - low)]
