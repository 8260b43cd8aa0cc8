"""Diagrams of an open loop with its required margins: Nyquist, Black-Nichols, sensitivity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.arrays import FloatArray
from autotune.points import FrequencyPoint
from autotune.report import chart as go
from autotune.report.figures import Curve, Responds, gain_phase, region
from autotune.report.page import BLUE, GREY, RED, add_line


def nyquist_figure(
    loops: Sequence[Curve],
    points: Sequence[FrequencyPoint],
    controller: Responds,
    omega: FloatArray,
    modulus_margin: float,
) -> go.Chart:
    """Draw loops L = H C with the circle of the modulus margin, and the measured points times C with their regions.

    Parameters
    ----------
    loops : sequence of Curve
        Open loops.
    points : sequence of FrequencyPoint
        Of the plant; they are multiplied by the controller.
    controller : Responds
        C.
    omega : (N,) array
        Grid [rad/s].
    modulus_margin : float
        Radius of the circle around -1 that the loops must not enter.
    """
    figure = go.Chart()
    angle = np.linspace(0, 2 * np.pi, 181)
    circle = -1 + modulus_margin * np.exp(1j * angle)
    add_line(figure, circle.real, circle.imag, f"modulus margin {modulus_margin:g}", RED, dash="dot")
    add_line(figure, np.cos(angle), np.sin(angle), "gain 1", GREY, dash="dot", width=1.0)
    for curve in loops:
        response = curve.system.response(omega)
        near = np.abs(response) < 6.0
        add_line(figure, response.real[near], response.imag[near], curve.name, curve.colour, dash=curve.dash)
    for i, point in enumerate(points):
        C = complex(controller.response(np.array([point.omega_rad_s]))[0])
        edge = region(point, C)
        add_line(figure, edge.real, edge.imag, "95 % regions of the points", BLUE, width=1.0, showlegend=i == 0)
        figure.add_trace(
            go.Scatter(
                x=[(C * point.response).real],
                y=[(C * point.response).imag],
                mode="markers",
                marker={"color": BLUE, "size": 6},
                showlegend=False,
                name="point",
            )
        )
    figure.add_trace(
        go.Scatter(x=[-1], y=[0], mode="markers", marker={"symbol": "cross", "color": RED, "size": 10}, name="-1")
    )
    figure.update_xaxes(title="real part of L", range=[-2.4, 1.2], dtick=0.5, constrain="domain")
    figure.update_yaxes(
        title="imaginary part of L", range=[-2.4, 1.2], dtick=0.5, scaleanchor="x", scaleratio=1, constrain="domain"
    )
    return figure


def nichols_figure(
    loops: Sequence[Curve], omega: FloatArray, modulus_margin: float, phase_margin_rad: float
) -> go.Chart:
    """Draw loops in the Black-Nichols plane: gain in dB over phase, with the required margins.

    Parameters
    ----------
    loops : sequence of Curve
        The open loops.
    omega : (N,) array
        Angular frequencies [rad/s].
    modulus_margin : float
        As required.
    phase_margin_rad : float
        As required [rad].
    """
    figure = go.Chart()
    circle = -1 + modulus_margin * np.exp(1j * np.linspace(0, 2 * np.pi, 181))
    phase_deg = np.degrees(np.angle(circle)) % 360 - 360
    add_line(figure, phase_deg, 20 * np.log10(np.abs(circle)), f"modulus margin {modulus_margin:g}", RED, dash="dot")
    for curve in loops:
        gain, phase = gain_phase(curve.system.response(omega))
        add_line(figure, phase, 20 * np.log10(gain), curve.name, curve.colour, dash=curve.dash)
    margin_deg = float(np.degrees(phase_margin_rad))
    figure.add_trace(
        go.Scatter(
            x=[-180, -180 + margin_deg],
            y=[0, 0],
            mode="lines+markers",
            line={"color": RED, "width": 3},
            name=f"phase margin {margin_deg:.0f} deg",
        )
    )
    figure.update_xaxes(title="phase of L [deg]", range=[-275, -80], dtick=45)
    figure.update_yaxes(title="gain of L [dB]", range=[-33, 33], dtick=10)
    return figure


def sensitivity_figure(loops: Sequence[Curve], omega: FloatArray, modulus_margin: float) -> go.Chart:
    """Draw abs(S) in dB with the bound that the modulus margin sets, the inverse of it.

    Parameters
    ----------
    loops : sequence of Curve
        The open loops.
    omega : (N,) array
        Angular frequencies [rad/s].
    modulus_margin : float
        As required.
    """
    figure = go.Chart()
    for curve in loops:
        S = 1.0 / (1.0 + curve.system.response(omega))
        add_line(figure, omega, 20 * np.log10(np.abs(S)), curve.name, curve.colour, dash=curve.dash)
    bound = np.full(2, -20 * np.log10(modulus_margin))
    add_line(figure, omega[[0, -1]], bound, f"bound of modulus margin {modulus_margin:g}", RED, dash="dot")
    figure.update_xaxes(title="angular frequency [rad/s]", type="log")
    figure.update_yaxes(title="sensitivity |S| [dB]")
    return figure
