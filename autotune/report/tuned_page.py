"""The page of a design from recordings and points, without a rig."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from autotune.config.procedure import SignalSettings
from autotune.controller import PIDController
from autotune.pipeline import Analysis
from autotune.recording import Recording
from autotune.report.analysis_sections import analysis_sections, warnings_sections
from autotune.report.analysis_words import basis_text, designed_text, margins_sentence
from autotune.report.figures import recording_figure
from autotune.report.outlook import outlook_section
from autotune.report.page import Figure, Page, Section
from autotune.report.plant_section import model_figures, numbers_table
from autotune.version import __version__


def analysis_page(
    name: str,
    signals: SignalSettings,
    recordings: Sequence[Recording],
    analysis: Analysis,
    notes: Sequence[str] = (),
    *,
    present: PIDController | None = None,
    made: datetime | None = None,
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
    present : PIDController, optional
        The gains in use today, beside which the new ones are shown.
    made : datetime, optional
        When; said beside the version where given.
    """
    figures = tuple(
        Figure(figure=recording_figure(recording, signals.u_unit, signals.y_unit), caption=recording.name)
        for recording in recordings
    )
    figures = model_figures(analysis.fit, recordings, signals) or figures
    tables = (numbers_table(analysis.fit, signals),)
    first = (Section(title="The plant over the recordings", figures=figures, tables=tables),) if figures else ()
    sections = (
        *outlook_section(analysis, signals, present),
        *first,
        *reversed(analysis_sections(analysis, signals, None)),
        *warnings_sections((*notes, *analysis.warnings)),
    )
    return Page(
        title=f"Controller from recordings: {name}",
        verdict=f"{designed_text(analysis.design, signals)}: not yet tried on the rig.",
        tone="warn",
        answers=(
            ("Found", f"{designed_text(analysis.design, signals)}, {basis_text(analysis)}."),
            ("How sure", margins_sentence(analysis, signals)),
            (
                "What to do",
                "Try it on the rig, or have autotune deploy and verify do so, before the loop is left to it.",
            ),
        ),
        summary=tuple(origin_text(recordings, made)),
        sections=sections,
    )


def origin_text(recordings: Sequence[Recording], made: datetime | None) -> list[str]:
    """Return which rows of which files and columns a page rests on, and which version made it when.

    Parameters
    ----------
    recordings : sequence of Recording
        What was read; those of a foreign file know its columns.
    made : datetime or None
        When the page was made.
    """
    lines = []
    for recording in recordings:
        origin = recording.metadata.get("file", {})
        columns = origin.get("columns", {}) if isinstance(origin, dict) else {}
        own = f"columns t, u, y{', r' if 'r' in recording.extra else ''}"
        taken = ", ".join(f"{role} = {column}" for role, column in columns.items()) or own
        span = f"{len(recording)} rows over {recording.duration_s:.6g} s"
        lines.append(f"From {recording.name}: {taken}; {span}, {recording.sample_time_s:.4g} s apart.")
    when = "" if made is None else f" on {made:%Y-%m-%d at %H:%M %Z}".rstrip()
    return [*lines, f"Made by relay-autotune {__version__}{when}."]
