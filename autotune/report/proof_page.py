"""The proof as one page: the table, how often stated probabilities are right, and the cases that were missed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np

from autotune.report.page import BLUE, GREY, Figure, Page, Section, Table, Tone, add_line, lines_figure

#: A figure, a mark and an interval as ``proof.json`` has them.
Content: TypeAlias = Mapping[str, Any]
#: Lower and upper end of the 95 % interval of a share, from successes and trials.
Interval: TypeAlias = Callable[[int, int], tuple[float, float]]

_BINS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0 + 1e-9)
_MOST_MISSES = 200

#: cases below which no share is known to a tenth
_FEW = 100


def proof_page(
    result: Content,
    missed: Sequence[Content],
    confusion: Sequence[tuple[Any, ...]],
    interval: Interval,
    what: str = "Effects were concealed in simulated recordings and sealed, then diagnosed as a user would.",
    further: Sequence[Section] = (),
) -> Page:
    """Return the page of a proof.

    Parameters
    ----------
    result : mapping
        Content of ``proof.json``.
    missed : sequence of mapping
        Marks of the cases that were missed.
    confusion : sequence of tuple
        Concealed effect, cases, right, and what was said in its place.
    interval : callable
        95 % interval of a share.
    what : str
        What was done.
    further : sequence of Section
        What comes after the figures.
    """
    rows, count = result["table"], result["cases"]
    short = [row["figure"] for row in rows if row["met"] is False]
    tone: Tone = "warn" if short else "good"
    verdict = f"{count - len(missed)} of {count} concealed cases are right in all that is asked of them."
    todo = f"Not reached: {', '.join(short)}." if short else "Every figure that has a bound keeps it."
    if count < _FEW:
        todo += f" {count} cases leave wide intervals: prove more of them (--cases) before anything is concluded."
    return Page(
        title="Proof of the diagnosis on concealed effects",
        verdict=verdict,
        tone=tone,
        answers=(
            ("What was done", what),
            ("How sure", f"Intervals of 95 % beside every share. Seal: SHA-256 {result['sha256'][:16]}..."),
            ("What to do", todo),
        ),
        sections=(
            Section(title="Figures", tables=(figures_table(rows),)),
            *further,
            *_calibration(result["marks"], interval),
            Section(title=f"Missed cases ({len(missed)})", tables=(_missed_cases_table(missed),) if missed else ()),
            Section(title="What was said of what", tables=(confusion_table(confusion),)),
        ),
    )


def figures_table(rows: Sequence[Content]) -> Table:
    """Return the figures with what is asked of them."""
    cells = []
    for row in rows:
        share = row["interval"] is not None
        value = "-" if not row["count"] else f"{100 * row['value']:.1f} %" if share else f"{row['value']:.3f}"
        between = (
            f"{100 * row['interval'][0]:.1f} to {100 * row['interval'][1]:.1f} %" if share and row["count"] else ""
        )
        met = {None: "", True: "yes", False: "no"}[row["met"]]
        cells.append((row["figure"], row["asked"], value, between, str(row["count"]), met))
    return Table(header=("figure", "asked", "measured", "95 % interval", "of", "met"), rows=tuple(cells))


def _calibration(marks: Sequence[Content], interval: Interval) -> tuple[Section, ...]:
    """Draw how often statements of a probability are right, over the probability they were made with."""
    said = [
        (float(p), bool(right)) for mark in marks for p, right in zip(mark["probabilities"], mark["right"], strict=True)
    ]
    if not said:
        return ()
    p = np.array([one[0] for one in said])
    right = np.array([one[1] for one in said])
    figure = lines_figure("stated probability", "share that is right")
    add_line(figure, np.array([0.0, 1.0]), np.array([0.0, 1.0]), "calibrated", GREY, dash="dash")
    x, y, low, high, text = [], [], [], [], []
    for start, end in pairwise(_BINS):
        inside = (p >= start) & (p < end)
        if not inside.any():
            continue
        bottom, top = interval(int(right[inside].sum()), int(inside.sum()))
        x.append(float(p[inside].mean()))
        y.append(float(right[inside].mean()))
        low.append(y[-1] - bottom)
        high.append(top - y[-1])
        text.append(f"{int(right[inside].sum())} of {int(inside.sum())}")
    figure.add_scatter(
        x=x, y=y, text=text, name="statements, 95 %", mode="markers", marker={"color": BLUE, "size": 9},
        error_y={"type": "data", "array": high, "arrayminus": low, "color": BLUE},
        hovertemplate="%{text} right<extra></extra>",
    )  # fmt: skip
    figure.update_xaxes(range=[0.0, 1.04])
    figure.update_yaxes(range=[0.0, 1.04])
    count = f"{len(said)} statement{'s' * (len(said) != 1)}"
    caption = f"{count}; on the dashed line nine in ten of those made with 0.9 are right."
    return (
        Section(title="Are the probabilities true?", figures=(Figure(figure=figure, caption=caption, square=True),)),
    )


def _missed_cases_table(missed: Sequence[Content]) -> Table:
    rows = tuple(
        (
            mark["case"],
            mark["rig"],
            mark["strength"] or mark["kind"],
            " + ".join(mark["true_names"]) or "nothing",
            ", ".join(f"{name} ({p:.2f})" for name, p in zip(mark["named"], mark["probabilities"], strict=True))
            or str(mark["verdict"]),
            "yes" if mark["place_right"] else "no",
            "" if mark["gap"] is None else f"{mark['gap']:.2f}",
        )
        for mark in missed[:_MOST_MISSES]
    )
    header = ("case", "rig", "strength", "concealed", "said", "place right", "gap closed")
    return Table(header=header, rows=rows, caption="Each lies in its folder with model, recordings and diagnosis.")


def confusion_table(confusion: Sequence[tuple[Any, ...]]) -> Table:
    """Return what was said of what."""
    rows = tuple(
        (str(name), str(count), str(right), ", ".join(f"{word} {times}" for word, times in said))
        for name, count, right, said in confusion
    )
    return Table(header=("concealed", "cases", "right", "said instead"), rows=rows)


def rigs_sections(
    rigs: Sequence[tuple[str, str, int, int, int, Sequence[str]]], refused: Mapping[str, str]
) -> tuple[Section, ...]:
    """Return what was said on each recorded rig, and why others, and some effects, were left out.

    Parameters
    ----------
    rigs : sequence of tuple
        Name, what is said of the recording as it is, cases that count, right ones, wrong new names, lines for misses.
    refused : mapping
        Rig or effect, and the reason.
    """
    rows = tuple(
        (name, before, str(count), str(right), str(wrong), "; ".join(missed))
        for name, before, count, right, wrong, missed in rigs
    )
    header = ("rig", "said of the recording as it is", "cases", "right", "wrong new names", "missed")
    tables = [Table(header=header, rows=rows, caption="Only what is new in a changed recording counts.")]
    tables.append(Table(header=("left out", "why"), rows=tuple(refused.items())))
    return (Section(title="Rig by rig", tables=tuple(tables)),)
