"""The page of a run: recording, limit cycles, Bode points, reduced model, margins, and the loop measured on the rig."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from autotune.config.procedure import SignalSettings
from autotune.controller import PIDController
from autotune.diagnosis.result import Diagnosis
from autotune.experiment.judgement import Verification, smoothed
from autotune.experiment.leaving import sentence
from autotune.experiment.result import ExperimentResult, Segment
from autotune.experiment.step_test import StepTest
from autotune.experiment.sweep_warnings import relative_sd
from autotune.identification.sweep_adequacy import TESTS
from autotune.identification.sweep_estimate import LEVEL
from autotune.pipeline import Analysis, Tuning
from autotune.pipeline.deployment import Deployment
from autotune.recording import Recording
from autotune.report.analysis_sections import analysis_sections, based_on, designed_text, gains_text, margins_sentence
from autotune.report.chart import Chart, make_subplots
from autotune.report.figures import axis_title, ratio_title, recording_figure
from autotune.report.outlook import model_figures, numbers_table, outlook_section
from autotune.report.page import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Figure, Page, Section, Table, add_line, thinned


def run_page(
    name: str,
    signals: SignalSettings,
    recordings: Sequence[Recording],
    tuning: Tuning,
    diagnosis: Diagnosis | None = None,
    *,
    dry_run: bool = False,
) -> Page:
    """Return the page of a whole run on a rig.

    Parameters
    ----------
    name : str
        Of the rig, from the configuration.
    signals : SignalSettings
        Units.
    recordings : sequence of Recording
        The sweep's, one for each sitting at the rig.
    tuning : Tuning
        What the run ended with.
    diagnosis : Diagnosis, optional
        What the fitted plant leaves out; its own page is in ``diagnosis/report.html`` beside this one.
    dry_run : bool
        Whether the rig's simulated twin took its place.
    """
    experiment, verification = tuning.experiment, tuning.verification
    sections = [] if verification is None else [_verification_section(verification, signals)]
    if diagnosis is not None:
        sections.append(_diagnosis_section(diagnosis))
    if verification is None:
        sections += outlook_section(tuning.analysis, signals, tuning.old_controller)
    sections += reversed(analysis_sections(tuning.analysis, signals, experiment))
    sections.append(_experiment_section(recordings, experiment, signals))
    sections += _warnings_sections((*experiment.warnings, *tuning.analysis.warnings))
    verdict, good = _verdict(tuning, signals, dry_run)
    return Page(
        title=f"Rehearsal: {name}" if dry_run else f"Commissioning: {name}",
        verdict=verdict,
        tone="good" if good else "bad" if verification is not None else "warn",
        answers=_answers(tuning, signals, diagnosis),
        sections=tuple(sections),
    )


def analysis_page(
    name: str, signals: SignalSettings, recordings: Sequence[Recording], analysis: Analysis, notes: Sequence[str] = ()
) -> Page:
    """Return the page of a design from recordings, without a rig.

    Parameters
    ----------
    name : str
        Title.
    signals : SignalSettings
        Units.
    recordings : sequence of Recording
        What the points were made from; may be empty.
    analysis : Analysis
        Points, model and controller.
    notes : sequence of str
        What was left out or corrected on the way to the points.
    """
    figures = tuple(
        Figure(figure=recording_figure(recording, signals.u_unit, signals.y_unit), caption=recording.name)
        for recording in recordings
    )
    figures = model_figures(analysis.fit, recordings, signals) or figures
    tables = (numbers_table(analysis.fit, signals),)
    first = (Section(title="The plant over the recordings", figures=figures, tables=tables),) if figures else ()
    sections = (
        *outlook_section(analysis, signals),
        *reversed(analysis_sections(analysis, signals, None)),
        *first,
        *_warnings_sections((*notes, *analysis.warnings)),
    )
    return Page(
        title=f"Controller from recordings: {name}",
        verdict=f"{designed_text(analysis.design, signals)}: not yet tried on the rig.",
        tone="warn",
        answers=(
            ("Found", f"{designed_text(analysis.design, signals)}, {based_on(analysis)}."),
            ("How sure", margins_sentence(analysis, signals)),
            (
                "What to do",
                "Try it on the rig, or have autotune deploy and verify do so, before the loop is left to it.",
            ),
        ),
        sections=sections,
    )


def stopped_page(name: str, signals: SignalSettings, recordings: Sequence[Recording], line: str) -> Page:
    """Return the page of a run that a limit, a fault or the operator stopped: why, and how the rig was left.

    Parameters
    ----------
    name : str
        Of the rig.
    signals : SignalSettings
        Units.
    recordings : sequence of Recording
        What was recorded, the last one last.
    line : str
        The one line that the run ended with.
    """
    figures = tuple(
        Figure(figure=recording_figure(recording, signals.u_unit, signals.y_unit), caption=recording.name)
        for recording in recordings
    )
    output = recordings[-1].metadata.get("ended", {}).get("output", "") if recordings else None
    left = f"When it was left: {sentence(output)}." if output is not None else "Nothing was recorded."
    return Page(
        title=f"Stopped: {name}",
        verdict=f"Stopped: {line}",
        tone="bad",
        summary=(left, "Nothing that was measured is lost: autotune run --resume goes on with what is missing."),
        sections=(Section(title="What was recorded", figures=figures),) if figures else (),
    )


def deployment_page(name: str, signals: SignalSettings, done: Deployment) -> Page:
    """Return the page of a hand-over of gains.

    Parameters
    ----------
    name : str
        Of the rig.
    signals : SignalSettings
        Units.
    done : Deployment
        Old and new gains, and how the loop behaved with the new ones.
    """
    new, verification = gains_text(done.new, signals), done.verification
    if verification is None:
        verdict = f"Written and read back: {new}; not verified."
    elif done.kept:
        word = "Kept" if verification.by == "device" else "Written and read back"
        verdict = f"{word}: {new}; {verification.reason}; {verification.whose}."
    else:
        verdict = f"Not kept: {new}; {verification.reason}. The old gains are in place."
    gains = Table(
        header=(
            "",
            ratio_title("K", signals.u_unit, signals.y_unit),
            "T_I [s]",
            "T_d [s]",
            "T_f [s]",
            "now",
        ),
        rows=tuple(
            (label, *(f"{value:.5g}" for value in (c.K, c.Ti_s, c.Td_s, c.Tf_s)), "in the rig" if held else "")
            for label, c, held in (("old", done.old, not done.kept), ("new", done.new, done.kept))
        ),
    )
    return Page(
        title=f"Gains handed over: {name}",
        verdict=verdict,
        tone=_tone(verification),
        answers=(("What to do", _next_step(verification)),),
        sections=(
            Section(title="Gains", tables=(gains,)),
            *((_verification_section(verification, signals),) if verification is not None else ()),
        ),
    )


def verification_page(
    name: str, signals: SignalSettings, controller: PIDController, verification: Verification
) -> Page:
    """Return the page of a verification on its own.

    Parameters
    ----------
    name : str
        Of the rig.
    signals : SignalSettings
        Units.
    controller : PIDController
        Gains that were tried.
    verification : Verification
        How the loop behaved.
    """
    said = "Accepted" if verification.accepted else "Not accepted"
    return Page(
        title=f"Verification: {name}",
        verdict=f"{said}: {gains_text(controller, signals)}; {verification.reason}; {verification.whose}.",
        tone=_tone(verification),
        answers=(("What to do", _next_step(verification)),),
        sections=(_verification_section(verification, signals),),
    )


def _tone(verification: Verification | None) -> Literal["good", "warn", "bad"]:
    """Return the tone of a page: good only where what was verified is what will run."""
    if verification is None or (verification.accepted and verification.untried):
        return "warn"
    return "good" if verification.accepted else "bad"


def _next_step(verification: Verification | None) -> str:
    if verification is None:
        return "Verify the controller on the rig."
    if verification.accepted and verification.untried:
        return (
            "Put the device's own controller in automatic, stand beside it, and step its set-point: only the host's law"
            f" was verified ({verification.untried})."
        )
    if verification.accepted:
        return "Watch the loop through its usual operating range; the points were measured at one of them."
    return (
        "Compare prediction and measurement below; diagnose the recording against the fitted model to find"
        " which physics was left out."
    )


def _verdict(tuning: Tuning, signals: SignalSettings, dry_run: bool) -> tuple[str, bool]:
    gains = designed_text(tuning.analysis.design, signals)
    if tuning.verification is None:
        return f"{gains}: designed, not verified on the rig.", False
    if tuning.verification.accepted:
        held = "the rig holds its old gains" if tuning.old_controller else "its gains are in result.json"
        where = "the rig holds it now" if tuning.deployed else held
        where = "this was its simulated twin, the rig was not touched" if dry_run else where
        whose = "" if dry_run else f"{tuning.verification.whose}; "
        return f"Accepted: {gains}; {tuning.verification.reason}; {whose}{where}.", True
    return f"Not accepted: {gains}; {tuning.verification.reason}. The old gains were kept.", False


def _answers(tuning: Tuning, signals: SignalSettings, diagnosis: Diagnosis | None) -> tuple[tuple[str, str], ...]:
    experiment, old = tuning.experiment, tuning.old_controller
    found = (
        f"{len(experiment.points)} points of the Bode diagram in {experiment.sweep_time_s:.0f} s of oscillation"
        f" ({experiment.rig_time_s:.0f} s on the rig in all)."
    )
    if old is not None:
        new, before = designed_text(tuning.analysis.design, signals), gains_text(old, signals)
        found += f" Before: {before}. Now: {new}." if tuning.deployed else f" The rig holds {before}; designed: {new}."
    sure = margins_sentence(tuning.analysis, signals)
    if tuning.verification is not None:
        sure += " The loop was tried on the rig: below, measured beside what was predicted."
    todo = (
        _next_step(tuning.verification)
        if diagnosis is None or diagnosis.verdict == "none"
        else "Read below why the loop differs from its prediction, and correct that or the model."
    )
    return ("Found", found), ("How sure", sure), ("What to do", todo)


def _experiment_section(
    recordings: Sequence[Recording], experiment: ExperimentResult, signals: SignalSettings
) -> Section:
    timing, parts = experiment.timing, experiment.parts
    figures = []
    for number, (recording, part) in enumerate(zip(recordings, parts, strict=True)):
        marks = [(s.start_s, f"{i + 1}") for i, s in enumerate(experiment.segments) if s.part == number]
        which = "The whole recording." if len(parts) == 1 else f"Sitting {number + 1}, {part.recording}."
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
            f"It ended because: {experiment.reason}; {sentence(experiment.output)}.",
            f"Link latency {_milliseconds(timing.latency_s)}, lateness of the loop {_milliseconds(timing.lateness_s)},"
            f"{_decision(timing.decision_s)}"
            f" (median, 99 %, worst); {timing.missed} sample(s) missed, {timing.unusable} unusable.",
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
    tests = ", ".join(f"{what} {p:.2g}" for what, p in zip(TESTS, found.p_values, strict=True))
    return (
        f"The points are estimated together from all rows between {found.start_s:.4g} and {found.end_s:.4g} s. What the"
        f" fitted equation leaves shows nothing else: the probabilities of as much by noise alone are {tests}; below"
        f" {LEVEL / len(TESTS):.2g} each point would have been measured by itself.",
    )


def _dwell_table(experiment: ExperimentResult) -> Table:
    """Return where the sweep's time went."""
    rows = []
    for i, one in enumerate(experiment.segments, start=1):
        dwell = f"{one.end_s - one.start_s:.1f}"
        cells = (f"{i}", f"{math.degrees(one.phase_rad):.0f}", f"{one.point.omega_rad_s:.3g}", f"{one.periods}", dwell)
        rows.append((*cells, f"{100 * relative_sd(one):.2g} %"))
    header = ("cycle", "aimed at [deg]", "ω [rad/s]", "periods", "dwell [s]", "its own rows know its point to")
    return Table(header=header, rows=tuple(rows))


def _decision(values: tuple[float, float, float]) -> str:
    """Return the time from a reading to its command, where the host computes it."""
    return f" from a reading to its command {_milliseconds(values)}" if math.isfinite(values[0]) else ""


def _milliseconds(values: tuple[float, float, float]) -> str:
    return " / ".join(f"{1e3 * value:.2g}" for value in values) + " ms"


_CYCLE_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, GREY)


def _cycles_figure(recordings: Sequence[Recording], segments: Sequence[Segment], signals: SignalSettings) -> Chart:
    figure = make_subplots(rows=2, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.6, 0.4])
    for i, segment in enumerate(sorted(segments, key=lambda segment: segment.point.omega_rad_s)):
        period = 2 * math.pi / segment.point.omega_rad_s
        part = recordings[segment.part].between(max(segment.start_s, segment.end_s - 2 * period), segment.end_s)
        t = (part.t - part.t[0]) / period
        name, colour = f"{segment.point.omega_rad_s:.3g} rad/s", _CYCLE_COLOURS[i % len(_CYCLE_COLOURS)]
        y = part.y - np.nanmean(part.y)
        add_line(figure, *thinned(t, y, 600), name, colour, width=1.2, row=1, col=1)
        add_line(figure, *thinned(t, part.u, 600), name, colour, width=1.2, row=2, col=1, line_shape="hv")
    figure.update_xaxes(title="periods", row=2, col=1)
    figure.update_yaxes(title=axis_title("y - mean", signals.y_unit), row=1, col=1)
    figure.update_yaxes(title=axis_title("u", signals.u_unit), row=2, col=1)
    return figure


def _verification_section(verification: Verification, signals: SignalSettings) -> Section:
    measured, predicted, sd = verification.measured, verification.predicted, verification.predicted_sd
    unit = signals.y_unit
    rows = (
        ("overshoot [%]", 100 * measured.overshoot, 100 * predicted.overshoot, 100 * sd.overshoot),
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
        title="Verification on the rig",
        text=(
            _asked(verification.test, signals),
            _sentence(f"{verification.whose}: {verification.reason}"),
            *((_sentence(law.sentence),) if (law := verification.running_law) is not None else ()),
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


def _diagnosis_section(found: Diagnosis) -> Section:
    following = found.next_experiment
    text = [*found.sentences]
    if found.places:
        text.append(f"It sits in: {', '.join(found.places)}.")
    if following is not None:
        text.append(f"Next experiment, to {following.purpose}: {following.kind}. Expected: {following.expected}.")
    effects = Table(
        header=("effect", "probability", "parameters"),
        rows=tuple(
            (
                effect.name,
                f"{effect.probability:.2f}",
                ", ".join(f"{name} = {p.value:.4g} {p.unit}".rstrip() for name, p in effect.parameters.items()),
            )
            for effect in found.effects
        ),
    )
    return Section(
        title="Why it differs",
        text=tuple(text),
        links=(("The whole diagnosis, with its pictures", "diagnosis/report.html"),),
        tables=(effects,) if found.effects else (),
    )


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _asked(test: StepTest, signals: SignalSettings) -> str:
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
    add_line(figure, *thinned(test.t, verification.y), "measured", "rgba(59,130,196,0.45)", width=0.8, row=1, col=1)
    usable = np.isfinite(verification.y)
    filled = np.interp(test.t, test.t[usable], verification.y[usable])
    add_line(figure, *thinned(test.t, smoothed(filled, test)), "measured, smoothed", BLUE, row=1, col=1)
    add_line(figure, *thinned(test.t, prediction.y), "predicted", RED, row=1, col=1)
    add_line(figure, test.t[edge], test.setpoint[edge], "set-point", GREY, dash="dash", row=1, col=1)
    early = slice(0, max(test.disturbed_from // 10, 1))
    rest = float(np.median(verification.u[early] - prediction.u[early]))  # the command that holds the operating point
    add_line(figure, *thinned(test.t, verification.u - rest), "u of the law", ORANGE, width=1.0, row=2, col=1)
    add_line(figure, *thinned(test.t, prediction.u), "predicted u", RED, row=2, col=1, showlegend=False)
    figure.update_yaxes(title=axis_title("y - operating point", signals.y_unit), row=1, col=1)
    figure.update_yaxes(title=axis_title("Δu", signals.u_unit), row=2, col=1)
    figure.update_xaxes(title="time [s]", row=2, col=1)
    return figure


def _warnings_sections(warnings: Sequence[str]) -> tuple[Section, ...]:
    return (Section(title="Warnings", text=tuple(dict.fromkeys(warnings))),) if warnings else ()
