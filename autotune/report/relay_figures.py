"""Tables I and II and figures 6 to 9 of Le & Mendes 2010 for any points and any controller."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from scipy.signal import cont2discrete

from autotune.arrays import FloatArray
from autotune.controller import Controller, PIDController
from autotune.design.margins import margins
from autotune.design.nugap import Validation
from autotune.identification.reduction import ReducedModel
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint
from autotune.report.chart import make_subplots
from autotune.report.figures import Curve, bode_figure, nichols_figure, sensitivity_figure
from autotune.report.page import BLUE, GREEN, ORANGE, PURPLE, Figure, Page, Section, Table, add_line

_PHASE = math.radians(45.0)
#: Time after a step, over the slowest crossover; steps drawn and computed between them.
_SETTLING = 25.0
_STEPS, _SUBSTEPS = 1000, 8


def bandwidth_limit(plant: TransferFunction, noise_gain: float, omega: FloatArray) -> float:
    """Return the highest crossover that a controller whose gain stays below N_max can have, (26) [rad/s].

    Parameters
    ----------
    plant : TransferFunction
        H.
    noise_gain : float
        N_max.
    omega : (N,) array
        Ascending grid [rad/s].

    Returns
    -------
    float
        Where abs(H) = 1/N_max, read off the plant itself; the paper continues its slope of -40 dB per decade at the
        plant's own crossover, which gives 4.15 rad/s for (23) and N_max = 0.1. NaN where the grid does not show it.
    """
    above = np.flatnonzero(np.abs(plant.response(omega)) * noise_gain >= 1.0)
    if above.size == 0 or above[-1] == omega.size - 1:
        return math.nan
    at = slice(above[-1], above[-1] + 2)
    gains = np.log(np.abs(plant.response(omega[at])) * noise_gain)
    return float(np.exp(np.interp(0.0, gains[::-1], np.log(omega[at])[::-1])))


def relay_page(
    points: Sequence[FrequencyPoint],
    reduced: ReducedModel,
    plant: TransferFunction,
    controllers: Mapping[str, Controller],
    validation: Validation,
    noise_gain: float,
    plant_name: str,
) -> Page:
    """Return the page with both tables and the four figures.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        Measured; empty where the plant was known.
    reduced : ReducedModel
        Of the points or of the plant.
    plant : TransferFunction
        What margins are computed on: the plant where it is known, else what was fitted to the points.
    controllers : mapping of str to Controller
        The first one is drawn on the reduced model and on the plant, all on the plant.
    validation : Validation
        Criterion (10) with the first controller.
    noise_gain : float
        N_max.
    plant_name : str
        What to call the plant.
    """
    corners = [abs(pole) for pole in plant.poles if abs(pole) > 0.0] + [point.omega_rad_s for point in points]
    omega = np.geomspace(0.02 * min(corners), 20.0 * max(corners), 800, dtype=np.float64)
    H_r = reduced.transfer_function()
    curves = [Curve(name="reduced model", system=H_r, colour=ORANGE), Curve(name=plant_name, system=plant, colour=BLUE)]
    estimates = [("measured", points, GREEN)] if points else []
    sign = 1 if reduced.G_r > 0 else -1
    first = next(iter(controllers.values()))
    seven = [Curve(name="on the reduced model", system=_loop(H_r, first), colour=ORANGE, dash="dash"),
             Curve(name=f"on {plant_name}", system=_loop(plant, first), colour=BLUE)]  # fmt: skip
    colours = (BLUE, ORANGE, GREEN, PURPLE)
    eight = [
        Curve(name=name, system=_loop(plant, c), colour=colours[i % 4])
        for i, (name, c) in enumerate(controllers.items())
    ]
    limit = bandwidth_limit(plant, noise_gain, omega)
    shown = (
        "" if math.isnan(limit) else f" No gain up to {noise_gain:g} lets the loop cross above {limit:.3g} rad/s, (26)."
    )
    bode = Figure(
        figure=bode_figure(estimates, curves, omega, sign, ""),
        caption="The reduced model's gain is nowhere below, its phase nowhere above, up to -180 degrees.",
    )
    return Page(
        title="Relay with delay, reduced model and PI: tables I and II, figures 6 to 9",
        verdict=f"Criterion (10) {'holds' if validation.holds else 'does not hold'} at the scaling "
        f"{validation.scaling:.3g}.{shown}",
        tone="good" if validation.holds else "bad",
        summary=(),
        sections=(
            Section(title="Table I: the reduced model", tables=(_table_1(reduced, validation),)),
            Section(title="Table II: the controllers", tables=(_table_2(controllers, plant, plant_name),)),
            Section(title="Figure 6: Bode diagrams", figures=(bode,)),
            Section(title="Figure 7: the first controller on model and plant", figures=_robust(seven, omega)),
            Section(title=f"Figure 8: the controllers on {plant_name}", figures=_robust(eight, omega)),
            Section(title="Figure 9: set-point step and load step", figures=(_responses(plant, controllers, colours),)),
        ),
    )


def _responses(plant: TransferFunction, controllers: Mapping[str, Controller], colours: Sequence[str]) -> Figure:
    """Draw y and u of the linear loop after a step of the set-point and, half way, a step of the load."""
    slowest = min(margins(plant, c).crossover_rad_s for c in controllers.values())
    half_s = _SETTLING / slowest
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.6, 0.4])
    for i, (name, controller) in enumerate(controllers.items()):
        t, y, u = step_responses(plant, controller, half_s)
        for row, values in ((1, y), (2, u)):
            add_line(figure, t, values, name, colours[i % len(colours)], row=row, col=1, showlegend=row == 1)
    figure.update_yaxes(title="y", row=1, col=1)
    figure.update_yaxes(title="u", row=2, col=1)
    figure.update_xaxes(title="time [s]", row=2, col=1)
    return Figure(
        figure=figure,
        caption="A unit step of the set-point at 0, a step of load at the plant's input half way; the linear loop, "
        "without limits or noise.",
        height_px=520,
    )


def step_responses(
    plant: TransferFunction, controller: Controller, half_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return t, y and u of a loop after a unit set-point step at 0 and a load step at ``half_s``.

    Parameters
    ----------
    plant : TransferFunction
        Strictly proper; its dead time is rounded to a step.
    controller : PIDController or TransferFunction
        Acts on the error.
    half_s : float
        Time of the load step, half of what is simulated [s].

    Returns
    -------
    t, y, u : (1001,) arrays
        The load is half of the largest command that the set-point step took, with the sign that command had.
    """
    law = controller.transfer_function() if isinstance(controller, PIDController) else controller
    assert isinstance(law, TransferFunction)
    fine = 2.0 * half_s / _STEPS / _SUBSTEPS
    b, a = _sampled(plant, fine, "zoh")
    d, c = _sampled(law, fine, "bilinear")
    b = np.concatenate([np.zeros(round(plant.delay_s / fine)), b])
    y, u, count = np.zeros(_STEPS * _SUBSTEPS + 1), np.zeros(_STEPS * _SUBSTEPS + 1), _STEPS * _SUBSTEPS + 1
    at_plant, load = np.zeros(count), 0.0
    for k in range(count):
        y[k] = _next(b, at_plant, k) - _next(np.concatenate([[0.0], a[1:]]), y, k)
        u[k] = _next(d, 1.0 - y, k) - _next(np.concatenate([[0.0], c[1:]]), u, k)
        if k == count // 2:
            load = 0.5 * u[int(np.argmax(np.abs(u[: k + 1])))]
        at_plant[k] = u[k] + load
    thin = slice(None, None, _SUBSTEPS)
    return fine * np.arange(count, dtype=np.float64)[thin], y[thin], u[thin]


def _sampled(
    system: TransferFunction, step_s: float, method: Literal["zoh", "bilinear"]
) -> tuple[FloatArray, FloatArray]:
    """Return numerator and denominator in ascending powers of the delay operator, dead time left out."""
    given = np.array(system.num, dtype=np.float64), np.array(system.den, dtype=np.float64)
    found = cont2discrete(given, step_s, method=method)
    num, den = np.real(np.ravel(found[0])), np.real(np.ravel(found[1]))
    return np.asarray(num / den[0], dtype=np.float64), np.asarray(den / den[0], dtype=np.float64)


def _next(weights: FloatArray, signal: FloatArray, k: int) -> float:
    """Return the sum of weights[i] signal[k - i]."""
    known = min(len(weights), k + 1)
    return float(weights[:known] @ signal[k::-1][:known]) if k else float(weights[0] * signal[0])


def _loop(plant: TransferFunction, controller: Controller) -> TransferFunction:
    part = controller.transfer_function() if isinstance(controller, PIDController) else controller
    assert isinstance(part, TransferFunction)
    return plant * part


def _robust(curves: list[Curve], omega: FloatArray) -> tuple[Figure, ...]:
    return (
        Figure(
            figure=nichols_figure(curves, omega, 0.5, _PHASE),
            caption="Black-Nichols: outside the dotted curve the modulus margin is at least 0.5, right of the bar "
            "at 0 dB the phase margin at least 45 degrees.",
        ),
        Figure(
            figure=sensitivity_figure(curves, omega, 0.5),
            caption="Sensitivity: below the dotted line the modulus margin is at least 0.5.",
        ),
    )


def _table_1(reduced: ReducedModel, found: Validation) -> Table:
    lag = "none (24)" if reduced.omega_0r_rad_s is None else f"{reduced.omega_0r_rad_s:.4g}"
    values = (reduced.G_r, reduced.omega_d_rad_s, found.nu_gap, found.b_reduced, found.b_rig)
    cells = [f"{value:.4g}" for value in values]
    return Table(
        caption="Reduced model and criterion (10): nu-gap < b(C, H_r) <= b(C, H).",
        header=("G_r", "omega_0r [rad/s]", "omega_d [rad/s]", "nu-gap", "b(C, H_r)", "b(C, H)"),
        rows=((cells[0], lag, *cells[1:]),),
    )


def _table_2(controllers: Mapping[str, Controller], plant: TransferFunction, plant_name: str) -> Table:
    rows = []
    for name, controller in controllers.items():
        m = margins(plant, controller)
        gains = ("", "")
        if isinstance(controller, PIDController):
            gains = f"{controller.K:.4g}", f"{controller.Ti_s:.4g}"
        figures = (m.modulus, math.degrees(m.phase_rad), m.noise_gain, m.delay_s, m.crossover_rad_s, m.h2)
        rows.append((name, *gains, *(f"{value:.4g}" for value in figures)))
    return Table(
        caption=f"Margins on {plant_name}.",
        header=("", "K", "T_I [s]", "M_m", "phase [deg]", "N_max", "M_ret [s]", "omega_gc [rad/s]", "H2 (11)"),
        rows=tuple(rows),
    )
