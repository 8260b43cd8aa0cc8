"""What a controller rests on: the fitted plant run over the recordings, with its numbers and their intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from autotune.config.procedure import SignalSettings
from autotune.identification.parametric import PlantFit
from autotune.models import TransferFunction
from autotune.one_thread import on_one_thread
from autotune.recording import Recording
from autotune.report.chart import Chart
from autotune.report.figures import ratio_title, recording_figure
from autotune.report.free_run import forecast, free_run, share_explained
from autotune.report.page import GREEN, RED, Figure, Table, add_line, thin_curve

#: Plants that are drawn from the region for the intervals.
DRAWS = 200


@on_one_thread
def model_figures(fit: PlantFit, recordings: Sequence[Recording], signals: SignalSettings) -> tuple[Figure, ...]:
    """Return the recordings with the fitted plant run over them, each with its fit in per cent.

    Parameters
    ----------
    fit : PlantFit
        Plant.
    recordings : sequence of Recording
        Any of it; where the plant was fitted to them, the last third of each is also foretold from the rest alone.
    signals : SignalSettings
        Units.

    Notes
    -----
    The operating point and what was under way at the first row are fitted, nothing else is: one free run of the plant
    under the recorded command. The fit is 100 (1 - |y - simulated| / |y - mean|), the usual figure of identification.
    """
    figures = []
    for recording in recordings:
        simulated = free_run(fit.plant, recording)
        if simulated is None:
            continue
        chart = recording_figure(recording, signals.u_unit, signals.y_unit)
        add_line(chart, *thin_curve(recording.t, simulated), "fitted plant", GREEN, width=1.6, row=1, col=1)
        own = "the rows that it was fitted to" if fit.source == "recording" else "rows that its points came from"
        percent = share_explained(recording, simulated)
        caption = f"{recording.name}: the fitted plant runs freely over {own}, and explains {percent:.0f} % of y."
        if fit.source == "recording":
            caption += _forecast_of(fit, recording, chart, signals)
        figures.append(Figure(figure=chart, caption=caption))
    return tuple(figures)


def _forecast_of(fit: PlantFit, recording: Recording, chart: Chart, signals: SignalSettings) -> str:
    """Draw what the first rows alone make of the last ones, and return the sentence on it."""
    found = forecast(fit, recording)
    if found is None:
        return ""
    t, y = thin_curve(recording.t[found.first :], found.y[found.first :])
    add_line(chart, t, y, "forecast of unseen rows", RED, dash="dash", row=1, col=1)
    errors = (f"{value:.2g} {signals.y_unit}".strip() for value in (found.unseen, found.seen))
    return (
        " Unseen rows: a plant fitted to the first two thirds alone misses the last third by {} (root mean square),"
        " the rows that it saw by {}."
    ).format(*errors)


def numbers_table(fit: PlantFit, signals: SignalSettings) -> Table:
    """Return the plant's gain, lags and dead time with the ends of their 95 % intervals.

    Parameters
    ----------
    fit : PlantFit
        The fitted plant, with the region of its numbers.
    signals : SignalSettings
        Names the units.
    """
    drawn = [_numbers(plant) for plant in fit.draws(DRAWS, np.random.default_rng(0))]
    rows = []
    for i, (name, value) in enumerate(_numbers(fit.plant)):
        values = [one[i][1] for one in drawn if len(one) > i and one[i][0] == name]
        told = len(values) > 0.9 * len(drawn) and fit.covariance.any()
        low, high = np.quantile(values, [0.025, 0.975]) if told else (math.nan, math.nan)
        rows.append((_title(name, signals), f"{value:.4g}", f"{low:.4g} to {high:.4g}" if told else "not determined"))
    return Table(header=("fitted plant", "value", "95 %"), rows=tuple(rows))


def _title(name: str, signals: SignalSettings) -> str:
    if name.startswith("gain"):
        return ratio_title(name, signals.y_unit, f"{signals.u_unit} s" if "integrator" in name else signals.u_unit)
    return name


def _numbers(plant: TransferFunction) -> list[tuple[str, float]]:
    """Return a plant's numbers as people know them, lags from the longest."""
    gain = plant.num[-1] / plant.den[-1 - plant.integrators]
    named = [("gain of the integrator" if plant.integrators else "gain", float(gain))]
    poles = [p for p in np.atleast_1d(plant.poles) if p != 0.0 and p.imag >= 0.0]
    lags = sorted((-1.0 / p.real for p in poles if p.imag == 0.0), key=lambda lag: -lag)
    named += [(f"lag {i} [s]", float(lag)) for i, lag in enumerate(lags, 1)]
    for p in (p for p in poles if p.imag > 0.0):
        named += [("resonance [rad/s]", float(abs(p))), ("damping", float(-p.real / abs(p)))]
    return [*named, ("dead time [s]", float(plant.delay_s))]
