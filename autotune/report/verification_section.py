"""The section of a run's page on its verification: what was asked, predicted and measured."""

from __future__ import annotations

import math

import numpy as np

from autotune.config.procedure import SignalSettings
from autotune.experiment.judgement import Verification, smooth_steps
from autotune.experiment.step_test import StepTest
from autotune.report.chart import Chart, make_subplots
from autotune.report.figures import axis_title, ratio_title
from autotune.report.page import BLUE, GREEN, GREY, ORANGE, RED, Figure, Section, Table, add_line, thin_curve
from autotune.report.writing import sentence


def verification_section(verification: Verification, signals: SignalSettings) -> Section:
    """Return the section on a run's verification.

    Parameters
    ----------
    verification : Verification
        Test, prediction and measurement.
    signals : SignalSettings
        Names the units.
    """
    measured, predicted, sd = verification.measured, verification.predicted, verification.predicted_sd
    unit = signals.y_unit
    rows = (
        ("overshoot [%]", _percent(measured.overshoot), _percent(predicted.overshoot), _percent(sd.overshoot)),
        ("rise to 90 % [s]", measured.rise_s, predicted.rise_s, sd.rise_s),
        (f"peak under load [{unit}]", measured.peak, predicted.peak, sd.peak),
        (
            ratio_title("H2 over the load step", f"{unit} √s" if unit else "", signals.u_unit),
            measured.h2,
            predicted.h2,
            sd.h2,
        ),
    )
    return Section(
        title="Verification",
        text=(
            _test_text(verification.test, signals),
            sentence(f"{verification.whose}: {verification.reason}"),
            *((sentence(law.sentence),) if (law := verification.running_law) is not None else ()),
        ),
        tables=(
            Table(
                header=("", "measured", "predicted", "predicted scatter (sd)"),
                rows=tuple(
                    (name, *(f"{value:.3g}" if math.isfinite(value) else "-" for value in values))
                    for name, *values in rows
                    if any(map(math.isfinite, values))
                ),
                caption="Of the smoothed responses; what is left of the noise is in the scatter.",
            ),
        ),
        figures=(
            Figure(
                figure=_step_figure(verification, signals),
                caption="Measured loop and the band that holds 95 % of what plant uncertainty and noise predict:"
                f" set-point step on the left half, {'load step' if _has_load(verification.test) else 'and back'}"
                " on the right.",
                height_px=500,
            ),
        ),
    )


def _percent(share: float) -> float:
    """Return a share in per cent; one of last bits is none."""
    return round(100.0 * share, 9)


def _test_text(test: StepTest, signals: SignalSettings) -> str:
    step = f"Set-point step of {test.setpoint[0]:.3g} {signals.y_unit}"
    if not _has_load(test):
        return f"{step}, then back; no load was tried, as none is mapped in [rig]."
    return f"{step}, then a load of {test.disturbance[-1]:.3g} {signals.u_unit} added to the command."


def _has_load(test: StepTest) -> bool:
    return float(test.disturbance[-1]) != 0.0


def _step_figure(verification: Verification, signals: SignalSettings) -> Chart:
    test, prediction = verification.test, verification.prediction
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.65, 0.35])
    edge = slice(None, None, max(1, test.t.size // 600))
    add_line(figure, test.t[edge], prediction.low[edge], "low", GREEN, width=0.4, row=1, col=1, showlegend=False)
    add_line(
        figure, test.t[edge], prediction.high[edge], "95 % band", GREEN, width=0.4, row=1, col=1,
        fill="tonexty", fillcolor="rgba(13,154,114,0.18)",
    )  # fmt: skip
    add_line(figure, *thin_curve(test.t, verification.y), "measured", "rgba(59,130,196,0.45)", width=0.8, row=1, col=1)
    usable = np.isfinite(verification.y)
    filled = np.interp(test.t, test.t[usable], verification.y[usable])
    add_line(figure, *thin_curve(test.t, smooth_steps(filled, test)), "measured, smoothed", BLUE, row=1, col=1)
    add_line(figure, *thin_curve(test.t, prediction.y), "predicted", RED, row=1, col=1)
    add_line(figure, test.t[edge], test.setpoint[edge], "set-point", GREY, dash="dash", row=1, col=1)
    early = slice(0, max(test.disturbed_from // 10, 1))
    rest = float(np.median(verification.u[early] - prediction.u[early]))  # the command that holds the operating point
    add_line(figure, *thin_curve(test.t, verification.u - rest), "u of the law", ORANGE, width=1.0, row=2, col=1)
    add_line(figure, *thin_curve(test.t, prediction.u), "predicted u", RED, row=2, col=1, showlegend=False)
    figure.update_yaxes(title=axis_title("y - operating point", signals.y_unit), row=1, col=1)
    figure.update_yaxes(title=axis_title("Δu", signals.u_unit), row=2, col=1)
    figure.update_xaxes(title="time [s]", row=2, col=1)
    return figure
