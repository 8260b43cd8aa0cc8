"""The table of a campaign on recorded rigs; intervals take cases of one rig as belonging together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sim.recorded.campaign import RecordedMark
from sim.recorded.effects import BY_NAME
from sim.score import Mark, Row, calibration_error, wilson

#: Whether something holds of a case, with the case's rig.
Hit = tuple[str, bool]


def cluster_interval(hits: Sequence[Hit]) -> tuple[float, float]:
    """95 % interval of a share over cases of which several are of one rig.

    Wilson's, at the number of independent cases that has the variance which the shares of the rigs show (Kish's design
    effect, Survey Sampling, 1965, sec. 8.2). Where all cases agree the design effect is not known, and each rig counts
    once.
    """
    rigs = sorted({rig for rig, _ in hits})
    n = len(hits)
    if n == 0:
        return 0.0, 1.0
    p = sum(hit for _, hit in hits) / n
    if p in (0.0, 1.0) or len(rigs) == 1:
        return wilson(p * len(rigs), len(rigs))
    sums = np.array([sum(hit - p for name, hit in hits if name == rig) for rig in rigs])
    effect = float(np.sum(sums**2)) * len(rigs) / (len(rigs) - 1) / (n * p * (1.0 - p))
    independent = n / max(effect, 1.0)
    return wilson(p * independent, independent)


def _share(figure: str, asked: float | None, hits: Sequence[Hit], at_most: bool = False) -> Row:
    share = sum(hit for _, hit in hits) / len(hits) if hits else math.nan
    met = None if not hits or asked is None else (share <= asked if at_most else share >= asked)
    bound = "" if asked is None else f"{'<=' if at_most else '>='} {100 * asked:.0f} %"
    return Row(figure=figure, asked=bound, value=share, interval=cluster_interval(hits), count=len(hits), met=met)


def _number(figure: str, asked: str, value: float, count: int, met: bool) -> Row:
    return Row(figure=figure, asked=asked, value=value, interval=None, count=count, met=met if count else None)


def table(marks: Sequence[RecordedMark]) -> list[Row]:
    """Rows of the table; cases that do not count are left out and counted in the last row."""
    counted = [m.mark for m in marks if not m.not_counted]
    singles = [m for m in counted if m.kind == "single"]
    clear, weak = ([m for m in singles if (m.strength == "weak") is is_weak] for is_weak in (False, True))
    clean = [m for m in counted if m.kind == "clean"]
    left_out = [(m.mark.rig, bool(m.not_counted)) for m in marks]

    def on(side: str) -> list[Hit]:
        return [(m.rig, m.first_right) for m in clear if BY_NAME[m.true_names[0]].on == side]

    return [
        _share("medium and strong: right new name first", 0.90, [(m.rig, m.first_right) for m in clear]),
        _share("of these, effects of the reading", None, on("reading")),
        _share("of these, effects of the command", None, on("command")),
        _share("medium and strong: the right one among the new names", None, [(m.rig, any(m.right)) for m in clear]),
        _share("weak: right new name first", 0.65, [(m.rig, m.first_right) for m in weak]),
        _share(
            "weak, not named right: nothing new named", 0.5, [(m.rig, not m.named) for m in weak if not m.first_right]
        ),
        _share("place, where something new is named", 0.95, [(m.rig, m.place_right) for m in singles if m.named]),
        _share("a wrong new name, beside the right one or alone", None, [(m.rig, not all(m.right)) for m in singles]),
        _share("numbers changed only: something new said", 0.02, [(m.rig, not m.verdict_right) for m in clean], True),
        *_probability_rows(counted),
        *_forecasts(counted),
        _share("left out: already named of the recording as it is", None, left_out),
    ]  # fmt: skip


def _probability_rows(marks: Sequence[Mark]) -> list[Row]:
    said = [(m.rig, p, ok) for m in marks for p, ok in zip(m.probabilities, m.right, strict=True)]
    error = calibration_error([(p, ok) for _, p, ok in said])
    sure = [(rig, not ok) for rig, p, ok in said if p >= 0.95]
    return [
        _number("new names, stated probability: expected error", "<= 0.05", error, len(said), error <= 0.05),
        _share("new names, wrong at p >= 0.95", 0.02, sure, at_most=True),
    ]


def _forecasts(marks: Sequence[Mark]) -> list[Row]:
    gaps = [m.gap for m in marks if m.gap is not None]
    middle = float(np.median(gaps)) if gaps else math.nan
    worse = [(m.rig, bool(m.worse_than_retuned)) for m in marks if m.worse_than_retuned is not None]
    return [
        _number("gap closed on the recording kept back, median", ">= 0.95", middle, len(gaps), middle >= 0.95),
        _share("extended worse than retuned on the recording kept back", 0.0, worse, at_most=True),
    ]


def by_rig(marks: Sequence[RecordedMark]) -> list[tuple[str, int, int, int, list[str]]]:
    """Return for each rig: cases that count, right ones, wrong new names, and a line for each miss."""
    out = []
    for rig in sorted({m.mark.rig for m in marks}):
        group = [m.mark for m in marks if m.mark.rig == rig and not m.not_counted]
        good = [m.first_right if m.kind == "single" else m.verdict_right for m in group]
        wrong = sum(not ok for m in group for ok in m.right)
        missed = [_line(m) for m, right in zip(group, good, strict=True) if not right or not all(m.right)]
        out.append((rig, len(group), sum(good), wrong, missed))
    return out


def _line(m: Mark) -> str:
    truth = " + ".join(m.true_names) or "numbers"
    said = ", ".join(f"{name} {p:.2f}" for name, p in zip(m.named, m.probabilities, strict=True)) or m.verdict
    return f"{truth}{f' ({m.strength})' if m.strength else ''}: {said}"
