"""The section of a run's page on its experiment: recordings, limit cycles and how they were spent."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from autotune.config.procedure import SignalSettings
from autotune.experiment.leaving import sentence
from autotune.experiment.result import ExperimentResult, Segment
from autotune.experiment.sweep_warnings import relative_sd
from autotune.experiment.timing import Timing
from autotune.identification.sweep_adequacy import TESTS
from autotune.identification.sweep_estimate import LEVEL
from autotune.recording import Recording
from autotune.report.chart import Chart, make_subplots
from autotune.report.figures import axis_title, recording_figure
from autotune.report.page import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Figure, Section, Table, add_line, thin_curve
from autotune.report.writing import number


def experiment_section(
    recordings: Sequence[Recording], experiment: ExperimentResult, signals: SignalSettings
) -> Section:
    """Return the section on a run's experiment.

    Parameters
    ----------
    recordings : sequence of Recording
        One for each part of the experiment.
    experiment : ExperimentResult
        Points, limit cycles and timing.
    signals : SignalSettings
        Names the units.
    """
    timing, parts = experiment.timing, experiment.parts
    figures = []
    for sitting, (recording, part) in enumerate(zip(recordings, parts, strict=True)):
        marks = [(s.start_s, f"{i + 1}") for i, s in enumerate(experiment.segments) if s.part == sitting]
        which = "The whole recording." if len(parts) == 1 else f"Sitting {sitting + 1}, {part.recording}."
        figures.append(
            Figure(
                figure=recording_figure(recording, signals.u_unit, signals.y_unit, marks=marks),
                caption=f"{which} Numbers mark where each limit cycle's evaluation begins.",
                height_px=460,
            )
        )
    sittings = Table(
        header=("sitting", "recording", "points", "on the rig [s]", "ended"),
        rows=tuple(
            (f"{i}", part.recording, f"{part.points}", f"{part.rig_time_s:.1f}", part.ended)
            for i, part in enumerate(parts, start=1)
        ),
    )
    return Section(
        title="The experiment",
        text=(
            f"The command that holds the operating point is {experiment.u_rest:.4g} ± {1.96 * experiment.u_rest_sd:.2g}"
            f" {signals.u_unit}; the measurement's noise has a standard deviation of {experiment.noise_sd:.3g}"
            f" {signals.y_unit}.",
            *_together_text(experiment),
            f"The sweep {_how_it_ended(experiment.reason)}; {sentence(experiment.output)}.",
            f"{_lateness(timing)}{timing.missed} sample(s) missed, {timing.unusable} unusable.",
        ),
        tables=(*((sittings,) if len(parts) > 1 else ()), _dwell_table(experiment)),
        figures=(
            *figures,
            Figure(
                figure=_cycles_figure(recordings, experiment.segments, signals),
                caption="Two periods of every limit cycle that a point was made from: y around its mean, over u.",
                height_px=420,
            ),
        ),
    )


def _together_text(experiment: ExperimentResult) -> tuple[str, ...]:
    """Say whether the points are of all rows together, and what the rows said of it."""
    found = experiment.together
    if found is None:
        return (f"Each point is of a limit cycle of its own: {experiment.by_itself}.",) if experiment.by_itself else ()
    tests = ", ".join(f"{what} (probability {p:.2g})" for what, p in zip(TESTS, found.p_values, strict=True))
    return (
        f"The points are estimated together from all rows between {found.start_s:.4g} and {found.end_s:.4g} s. What the"
        f" fitted equation leaves is noise: noise alone looks as much like {tests}. With probabilities so small that"
        f" noise gives them in {100 * LEVEL:.0f} of 100 sweeps each point would be measured by itself.",
    )


def _dwell_table(experiment: ExperimentResult) -> Table:
    """Return where the sweep's time went."""
    rows = []
    for i, one in enumerate(experiment.segments, start=1):
        dwell = f"{one.end_s - one.start_s:.1f}"
        cells = (f"{i}", f"{math.degrees(one.phase_rad):.0f}", f"{one.point.omega_rad_s:.3g}", f"{one.periods}", dwell)
        known = 100 * relative_sd(one)
        further = known * math.sqrt(one.periods / (one.periods + 1))
        rows.append((*cells, f"{number(known, 2)} %", f"{number(further, 2)} %"))
    header = ("cycle", "aimed at [deg]", "ω [rad/s]", "periods", "dwell [s]", "its own rows know its point to",
              "one period more, to")  # fmt: skip
    return Table(header=header, rows=tuple(rows))


def _lateness(timing: Timing) -> str:
    """Return how late samples and commands were; nothing of a rig whose clock waits for them."""
    if not any(timing.latency_s + timing.lateness_s):
        return ""
    return (
        f"Link latency {_milliseconds(timing.latency_s)}, lateness of the loop {_milliseconds(timing.lateness_s)},"
        f"{_decision(timing.decision_s)} (median, 99 %, worst); "
    )


def _decision(values: tuple[float, float, float]) -> str:
    """Return the time from a reading to its command, where the host computes it."""
    return f" from a reading to its command {_milliseconds(values)}" if math.isfinite(values[0]) else ""


def _how_it_ended(reason: str) -> str:
    return "came to its end" if reason == "completed" else f"was ended: {reason}"


def _milliseconds(values: tuple[float, float, float]) -> str:
    return " / ".join(number(1e3 * value, 2) for value in values) + " ms"


_CYCLE_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, GREY)


def _cycles_figure(recordings: Sequence[Recording], segments: Sequence[Segment], signals: SignalSettings) -> Chart:
    figure = make_subplots(rows=2, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.6, 0.4])
    for i, segment in enumerate(sorted(segments, key=lambda segment: segment.point.omega_rad_s)):
        period = 2 * math.pi / segment.point.omega_rad_s
        part = recordings[segment.part].between(max(segment.start_s, segment.end_s - 2 * period), segment.end_s)
        t = (part.t - part.t[0]) / period
        name, colour = f"{segment.point.omega_rad_s:.3g} rad/s", _CYCLE_COLOURS[i % len(_CYCLE_COLOURS)]
        y = part.y - np.nanmean(part.y)
        add_line(figure, *thin_curve(t, y, 600), name, colour, width=1.2, row=1, col=1)
        add_line(figure, *thin_curve(t, part.u, 600), name, colour, width=1.2, row=2, col=1, line_shape="hv")
    figure.update_xaxes(title="periods", row=2, col=1)
    figure.update_yaxes(title=axis_title("y - mean", signals.y_unit), row=1, col=1)
    figure.update_yaxes(title=axis_title("u", signals.u_unit), row=2, col=1)
    return figure
