"""Pictures of what was found: the free run on unseen rows, the missing law with its data, and when it acts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.missing_law import Branch, MissingLaw
from autotune.diagnosis.evidence.unseen_run import UnseenRun
from autotune.recording import Recording
from autotune.report import chart as go
from autotune.report.chart import make_subplots
from autotune.report.effect_words import clause
from autotune.report.page import BLUE, GREEN, GREY, ORANGE, PURPLE, Figure, add_line, lines_figure, thin_curve
from autotune.report.writing import number, sentence, typeset_unit

_COLOURS = {"nominal": PURPLE, "retuned": ORANGE, "extended": BLUE}
_DASHES = {"nominal": "dot", "retuned": "dash", "extended": "solid"}
#: A simulation may leave the measured span by this share of it within the picture.
_MARGIN = 0.4
#: A band that is nowhere farther from its line than this share of the line's height is not seen beside it.
_UNSEEN = 0.005


def file_names(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the recordings' names as people know them: their files', with folders where two files have one name."""
    paths = [Path(r.name) for r in recordings]
    for parts in (1, 2, 3):
        names = tuple("/".join(path.parts[-parts:]) for path in paths)
        if len(set(names)) == len(names):
            return names
    return tuple(f"{name} ({i})" for i, name in enumerate(names))


def alike_once(curves: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Return curves by name, with those that run alike as one under both names: the one below would not be seen."""
    merged: dict[str, FloatArray] = {}
    for name, curve in curves.items():
        same = next((other for other, drawn in merged.items() if np.array_equal(drawn, curve, equal_nan=True)), None)
        if same is not None:
            del merged[same]
        merged[name if same is None else f"{same} and {name}"] = curve
    return merged


def style_of(name: str) -> tuple[str, str]:
    """Return colour and dash of a model's curve; of one under two names those of the second."""
    model = name.rsplit(" and ", 1)[-1]
    return _COLOURS[model], _DASHES[model]


def _with_unit(name: str, unit: str) -> str:
    """Return an axis's title."""
    return f"{name} [{typeset_unit(unit) or '-'}]"


def free_run_figure(run: UnseenRun, name: str) -> Figure:
    """Draw a free run of all models through a stretch, the residual below.

    Parameters
    ----------
    run : UnseenRun
        The stretch, and each model's run through it.
    name : str
        Of its recording.
    """
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.05, row_heights=[0.66, 0.34])
    add_line(figure, *thin_curve(run.t, run.y), "measured", GREY, width=2.4, row=1, col=1)
    shown: list[FloatArray] = []
    for model, y in alike_once(run.runs).items():
        colour, dash = style_of(model)
        add_line(figure, *thin_curve(run.t, y), model, colour, dash=dash, row=1, col=1)
        add_line(figure, *thin_curve(run.t, run.y - y), model, colour, dash=dash, row=2, col=1, showlegend=False)
        if model != "nominal" or len(run.runs) < 3:
            shown.append(run.y - y)
    low, high = float(np.nanmin(run.y)), float(np.nanmax(run.y))
    span = (high - low) or 1.0
    figure.update_yaxes(
        title=_with_unit("y", run.unit), range=[low - _MARGIN * span, high + _MARGIN * span], row=1, col=1
    )
    widest = 1.15 * max((float(np.nanquantile(np.abs(e), 0.995)) for e in shown), default=span)
    widest = min(widest, span) or span
    figure.update_yaxes(title=_with_unit("residual", run.unit), range=[-widest, widest], row=2, col=1)
    figure.update_xaxes(title="time [s]", row=2, col=1)
    for a, b in zip(run.starts_s, run.heads_s, strict=True):
        figure.add_vrect(a, b, fillcolor="rgba(128,128,128,0.16)", line={"width": 0}, layer="below")
    return Figure(figure=figure, caption=_caption_of_run(run, name), height_px=460)


def _caption_of_run(run: UnseenRun, name: str) -> str:
    errors = ", ".join(
        f"{model} {number(100 * e, 3)} %" if math.isfinite(e) else f"{model} runs away"
        for model, e in run.errors.items()
    )
    once = len(run.starts_s) == 1
    how = "One free run" if once else f"{len(run.starts_s)} free runs, as long as this plant lets a simulation run,"
    return (
        f"{how} through rows of {name} that no number was fitted to, driven by the recorded command alone; in the grey "
        f"part{'' if once else 's'} the readings told the start state. Error as a share of the spread of y there: "
        f"{errors}. A curve that leaves the picture goes on outside it."
    )


def law_figure(law: MissingLaw) -> Figure:
    """Draw a law over its signal with its 95 % band, and the bins of the data with their bars."""
    value = law.value if law.is_whole else f"added {law.value}"
    figure = lines_figure(_with_unit(law.signal, law.unit), _with_unit(value, law.value_unit))
    ends = np.array([min(b.x.min() for b in law.branches), max(b.x.max() for b in law.branches)])
    add_line(figure, ends, ends if law.is_whole else np.zeros(2), "without it", ORANGE, dash="dash")
    for branch in law.branches:
        colour = GREEN if branch.name == "falling" else BLUE
        name = f"law, {branch.name}" if branch.name else "law"
        _add_band(figure, branch, colour)
        add_line(figure, branch.x, branch.law, name, colour, width=2.2)
        if branch.at.size:
            figure.add_trace(
                go.Scatter(
                    x=branch.at, y=branch.found, name=f"data, {branch.name}" if branch.name else "data in bins",
                    mode="markers", marker={"color": colour if branch.name else GREY, "size": 8},
                    error_y={"type": "data", "array": 1.96 * branch.error, "color": GREY, "thickness": 1.2, "width": 3},
                )
            )  # fmt: skip
    return Figure(figure=figure, caption=_caption_of_law(law), height_px=360)


def _caption_of_law(law: MissingLaw) -> str:
    bins = sum(b.at.size for b in law.branches)
    near = sum(int(np.sum(np.abs(b.found - _at(b)) < 1.96 * _both(b))) for b in law.branches)
    told = sum(int(np.sum(np.abs(b.found - (b.at if law.is_whole else 0.0)) > 1.96 * b.error)) for b in law.branches)
    said = (
        f"{near} of {bins} bins of the data agree with it to within their 95 % bars; {told} of them contradict the "
        "model without it."
        if bins
        else "Residuals that go together over long stretches leave no bin that tells it from nothing."
    )
    return f"{sentence(clause(law.effect))} {_words_of_band(law)} {said}"


def _words_of_band(law: MissingLaw) -> str:
    """Say what the band is, or that it is not to be seen."""
    height = max(float(np.ptp(b.law)) for b in law.branches)
    widest = max(1.96 * float(np.max(np.nan_to_num(b.sd), initial=0.0)) for b in law.branches)
    if widest < _UNSEEN * height:
        return "What its numbers' uncertainty makes of it (95 %) is narrower than the line."
    return "The band is what its numbers' uncertainty makes of it (95 %)."


def _at(branch: Branch) -> FloatArray:
    return np.interp(branch.at, branch.x, branch.law)


def _both(branch: Branch) -> FloatArray:
    return np.hypot(branch.error, np.interp(branch.at, branch.x, branch.sd))


def _add_band(figure: go.Chart, branch: Branch, colour: str) -> None:
    half = 1.96 * np.nan_to_num(branch.sd)
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    figure.add_trace(
        go.Scatter(
            x=np.concatenate([branch.x, branch.x[::-1]]),
            y=np.concatenate([branch.law + half, (branch.law - half)[::-1]]), fill="toself", mode="lines",
            fillcolor=f"rgba({red},{green},{blue},0.18)", line={"width": 0}, hoverinfo="skip", showlegend=False,
        )
    )  # fmt: skip


def acting_figure(law: MissingLaw, recordings: Sequence[Recording], names: Sequence[str]) -> Figure:
    """Draw what an effect adds along the recordings, one after the other.

    Parameters
    ----------
    law : MissingLaw
        What the effect adds, row by row.
    recordings : sequence of Recording
        Those it was found on.
    names : sequence of str
        One for each.
    """
    figure = lines_figure("t, one recording after the other [s]", _with_unit("added", law.value_unit))
    at, marks = 0.0, []
    for r, rows, added, name in zip(recordings, law.rows, law.acts, names, strict=True):
        # where windows begin, a speed may be far off for a row or two
        add_line(
            figure,
            *thin_curve(at + r.t[rows] - r.t[0], median_filter(added, 5, mode="nearest")),
            "",
            BLUE,
            width=1.2,
            showlegend=False,
        )
        marks.append((at, name))
        at += r.duration_s
    for begin, name in marks if len(marks) > 1 else []:
        figure.add_vline(x=begin, line={"color": GREY, "width": 1, "dash": "dot"})
        figure.add_annotation(
            x=begin, y=1.0, yref="paper", text=name, showarrow=False, xanchor="left", yanchor="bottom"
        )
    every = np.concatenate([median_filter(added, 5, mode="nearest") for added in law.acts])
    low, high = np.quantile(every, [0.001, 0.999])
    room = 0.08 * ((high - low) or 1.0)
    figure.update_yaxes(range=[low - room, high + room])
    active = float(np.mean(np.abs(every) > 0.05 * max(abs(low), abs(high), 1e-300)))
    caption = (
        f"What is added as {law.value}: {clause(law.effect)}. It is more than a twentieth of its "
        f"largest value in {100 * active:.0f} % of "
        "the rows."
    )
    return Figure(figure=figure, caption=caption, height_px=240)
