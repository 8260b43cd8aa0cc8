"""Tables I and II and figures 6 to 8 of Le & Mendes 2010 for any points and any controller."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import Controller, PIDController
from autotune.design.margins import margins
from autotune.design.nugap import Validation
from autotune.identification.reduction import ReducedModel
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint
from autotune.report.figures import Curve, bode_figure, nichols_figure, sensitivity_figure
from autotune.report.page import BLUE, GREEN, ORANGE, PURPLE, Figure, Page, Section, Table

_PHASE = math.radians(45.0)


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
    """Return the page with both tables and the three figures.

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
        title="Relay with delay, reduced model and PI: tables I and II, figures 6 to 8",
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
        ),
    )


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
