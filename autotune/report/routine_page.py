"""The look at a loop in operation as a page: verdict, what a faulty valve explains, u over y, what was compared."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from autotune.diagnosis.routine.result import RoutineDiagnosis
from autotune.diagnosis.routine.thresholds import RoutineThresholds
from autotune.diagnosis.thresholds import table
from autotune.report.chart import make_subplots
from autotune.report.figures import axis_title
from autotune.report.page import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    Figure,
    Page,
    Section,
    Table,
    Tone,
    add_line,
    lines_figure,
    write_page,
)  # fmt: skip

_TONES: dict[str, Tone] = {
    "stiction": "bad", "backlash": "bad", "tight_tuning": "warn", "outside_oscillation": "warn", "none": "good",
    "abstain": "warn",
}  # fmt: skip
#: What is drawn at once, where every turn is seen: periods in the middle of the record, and rows at most.
_PERIODS, _ROWS = 14, 600


def write_routine_page(found: RoutineDiagnosis, path: str | os.PathLike[str]) -> None:
    """Write the page of a look at a loop in operation.

    Parameters
    ----------
    found : RoutineDiagnosis
        What to show.
    path : path
        File to write.
    """
    errors = " ".join(found.sentences[1:])
    page = Page(
        title=f"Loop in operation: {', '.join(Path(name).name for name in found.operation.names)}",
        verdict=found.sentences[0],
        tone=_TONES[found.verdict],
        answers=(("How sure", errors), ("What to do", found.following)),
        sections=(_signals(found), _evidence(found), _curve(found), _comparison(found), _method()),
    )
    write_page(page, path)


def _section_of(found: RoutineDiagnosis) -> slice:
    rows = found.operation.rows_of(0)
    size, period = rows.stop - rows.start, found.operation.period_rows
    drawn = min(_ROWS, int(_PERIODS * period)) if np.isfinite(period) else _ROWS
    first = rows.start + max(0, (size - drawn) // 2)
    return slice(first, min(first + drawn, rows.stop))


def _signals(found: RoutineDiagnosis) -> Section:
    operation, part = found.operation, _section_of(found)
    t = operation.t[part]
    figure = make_subplots(rows=2, shared_xaxes=True, vertical_spacing=0.05)
    add_line(figure, t, operation.y[part], "y recorded", GREY, row=1, col=1)
    add_line(figure, t, operation.u[part], "u recorded", GREY, dash="dot", row=2, col=1)
    add_line(figure, t, found.valves.position[part], "best faulty valve", GREEN, row=2, col=1)
    figure.update_yaxes(title=axis_title("y", operation.y_unit), row=1, col=1)
    figure.update_yaxes(title=axis_title("u and valve", operation.u_unit), row=2, col=1)
    figure.update_xaxes(title="time [s]", row=2, col=1)
    drawn = "The record" if part == operation.rows_of(0) else "The middle of the record"
    caption = (
        f"{drawn}. Below, the command and the position of the faulty valve that predicts y best: where it is the cause,"
        " y moves when this valve slips and rests while it rests."
    )
    return Section(title="Command, valve and answer", figures=(Figure(figure=figure, caption=caption, height_px=560),))


def _evidence(found: RoutineDiagnosis) -> Section:
    valves = found.valves
    figure = lines_figure("time [s]", "share of squared error")
    whole = max(float(valves.linear @ valves.linear), 1e-300)
    for errors, name, colour in ((valves.linear, "by the command", ORANGE), (valves.faulty, "by the valve", BLUE)):
        add_line(figure, valves.t, np.cumsum(errors**2) / whole, name, colour)
    caption = (
        "Squared errors of both predictions of y, added up from the start; 1 is the sum of the linear one, by the"
        " command. A faulty valve parts the curves a little at every slip; one that parts them once is an incident, and"
        " not a valve."
    )
    return Section(title="Evidence, slip by slip", figures=(Figure(figure=figure, caption=caption, height_px=320),))


def _curve(found: RoutineDiagnosis) -> Section:
    operation, part = found.operation, _section_of(found)
    u = axis_title("u", operation.u_unit)
    left, right = (
        lines_figure(u, axis_title("y", operation.y_unit)),
        lines_figure(u, axis_title("valve", operation.u_unit)),
    )
    add_line(left, operation.u[part], operation.y[part], "recorded", GREY, width=1.0)
    add_line(right, operation.u[part], found.valves.position[part], "valve", GREEN, width=1.2)
    ends = np.array([operation.u[part].min(), operation.u[part].max()])
    add_line(right, ends, ends, "a valve that follows", GREY, dash="dash")
    return Section(
        title="Command and answer",
        figures=(
            Figure(figure=left, caption="y over u: a faulty valve leaves a parallelogram, a lag an ellipse.",
                   square=True),
            Figure(figure=right, caption="Position of the valve over u: flat where it does not follow.", square=True),
        ),
    )  # fmt: skip


def _comparison(found: RoutineDiagnosis) -> Section:
    valves, seen, answer = found.valves, found.oscillation, found.answer
    facts = [
        (
            "ln(squared error by the command / by the best faulty valve), beyond a sound one's",
            f"{valves.decrease:+.2f}",
        ),
        ("chance of as much in the same loop with a linear valve", f"{valves.chance:.2g}"),
        ("reversals of the best faulty valve", f"{valves.reversals}"),
        ("band S over u's range", f"{valves.valve.S / valves.span:.2f}"),
        ("slip jump J over S", f"{valves.valve.J / max(valves.valve.S, 1e-300):.2f}"),
        ("period of the dominant oscillation [s]", f"{seen.period_s:.4g}"),
        ("periods in the record", f"{seen.periods:.0f}"),
        ("regularity of y (over 1: it oscillates)", f"{seen.regularity:.3g}"),
        ("share of y's variance at that period", f"{seen.share:.2f}"),
        ("share of y on stretches left out that one sine predicts", f"{seen.phase_kept:.2f}"),
    ]
    if answer is not None:
        facts.append(("damping ratio of the answer to the set-point", f"{answer.damping:g}"))
        facts.append(("share of y on stretches left out that the set-point predicts", f"{answer.explained:.2f}"))
    return Section(title="What was compared", tables=(Table(header=("quantity", "value"), rows=tuple(facts)),))


def _method() -> Section:
    rows = tuple((name, f"{value:g}", *said) for name, value, *said in table(RoutineThresholds()))
    return Section(
        title="Method",
        text=("y is predicted one step ahead, linearly, from its own past, a sine of the dominant period and the past"
              " of the command; then with a faulty valve's position in place of the command, for every valve of a"
              " grid. How much the best of them gains"
              " in the same loop with a linear valve is counted: the linear prediction, with its own errors, each with"
              " a random sign, is searched in the same way.",),
        detail_tables=(Table(header=("threshold", "value", "unit", "meaning", "origin"), rows=rows),),
    )  # fmt: skip
