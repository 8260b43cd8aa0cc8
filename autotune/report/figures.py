"""Figures that several pages share: recordings, Bode diagram with regions, titles of axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.identification.envelope import polar_sd
from autotune.points import FrequencyPoint
from autotune.recording import Recording
from autotune.report import chart as go
from autotune.report.chart import make_subplots
from autotune.report.page import BLUE, GREY, ORANGE, add_line, thin_curve


class Responds(Protocol):
    """Anything with a frequency response."""

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return the complex gain at the frequencies [rad/s]."""
        ...


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A named frequency response with its colour and dash."""

    name: str
    system: Responds
    colour: str
    dash: str = "solid"


def recording_figure(
    recording: Recording, u_unit: str, y_unit: str, *, marks: Sequence[tuple[float, str]] = ()
) -> go.Chart:
    """Draw y over u against time, with instants marked by their names.

    Parameters
    ----------
    recording : Recording
        What to draw; a set-point column is drawn with y.
    u_unit, y_unit : str
        Units for the axes.
    marks : sequence of (time [s], name)
        Vertical lines.
    """
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.62, 0.38])
    add_line(figure, *thin_curve(recording.t, recording.y), "y", BLUE, width=1.0, row=1, col=1)
    if "r" in recording.extra:
        add_line(figure, *thin_curve(recording.t, recording["r"]), "r", GREY, dash="dash", row=1, col=1)
    held_t, held_u = thin_curve(recording.t, recording.u)
    add_line(figure, held_t, held_u, "u", ORANGE, width=1.0, row=2, col=1, line_shape="hv")
    figure.update_yaxes(title=axis_title("y", y_unit), row=1, col=1)
    figure.update_yaxes(title=axis_title("u", u_unit), range=usual_range(recording.u), row=2, col=1)
    figure.update_xaxes(title="time [s]", row=2, col=1)
    for time_s, name in marks:
        figure.add_vline(x=time_s, line={"color": GREY, "width": 1, "dash": "dot"})
        figure.add_annotation(
            x=time_s,
            y=1.0,
            yref="paper",
            text=name,
            showarrow=False,
            textangle=-90 if len(name) > 2 else 0,
            xanchor="left",
            yanchor="top",
        )
    return figure


def frequencies(points: Sequence[FrequencyPoint], decades: float = 0.7, count: int = 400) -> FloatArray:
    """Return a logarithmic grid that covers the points and some decades beyond them.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least one.
    decades : float
        How far it goes on, both ways.
    count : int
        Frequencies.

    Returns
    -------
    (count,) array
        Angular frequencies [rad/s].
    """
    omega = [point.omega_rad_s for point in points]
    return np.geomspace(min(omega) * 10**-decades, max(omega) * 10**decades, count, dtype=np.float64)


def bode_figure(
    estimates: Sequence[tuple[str, Sequence[FrequencyPoint], str]],
    curves: Sequence[Curve],
    omega: FloatArray,
    sign: int,
    gain_unit: str,
) -> go.Chart:
    """Draw gain and phase: points with their 95 % bars, and curves.

    Parameters
    ----------
    estimates : sequence of (name, points, colour)
        Kinds of points; bars where a covariance is known.
    curves : sequence of Curve
        Models.
    omega : (N,) array
        Grid for the curves [rad/s].
    sign : int
        Sign of the plant's gain; the phase is drawn for the positive gain, between -360 and 0 degrees.
    gain_unit : str
        Unit of the gain.
    """
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.05)
    drawn: list[FloatArray] = []
    for curve in curves:
        gain, phase_deg = gain_phase(sign * curve.system.response(omega))
        drawn.append(phase_deg)
        add_line(figure, omega, gain, curve.name, curve.colour, dash=curve.dash, row=1, col=1)
        add_line(figure, omega, phase_deg, curve.name, curve.colour, dash=curve.dash, row=2, col=1, showlegend=False)
    measured: list[FloatArray] = []
    for name, points, colour in estimates:
        at = np.array([point.omega_rad_s for point in points])
        gain, phase_deg = gain_phase(np.array([sign * point.response for point in points]))
        bars = np.array([gain_phase_bars(point) for point in points]).reshape(-1, 2)
        measured.append(phase_deg)
        for row, values, bar in ((1, gain, bars[:, 0]), (2, phase_deg, np.degrees(bars[:, 1]))):
            figure.add_trace(
                go.Scatter(
                    x=at,
                    y=values,
                    name=name,
                    mode="markers",
                    marker={"color": colour, "size": 8, "symbol": "circle" if bars.any() else "x"},
                    error_y={"type": "data", "array": bar, "color": colour, "visible": bool(bars.any())},
                    showlegend=row == 1,
                ),
                row=row,
                col=1,
            )
    figure.update_xaxes(type="log")
    figure.update_xaxes(title="angular frequency [rad/s]", row=2, col=1)
    figure.update_yaxes(type="log", title=axis_title("gain", gain_unit), row=1, col=1)
    low, high, step = phase_axis(measured, drawn)
    room = 0.05 * (high - low)  # the lowest tick's number is not to meet the first one of the frequency axis
    figure.update_yaxes(title="phase [deg]", dtick=step, range=[low - room, high], row=2, col=1)
    return figure


def phase_axis(measured: Sequence[FloatArray], drawn: Sequence[FloatArray]) -> tuple[float, float, float]:
    """Return a phase axis that stays readable where dead time turns the phase without end.

    Parameters
    ----------
    measured, drawn : sequence of (N,) array
        Phases of the points and of the curves [deg].

    Returns
    -------
    low, high, step : float
        Limits and the distance of the ticks [deg]: a quarter turn below the lowest point, or a turn and a half below
        the highest where there is none; at most nine ticks.
    """
    curves = np.concatenate([*drawn, *measured])
    curves = curves[np.isfinite(curves)]
    points = np.concatenate([*measured, np.empty(0)])
    top = float(curves.max()) if curves.size else 0.0
    floor = float(points.min()) - 90.0 if points.size else top - 540.0
    bottom = max(float(curves.min()) if curves.size else -180.0, floor)
    step = next((step for step in (15.0, 30.0, 45.0, 90.0, 180.0) if (top - bottom) / step <= 7.0), 360.0)
    return float(step * np.floor(bottom / step + 1e-6)), float(step * np.ceil(top / step - 1e-6)), step


def usual_range(values: FloatArray) -> list[float]:
    """Return a range that shows the middle 90 % of the finite values, (N,): rest before a small relay would hide it."""
    values = values[np.isfinite(values)]
    if not values.size:
        return [0.0, 1.0]
    low, high = np.quantile(values, [0.05, 0.95])
    room = 0.6 * (high - low) or 1.0
    return [float(low - room), float(high + room)]


def axis_title(name: str, unit: str) -> str:
    """Return the title of an axis.

    Parameters
    ----------
    name : str
        Of the signal.
    unit : str
        Its unit; may be empty.
    """
    return f"{name} [{unit or 'unit not given'}]"


def ratio_title(name: str, over: str, under: str, and_under: str = "") -> str:
    """Return a name with the unit of a ratio, where both of its units are given.

    Parameters
    ----------
    name : str
        Of the ratio.
    over, under : str
        Units of its two parts; may be empty.
    and_under : str
        A further unit under the line.
    """
    if not (over and under):
        return name
    below = f"{under} {and_under}".strip()
    return f"{name} [{over}/{f'({below})' if ' ' in below or '/' in below else below}]"


def gain_phase(response: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return gain and continuous phase [deg] of a response, (N,) each; the first phase lies between -360 and 0."""
    phase_deg = np.degrees(np.unwrap(np.angle(response)))
    if phase_deg.size:
        phase_deg = phase_deg - 360.0 * np.floor((phase_deg[0] - 1e-9) / 360.0) - 360.0
    return np.abs(response), phase_deg


def gain_phase_bars(point: FrequencyPoint) -> tuple[float, float]:
    """Return the half-lengths of the 95 % bars of gain and phase [rad], from the covariance along and across."""
    gain_sd, phase_sd = polar_sd(point)
    return 1.96 * gain_sd * point.gain, 1.96 * phase_sd


def region(point: FrequencyPoint, factor: complex) -> ComplexArray:
    """Return the edge of the point's 95 % region times a complex factor.

    Parameters
    ----------
    point : FrequencyPoint
        With covariance.
    factor : complex
        What it is multiplied by, as by a controller's response.

    Returns
    -------
    (49,) complex array
        The closed edge.
    """
    radii, directions = point.region_radii(0.95)
    angle = np.linspace(0, 2 * np.pi, 49)
    edge = directions @ (radii[:, np.newaxis] * np.array([np.cos(angle), np.sin(angle)]))
    return np.asarray(factor * (point.response + edge[0] + 1j * edge[1]), dtype=np.complex128)
