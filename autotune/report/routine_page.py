"""The look at a loop in operation as a page: verdict, free runs on stretches left out, u over y, what was compared."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.routine.fitting import Family
from autotune.diagnosis.routine.result import Comparison, RoutineDiagnosis
from autotune.diagnosis.routine.thresholds import table
from autotune.report.chart import Bar, Chart, make_subplots
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
_NAMES: dict[Family, str] = {"linear": "linear valve", "play": "play", "stiction": "stiction"}
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
        title=f"Loop in operation: {', '.join(Path(name).name for name in found.bench.of.names)}",
        verdict=found.sentences[0],
        tone=_TONES[found.verdict],
        answers=(("How sure", errors), ("What to do", found.following)),
        sections=(_runs(found), _curve(found), _comparison(found), _method()),
    )
    write_page(page, path)


def _shown(found: RoutineDiagnosis) -> Family:
    """Return the faulty family that is drawn beside the linear one."""
    if found.family != "linear":
        return found.family
    return min(("play", "stiction"), key=lambda name: float(found.runs[name].errors.sum()))


def _left_out(found: RoutineDiagnosis, family: Family) -> tuple[FloatArray, FloatArray]:
    """Return output and valve position of a family, every stretch by the candidate that was fitted to the others."""
    operation, bench = found.bench.of, found.bench
    y, x = np.full(operation.u.size, np.nan), np.full(operation.u.size, np.nan)
    for number, fitted in enumerate(found.runs[family].fits):
        run, position = bench.free_run(fitted.at, fitted.delay, fitted.gain), bench.position(fitted.at)
        for first, end in operation.windows[operation.stretch_of == number]:
            y[first:end], x[first:end] = run[first:end], position[first:end]
    return y, x


def _section_of(found: RoutineDiagnosis) -> slice:
    rows = found.bench.of.rows_of(0)
    size, period = rows.stop - rows.start, found.bench.of.period_rows
    drawn = min(_ROWS, int(_PERIODS * period)) if np.isfinite(period) else _ROWS
    first = rows.start + max(0, (size - drawn) // 2)
    return slice(first, min(first + drawn, rows.stop))


def _runs(found: RoutineDiagnosis) -> Section:
    operation, part, family = found.bench.of, _section_of(found), _shown(found)
    t = operation.t[part]
    figure = make_subplots(rows=2, shared_xaxes=True, vertical_spacing=0.05)
    faulty, position = _left_out(found, family)
    linear, _ = _left_out(found, "linear")
    add_line(figure, t, operation.y[part], "y recorded", GREY, row=1, col=1)
    add_line(figure, t, linear[part], "linear valve", ORANGE, row=1, col=1)
    add_line(figure, t, faulty[part], f"with {_NAMES[family]}", BLUE, row=1, col=1)
    add_line(figure, t, operation.u[part], "u recorded", GREY, dash="dot", row=2, col=1)
    add_line(figure, t, position[part], "valve as fitted", GREEN, row=2, col=1)
    figure.update_yaxes(title="y", row=1, col=1)
    figure.update_yaxes(title="u and valve", row=2, col=1)
    figure.update_xaxes(title="t [s]", row=2, col=1)
    caption = (
        f"Free runs on stretches that were not fitted. Normalised error: linear valve {found.error_of('linear'):.3g},"
        f" {_NAMES[family]} {found.error_of(family):.3g}. Below, the command and the valve that follows it."
    )
    return Section(
        title="Free runs on stretches left out", figures=(Figure(figure=figure, caption=caption, height_px=560),)
    )


def _curve(found: RoutineDiagnosis) -> Section:
    operation, part, family = found.bench.of, _section_of(found), _shown(found)
    faulty, position = _left_out(found, family)
    left, right = lines_figure("u", "y"), lines_figure("u", "valve as fitted")
    add_line(left, operation.u[part], operation.y[part], "recorded", GREY, width=1.0)
    add_line(left, operation.u[part], faulty[part], f"with {_NAMES[family]}, not fitted there", BLUE, width=1.0)
    add_line(right, operation.u[part], position[part], "valve", GREEN, width=1.2)
    ends = np.array([operation.u[part].min(), operation.u[part].max()])
    add_line(right, ends, ends, "a valve that follows", GREY, dash="dash")
    return Section(
        title="Command and answer",
        figures=(
            Figure(figure=left, caption="y over u: a faulty valve leaves a parallelogram, a lag an ellipse.",
                   square=True),
            Figure(figure=right, caption="Position of the valve over u, as fitted: flat where it does not follow.",
                   square=True),
        ),
    )  # fmt: skip


def _comparison(found: RoutineDiagnosis) -> Section:
    rows = [(_NAMES["linear"], f"{found.error_of('linear'):.3g}", "", "", "")]
    stretches = found.spread.size
    for name, one in found.against_linear.items():
        rows.append((_NAMES[name], f"{found.error_of(name):.3g}", *_cells(one, stretches)))
    rows += [(f"{_NAMES[name]}, wide bands only", "", *_cells(one, stretches)) for name, one in found.wide.items()]
    header = ("valve", "normalised error", "ln of squared error, linear over it", "stretches won", "chance")
    seen, answer = found.oscillation, found.answer
    facts = [
        ("period of the dominant oscillation [s]", f"{seen.period_s:.4g}"),
        ("periods in the record", f"{seen.periods:.0f}"),
        ("regularity of y (over 1: it oscillates)", f"{seen.regularity:.3g}"),
        ("share of y's variance in that line", f"{seen.share:.2f}"),
        ("share of y on stretches left out that one sine predicts", f"{seen.phase_kept:.2f}"),
    ]
    if answer is not None:
        facts.append(("damping ratio of the answer to the set-point", f"{answer.damping:g}"))
        facts.append(("share of y on stretches left out that the set-point predicts", f"{answer.explained:.2f}"))
    return Section(
        title="What was compared",
        tables=(Table(header=header, rows=tuple(rows)), Table(header=("oscillation", "value"), rows=tuple(facts))),
        figures=(Figure(figure=_bars(found), height_px=300,
                        caption="Every stretch left out: error of the free run over the spread of y there."),),
    )  # fmt: skip


def _cells(one: Comparison, stretches: int) -> tuple[str, str, str]:
    return f"{one.decrease:+.2f}", f"{one.won} of {stretches}", f"{one.chance:.2g}"


def _bars(found: RoutineDiagnosis) -> Chart:
    figure = lines_figure("stretch", "normalised error")
    colours: dict[Family, str] = {"linear": ORANGE, "play": BLUE, "stiction": GREEN}
    for family, run in found.runs.items():
        errors = np.sqrt(run.errors / np.maximum(found.spread, 1e-300))
        figure.add_trace(
            Bar(x=np.arange(1, errors.size + 1), y=errors, name=_NAMES[family], marker={"color": colours[family]})
        )
    return figure


def _method() -> Section:
    rows = tuple((name, f"{value:g}", unit, meaning, origin) for name, value, unit, meaning, origin in table())
    return Section(
        title="Method",
        text=("Valve and plant are driven by the recorded command. Each family is fitted to all stretches but one and"
              " runs free on that one; only a constant, a slope and the decay of an unknown start are free there.",),
        detail_tables=(Table(header=("threshold", "value", "unit", "meaning", "origin"), rows=rows),),
    )  # fmt: skip
