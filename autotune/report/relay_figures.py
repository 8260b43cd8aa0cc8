"""Tables I and II and figures 6 to 9 of Le & Mendes 2010 for any points and any controller."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from scipy.signal import cont2discrete

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.design.nugap import Validation
from autotune.design.rst import RST
from autotune.identification.reduction import ReducedModel
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint
from autotune.report.chart import make_subplots
from autotune.report.figures import Curve, bode_figure
from autotune.report.loop_diagrams import nichols_figure, sensitivity_figure
from autotune.report.page import BLUE, GREEN, ORANGE, PURPLE, RED, Figure, Page, Section, add_line
from autotune.report.relay_tables import PAPER_PI, Law, bandwidth_words, feedback, printed_tables, tables

_PHASE = math.radians(45.0)
#: Time after a step, over the slowest crossover; steps drawn and computed between them.
_SETTLING = 25.0
_STEPS, _SUBSTEPS = 1000, 8
_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, RED)


def relay_page(
    points: Sequence[FrequencyPoint],
    reduced: ReducedModel,
    plant: TransferFunction,
    controllers: Mapping[str, Law],
    validation: Validation,
    noise_gain: float,
    plant_name: str,
    rebuilt: RST | None = None,
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
    controllers : mapping of str to Controller or RST
        The first one is drawn on the reduced model and on the plant, all on the plant.
    validation : Validation
        Criterion (10) with the first controller.
    noise_gain : float
        N_max.
    plant_name : str
        What to call the plant.
    rebuilt : RST, optional
        The paper's RST, where the plant is the paper's (23): tables have what the paper prints beside.
    """
    corners = [abs(pole) for pole in plant.poles if abs(pole) > 0.0] + [point.omega_rad_s for point in points]
    omega = np.geomspace(0.02 * min(corners), 20.0 * max(corners), 800, dtype=np.float64)
    H_r = reduced.transfer_function()
    curves = [Curve(name="reduced model", system=H_r, colour=ORANGE), Curve(name=plant_name, system=plant, colour=BLUE)]
    estimates = [("measured", points, GREEN)] if points else []
    sign = 1 if reduced.G_r > 0 else -1
    first = next(iter(controllers.values()))
    # what lies where the loop's gain is below a thousandth, or of its largest, says nothing of the loop
    gain = np.abs(_loop(plant, first).response(omega))
    drawn_at = omega[gain > 1e-3 * min(1.0, float(gain.max()))]
    seven = [Curve(name="on the reduced model", system=_loop(H_r, first), colour=ORANGE, dash="dash"),
             Curve(name=f"on {plant_name}", system=_loop(plant, first), colour=BLUE)]  # fmt: skip
    drawn = {**controllers} if rebuilt is None else {**controllers, "PI of the paper": PAPER_PI, "RST": rebuilt}
    eight = [
        Curve(name=name, system=_loop(plant, c), colour=_COLOURS[i % len(_COLOURS)])
        for i, (name, c) in enumerate(drawn.items())
    ]
    of_tables = (
        tables(reduced, validation, controllers, plant, plant_name)
        if rebuilt is None
        else printed_tables(plant, reduced, validation, controllers, rebuilt, omega)
    )
    bode = Figure(
        figure=bode_figure(estimates, curves, drawn_at, sign, ""),
        caption="The reduced model's gain is nowhere below, its phase nowhere above, up to -180 degrees.",
    )
    said = (
        f"Criterion (10), nu-gap below the loop's stability margin, {'holds' if validation.holds else 'does not hold'}"
        f" at the scaling k = {validation.scaling:.3g}."
    )
    return Page(
        title="Le & Mendes 2010, relay with delay and robust PI: tables I and II, figures 6 to 9",
        verdict=" ".join([said, *filter(None, [bandwidth_words(plant, noise_gain, omega)])]),
        tone="good" if validation.holds else "bad",
        summary=(),
        sections=(
            *of_tables,
            Section(title="Figure 6: Bode diagrams", figures=(bode,)),
            Section(title="Figure 7: the first controller on model and plant", figures=_robust(seven, drawn_at)),
            Section(title=f"Figure 8: the controllers on {plant_name}", figures=_robust(eight, drawn_at)),
            Section(title="Figure 9: set-point step and load step", figures=(_responses(plant, drawn),)),
        ),
    )


def _responses(plant: TransferFunction, controllers: Mapping[str, Law]) -> Figure:
    """Draw y and u of the linear loop after a step of the set-point and, half way, a step of the load."""
    slowest = min(margins(plant, feedback(c)).crossover_rad_s for c in controllers.values())
    half_s = _SETTLING / slowest
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.6, 0.4])
    load = 0.0  # the first controller's own, and the same for all others
    for i, (name, controller) in enumerate(controllers.items()):
        t, y, u = step_responses(plant, controller, half_s, load)
        load = load or half_of_largest(u[: u.size // 2])
        for row, values in ((1, y), (2, u)):
            add_line(figure, t, values, name, _COLOURS[i % len(_COLOURS)], row=row, col=1, showlegend=row == 1)
    figure.update_yaxes(title="y", row=1, col=1)
    figure.update_yaxes(title="u", row=2, col=1)
    figure.update_xaxes(title="time [s]", row=2, col=1)
    return Figure(
        figure=figure,
        caption="A unit step of the set-point at 0, the same step of load at the plant's input for all half way; "
        "the linear loop, without limits or noise.",
        height_px=520,
    )


def step_responses(
    plant: TransferFunction, controller: Law, half_s: float, load: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return t, y and u of a loop after a unit set-point step at 0 and a load step at ``half_s``.

    Parameters
    ----------
    plant : TransferFunction
        Strictly proper; its dead time is rounded to a step.
    controller : PIDController, TransferFunction or RST
        Acts on the error; of an RST the set-point passes T.
    half_s : float
        Time of the load step, half of what is simulated [s].
    load : float
        Size of the load [u unit]; where it is 0, half of the largest command that the set-point step took.

    Returns
    -------
    t, y, u : (1001,) arrays
        The linear loop's.
    """
    law = _rational(controller)
    fine = 2.0 * half_s / _STEPS / _SUBSTEPS
    b, a = _sample(plant, fine, "zoh")
    d, c = _sample(law, fine, "bilinear")
    of_setpoint = TransferFunction(num=controller.T, den=controller.S) if isinstance(controller, RST) else law
    wanted = np.cumsum(_sample(of_setpoint, fine, "bilinear")[0])  # T of a set-point that is 1 from the first row on
    b = np.concatenate([np.zeros(round(plant.delay_s / fine)), b])
    y, u, count = np.zeros(_STEPS * _SUBSTEPS + 1), np.zeros(_STEPS * _SUBSTEPS + 1), _STEPS * _SUBSTEPS + 1
    at_plant, at_input = np.zeros(count), 0.0
    for k in range(count):
        y[k] = _next(b, at_plant, k) - _next(np.concatenate([[0.0], a[1:]]), y, k)
        u[k] = wanted[min(k, wanted.size - 1)] - _next(d, y, k) - _next(np.concatenate([[0.0], c[1:]]), u, k)
        if k == count // 2:
            at_input = load or half_of_largest(u[:k])
        at_plant[k] = u[k] + at_input
    thin = slice(None, None, _SUBSTEPS)
    return fine * np.arange(count, dtype=np.float64)[thin], y[thin], u[thin]


def half_of_largest(u: FloatArray) -> float:
    """Return half of the largest of some commands, with its sign."""
    return float(0.5 * u[int(np.argmax(np.abs(u)))])


def _sample(
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


def _rational(controller: Law) -> TransferFunction:
    part = feedback(controller)
    part = part.transfer_function() if isinstance(part, PIDController) else part
    assert isinstance(part, TransferFunction)
    return part


def _loop(plant: TransferFunction, controller: Law) -> TransferFunction:
    return plant * _rational(controller)


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
