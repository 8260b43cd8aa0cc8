"""The section of an analysis on its points: the Bode diagram and the tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from autotune.arrays import FloatArray
from autotune.config.procedure import SignalSettings
from autotune.pipeline import Analysis
from autotune.points import FrequencyPoint
from autotune.report.figures import (
    Curve,
    bode_figure,
    frequencies,
    gain_phase,
)
from autotune.report.page import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Figure, Section, Table
from autotune.report.writing import number

if TYPE_CHECKING:  # a page from recordings is written without what runs a rig
    from autotune.experiment.result import ExperimentResult


def frequency_grid(analysis: Analysis, decades: float) -> FloatArray:
    """Return the frequencies of a figure [rad/s]: around the points, or around the crossover for a fit in time.

    Parameters
    ----------
    analysis : Analysis
        With points or a crossover.
    decades : float
        How far it goes on beyond them.

    Returns
    -------
    (400,) array
        Angular frequencies [rad/s].
    """
    if analysis.points and analysis.fit.source == "points":
        return frequencies(analysis.points, decades)
    crossover = analysis.margins.crossover_rad_s
    low, high = crossover * 10 ** (-decades - 1.0), crossover * 10 ** (decades + 0.3)
    at = [point.omega_rad_s for point in analysis.points]  # a curve ends at no point that it is drawn with
    return np.geomspace(min([low, *at]), max([high, *(1.2 * omega for omega in at)]), 400, dtype=np.float64)


def points_section(analysis: Analysis, signals: SignalSettings, experiment: ExperimentResult | None) -> Section:
    """Return the section on the points of an analysis.

    Parameters
    ----------
    analysis : Analysis
        With points and fit.
    signals : SignalSettings
        Names the units.
    experiment : ExperimentResult or None
        For the comparison with describing functions.
    """
    sign = analysis.fit.sign
    omega = frequency_grid(analysis, 0.7)
    estimates = _by_source(analysis.points)
    compared = _described_table(analysis.points, sign, experiment) if experiment else None
    gain_unit = f"{signals.y_unit}/{signals.u_unit}" if signals.u_unit and signals.y_unit else ""
    curves = (
        Curve(name="fitted plant", system=analysis.fit.plant, colour=GREY, dash="dot"),
        *([] if analysis.reduced is None else [Curve(name="reduced model", system=analysis.reduced, colour=GREEN)]),
    )
    return Section(
        title="Bode points",
        text=(
            "Each point is the ratio of the recorded measurement's Fourier coefficient to that of the recorded,"
            " held command over whole periods; its region counts the noise that was found beside the oscillation."
            if all(point.source in _RELAY_SOURCES for point in analysis.points)
            else "All points are of the differential equation with dead time that was fitted to all rows of the sweep,"
            " averaged over its orders: their errors go together. Each region counts the noise, and what the orders"
            " differ by."
            if is_of_rows(analysis)
            else "Colours tell the estimates apart: relay points come from whole periods of a limit cycle,"
            " closed-loop points from a model of the loop under control, others from a band of frequencies. Each"
            " region counts the noise of its own experiment."
            if len({point.source in _RELAY_SOURCES for point in analysis.points}) > 1
            else "Each point is estimated over a band of frequencies, leakage and drift removed; its region counts"
            " the noise in that band.",
        ),
        tables=(_points_table(analysis.points, sign, gain_unit),),
        figures=(
            Figure(
                figure=bode_figure(estimates, curves, omega, sign, gain_unit),
                caption=("Gain and phase, the phase for the positive gain." if sign < 0 else "Gain and phase.")
                + _bound_text(analysis),
                height_px=560,
            ),
        ),
        details=(
            "The first-harmonic formulas trust the delay that was asked for and the relay's ideal wave; their error"
            " against the recorded signals:",
        )
        if compared
        else (),
        detail_tables=(compared,) if compared else (),
    )


def _bound_text(analysis: Analysis) -> str:
    """Return what the reduced model bounds, as far as the figure shows it."""
    if analysis.reduced is None:
        return ""
    omega = np.array([point.omega_rad_s for point in analysis.points])
    sign = analysis.fit.sign
    gain, phase = gain_phase(sign * analysis.reduced.response(omega))
    at, lag = gain_phase(np.array([sign * point.response for point in analysis.points], dtype=np.complex128))
    bounded = (gain >= at) & ((phase <= lag) | (lag < -180.0))
    if not bounded.all():
        return (
            f" The reduced model lies above the gain and below the phase of {int(bounded.sum())} of {omega.size}"
            " points; it bounds the plants that fit all points together."
        )
    until = "" if (phase <= lag).all() else " down to -180 deg, which is as far as the margins need it"
    return (
        f" The reduced model lies above the gain and below the phase of the points{until}: margins that a controller"
        " keeps on it hold for the plant."
    )


_RELAY_SOURCES = ("relay", "harmonic")
_SOURCE_COLOURS = {"relay": BLUE, "harmonic": BLUE, "closed loop": ORANGE, "local polynomial": RED, "spectral": PURPLE}


def _by_source(points: Sequence[FrequencyPoint]) -> list[tuple[str, Sequence[FrequencyPoint], str]]:
    """Return the points in groups of one source and colour, a relay's harmonics with it."""
    groups: dict[str, list[FrequencyPoint]] = {}
    for point in points:
        groups.setdefault("relay" if point.source in _RELAY_SOURCES else point.source, []).append(point)
    if len(groups) == 1:
        return [("measured, 95 %", points, BLUE)]
    return [(f"{name}, 95 %", group, _SOURCE_COLOURS.get(name, GREY)) for name, group in groups.items()]


def _points_table(points: Sequence[FrequencyPoint], sign: int, gain_unit: str) -> Table:
    _, phases = gain_phase(np.array([sign * point.response for point in points], dtype=np.complex128))
    rows = []
    for point, phase in zip(points, phases, strict=True):
        sd = math.sqrt(np.trace(np.array(point.covariance)) / 2.0) / point.gain
        half = 1.96 * max(sd, 1e-6)
        gain = f"{point.gain:.{min(2 - math.floor(math.log10(half)), 5)}g}"  # as far as the interval tells, and a digit
        turned = f"{phase:.{min(max(1 - math.floor(math.log10(math.degrees(half))), 0), 2)}f}"
        told = (f"{number(196 * sd, 2)} %", number(math.degrees(1.96 * sd), 2))
        rows.append((f"{point.omega_rad_s:.4g}", gain, turned, *told, point.source))
    title = f"gain [{gain_unit}]" if gain_unit else "gain"
    header = ("ω [rad/s]", title, "phase [deg]", "gain ±95 %", "phase ±95 % [deg]", "kind")
    return Table(header=header, rows=tuple(rows))


def _described_table(points: Sequence[FrequencyPoint], sign: int, experiment: ExperimentResult) -> Table | None:
    """Return the error of the describing function's estimates, where the experiment was a relay's."""
    described = {segment.point.omega_rad_s: segment.describing for segment in experiment.segments}
    rows = []
    for point in points:
        found = described.get(point.omega_rad_s)
        if found is not None:
            turned = _wrap_angle(found.phase_rad - float(np.angle(sign * point.response)))
            gain = f"{100 * (found.gain / point.gain - 1):+.0f} %"
            rows.append((f"{point.omega_rad_s:.4g}", gain, f"{math.degrees(turned):+.1f}"))
    return Table(header=("ω [rad/s]", "gain error", "phase error [deg]"), rows=tuple(rows)) if rows else None


def _wrap_angle(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def is_of_rows(analysis: Analysis) -> bool:
    """Whether all points were estimated together, from the rows of a sweep."""
    return bool(analysis.points) and all(point.source == "sweep" for point in analysis.points)
