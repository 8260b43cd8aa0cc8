"""One function that draws any result: on matplotlib axes where they are given, else as an interactive chart."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from autotune.api.points import Points, as_points
from autotune.arrays import FloatArray
from autotune.design.reference import Trajectory
from autotune.design.rst import RST
from autotune.errors import InputError
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.recording import Recording
from autotune.report.chart import Chart
from autotune.report.figures import Curve, bode_figure, frequencies, gain_phase, gain_phase_bars, recording_figure
from autotune.report.page import BLUE, GREEN, ORANGE, PURPLE, Figure, Page, Section, write_page

_HEIGHT = 420
_BARE = "<style>h1, h2, .verdict { display: none }</style>"
_COLOURS = (ORANGE, BLUE, GREEN, PURPLE)


def plot(*results: Any, ax: Any = None, names: Sequence[str] = ()) -> Any:
    """Draw a recording or a transition over time, anything else as a Bode diagram, several on top of each other.

    Parameters
    ----------
    *results : object
        One recording or transition; or points, plants, models, controllers, designs, closed-loop results.
    ax : matplotlib axes, optional
        One axes for a recording's y or the gain alone, or a pair: y and u, gain and phase.
    names : sequence of str
        For the legend.

    Returns
    -------
    autotune.report.chart.Chart or the axes
        A notebook shows the chart by itself, without a network; ``plotly.io.from_json(chart.to_json())`` is plotly's
        own figure of it.

    Examples
    --------
    >>> import autotune as at
    >>> figure = at.plot(at.example("ball"), at.reduce(at.example("ball")), names=("ball", "reduced model"))
    >>> len(figure.data)
    4
    """
    if not results:
        raise InputError("nothing to draw", where="plot", remedy="give a recording, points or a model")
    first = results[0]
    if isinstance(first, Recording):
        return _recording(first) if ax is None else _on_axes(ax, first.t, (first.y, first.u), ("y", "u"), "t [s]")
    if isinstance(first, Trajectory):
        if ax is not None:
            return _on_axes(ax, first.t_s, (first.y, first.u), ("y", "u"), "t [s]")
        return _recording(Recording(t=first.t_s, u=first.u, y=first.y, name="transition"))
    return _bode(results, ax, names)


def _recording(recording: Recording) -> Any:
    units = recording.metadata.get("units", {})
    return recording_figure(recording, str(units.get("u", "")), str(units.get("y", "")))


class _Sampled:
    """One channel of a state space as something with a frequency response."""

    def __init__(self, model: InnovationModel) -> None:
        self._model = model

    def response(self, omega_rad_s: FloatArray) -> Any:
        """Return the first channel's complex gain."""
        return self._model.response(omega_rad_s)[:, 0, 0]


def _responds(result: Any) -> Any:
    model = getattr(getattr(result, "estimate", None), "model", result)
    if isinstance(model, InnovationModel):
        return _Sampled(model)
    if isinstance(result, RST):
        return result.feedback()
    if hasattr(result, "response"):
        return result
    from autotune.api.plants import as_plant

    return result.controller if hasattr(result, "controller") else as_plant(result)


def _bode(results: Sequence[Any], ax: Any, names: Sequence[str]) -> Any:
    titles = [*names, *(f"{type(result).__name__}" for result in results[len(names) :])]
    estimates: list[tuple[str, Points, str]] = []
    curves: list[Curve] = []
    for i, (result, title) in enumerate(zip(results, titles, strict=True)):
        colour = _COLOURS[i % len(_COLOURS)]
        measured = as_points(result)
        if measured is not None:
            estimates.append((title, measured, colour))
        if measured is None or hasattr(result, "estimate"):
            curves.append(Curve(name=title, system=_responds(result), colour=colour))
    every = [point for _, points, _ in estimates for point in points]
    omega = frequencies(every) if every else _grid(curves[0].system)
    at_first = every[0].response if every else curves[0].system.response(omega[:1])[0]
    sign = 1 if np.angle(at_first) <= np.pi / 6.0 else -1  # a lag and an integrator turn a positive gain backwards
    if ax is None:
        return bode_figure(estimates, curves, omega, sign, "")
    pair = np.atleast_1d(ax).ravel()
    for curve in curves:
        for one, line in zip(pair, gain_phase(sign * curve.system.response(omega)), strict=False):
            one.plot(omega, line, color=curve.colour, label=curve.name)
    for title, points, colour in estimates:
        at = [point.omega_rad_s for point in points]
        bars = np.array([gain_phase_bars(point) for point in points])
        values = gain_phase(np.array([sign * point.response for point in points]))
        for one, value, bar in zip(pair, values, (bars[:, 0], np.degrees(bars[:, 1])), strict=False):
            known = any(curve.name == title for curve in curves)  # a model's own points need no second entry
            one.errorbar(at, value, yerr=bar, fmt="o", color=colour, label=None if known else title)
    for one, title in zip(pair, ("gain", "phase [deg]"), strict=False):
        one.set(xscale="log", ylabel=title)
    pair[-1].set(xlabel="angular frequency [rad/s]")
    pair[0].set_yscale("log")
    pair[0].legend()
    return ax


def _grid(system: Any) -> FloatArray:
    """Return a grid about the poles and zeros, or up to the Nyquist frequency."""
    if isinstance(system, _Sampled):
        nyquist = np.pi / system._model.sample_time_s
        return np.geomspace(1e-3 * nyquist, nyquist, 400, dtype=np.float64)
    corner = np.abs(
        [getattr(system, "omega_d_rad_s", 0.0), *getattr(system, "poles", []), *getattr(system, "zeros", [])]
    )
    corner = corner[corner > 0.0]
    low, high = (0.1, 10.0) if corner.size == 0 else (float(corner.min()), float(corner.max()))
    return np.geomspace(0.05 * low, 5.0 * high, 400, dtype=np.float64)


def _on_axes(ax: Any, t: FloatArray, columns: Sequence[FloatArray], names: Sequence[str], time: str) -> Any:
    pair = np.atleast_1d(ax).ravel()
    for one, values, name in zip(pair, columns, names, strict=False):
        one.plot(t, values, color=BLUE, linewidth=0.9)
        one.set(ylabel=name)
    pair[-1].set(xlabel=time)
    return ax


def chart_html(chart: Chart) -> str:
    """Return a chart for a notebook: a frame with its own page, drawing library included."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chart.html"
        figure = Figure(figure=chart, caption="", height_px=_HEIGHT)
        write_page(
            Page(title="", verdict="", tone="good", summary=(), sections=(Section(title="", figures=(figure,)),)), path
        )
        content = path.read_text(encoding="utf-8").replace("</head>", f"{_BARE}</head>", 1)
    return f'<iframe srcdoc="{html.escape(content)}" width="100%" height="{_HEIGHT + 160}" style="border:0"></iframe>'


setattr(Chart, "_repr_html_", chart_html)  # noqa: B010 - the page knows nothing of notebooks
