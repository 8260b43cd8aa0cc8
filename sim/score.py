"""Marks a diagnosis against the sealed answer of a concealed case, and counts marks into the proof's table."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

Json = dict[str, Any]
#: Bins of stated probability.
_BINS = 10


@dataclass(frozen=True, kw_only=True)
class Mark:
    """What one diagnosis is worth.

    ``named`` are the names put forward, nuisances apart, most important first; ``right`` says of each whether it is
    (equivalent to) an effect of the case. ``gap`` is the share of the gap between the retuned model and the noise
    that the extended model closes on the unseen recording, None where that is not asked for.
    """

    case: str
    kind: str
    strength: str | None
    rig: str
    true_names: tuple[str, ...]
    verdict: str
    verdict_right: bool
    named: tuple[str, ...]
    right: tuple[bool, ...]
    probabilities: tuple[float, ...]
    found: int
    place_right: bool
    gap: float | None
    worse_than_retuned: bool | None

    @property
    def first_right(self) -> bool:
        """Whether the first name put forward is right."""
        return bool(self.right) and self.right[0]

    @property
    def abstained(self) -> bool:
        """Whether no effect was put forward."""
        return self.verdict != "effect"

    @property
    def withdrawn(self) -> bool:
        """Whether an effect that is not in the catalogue became unexplained, or its equivalent was named."""
        return self.verdict == "unexplained" or self.first_right

    @property
    def failed(self) -> bool:
        """Whether the case is worth studying: anything asked of it is missing."""
        asked = {
            "clean": self.verdict_right,
            "single": self.first_right and self.place_right,
            "double": self.found == 2,
            "outside": self.verdict_right and self.place_right,
        }[self.kind]
        return not asked or bool(self.worse_than_retuned) or (self.gap is not None and self.gap < 0.5)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One figure of the table: a share with its 95 % interval, or a plain number."""

    figure: str
    asked: str
    value: float
    interval: tuple[float, float] | None
    count: int
    met: bool | None


def wilson(successes: float, count: float) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927).

    Parameters
    ----------
    successes, count
        Successes among ``count`` trials; not whole where cases belong together.

    Returns
    -------
    tuple of float
        Lower and upper end; (0, 1) without trials.
    """
    if count == 0:
        return 0.0, 1.0
    p, z = successes / count, 1.959964
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def mark(case: str, answer: Json, diagnosis: Json, extended_nrmse: float | None) -> Mark:
    """Mark one diagnosis.

    Parameters
    ----------
    case
        Name of the case.
    answer, diagnosis
        Contents of the answer and of ``diagnosis.json``.
    extended_nrmse
        Forecast error of the extended model on the unseen recording over its standard deviation; None if not asked.
    """
    accept = [set(e["accept"]) for e in answer["effects"]]
    own = set().union(*accept) if accept else set()
    nuisance = set(answer["nuisance"]) - own
    put = [e for e in diagnosis["effects"] if e["name"] not in nuisance] if diagnosis["verdict"] == "effect" else []
    named = tuple(str(e["name"]) for e in put)
    right = tuple(name in own for name in named)
    found = sum(1 for names in accept if names & set(named))
    places = set(diagnosis["places"]).union(*(set(e["places"]) for e in put))
    verdict = str(diagnosis["verdict"])
    if verdict == "effect" and not put:  # an offset of the operating point is a number of the model
        verdict = "parameters"
    gap = worse = None
    if extended_nrmse is not None and answer["improvable"]:
        retuned, noise = answer["nrmse_unseen"]["retuned"], answer["nrmse_unseen"]["noise"]
        gap = (retuned - extended_nrmse) / (retuned - noise)
        worse = extended_nrmse > 1.02 * retuned
    return Mark(
        case=case,
        kind=answer["kind"],
        strength=answer["strength"],
        rig=answer["rig"],
        true_names=tuple(e["name"] for e in answer["effects"]),
        verdict=verdict,
        verdict_right=verdict == answer["verdict"],
        named=named,
        right=right,
        probabilities=tuple(float(e["probability"]) for e in put),
        found=found,
        place_right=bool(places & set(answer["places"])),
        gap=gap,
        worse_than_retuned=worse,
    )


def _share(figure: str, asked: float, hits: Sequence[bool], at_most: bool = False) -> Row:
    share = sum(hits) / len(hits) if hits else math.nan
    met = None if not hits else (share <= asked if at_most else share >= asked)
    bound = f"{'<=' if at_most else '>='} {100 * asked:.0f} %"
    return Row(figure=figure, asked=bound, value=share, interval=wilson(sum(hits), len(hits)), count=len(hits), met=met)


def calibration_error(statements: Sequence[tuple[float, bool]]) -> float:
    """Average the distance between stated probability and share of right statements over ten bins of probability.

    Its bias is upward: a perfectly calibrated source of n statements scores about 0.4 / sqrt(n / 10).

    Parameters
    ----------
    statements : sequence of (float, bool)
        The probability that was stated, and whether it was right.
    """
    if not statements:
        return math.nan
    total = 0.0
    for b in range(_BINS):
        inside = [(p, ok) for p, ok in statements if min(int(p * _BINS), _BINS - 1) == b]
        if inside:
            total += abs(sum(p for p, _ in inside) - sum(ok for _, ok in inside))
    return total / len(statements)


def table(marks: Sequence[Mark]) -> list[Row]:
    """Rows of the proof's table.

    ``actuator.offset`` alone is left out of the false alarms: it is marked by :func:`mark` as a matter of numbers.
    """
    clear = [m for m in marks if m.kind == "single" and m.strength != "weak"]
    weak = [m for m in marks if m.kind == "single" and m.strength == "weak"]
    doubles = [m for m in marks if m.kind == "double"]
    outside = [m for m in marks if m.kind == "outside"]
    inside = [m for m in marks if m.kind in ("single", "double")]
    clean = [m for m in marks if m.kind == "clean"]
    statements = [(p, ok) for m in marks for p, ok in zip(m.probabilities, m.right, strict=True)]
    sure = [not ok for p, ok in statements if p >= 0.95]
    gaps = sorted(m.gap for m in marks if m.gap is not None)
    worse = [bool(m.worse_than_retuned) for m in marks if m.worse_than_retuned is not None]
    error = calibration_error(statements)
    middle = gaps[len(gaps) // 2] if gaps else math.nan
    return [
        _share("singles, medium and strong: right name first", 0.90, [m.first_right for m in clear]),
        _share("singles, weak: right name first", 0.65, [m.first_right for m in weak]),
        _share("singles, weak, not named right: abstained", 0.5, [m.abstained for m in weak if not m.first_right]),
        _share("place", 0.95, [m.place_right for m in inside]),
        _share("false alarm on clean and parameter-only", 0.02, [m.verdict in _ALARMS for m in clean], at_most=True),
        _share("clean: verdict none or parameters, the right one", 0.9, [m.verdict_right for m in clean]),
        _share("doubles: one named", 0.95, [m.found >= 1 for m in doubles]),
        _share("doubles: both named", 0.65, [m.found == 2 for m in doubles]),
        _share("outside the catalogue: abstains", 0.90, [m.verdict == "unexplained" for m in outside]),
        _share("outside the catalogue: localises", 0.80, [m.place_right for m in outside]),
        Row(
            figure="calibration: expected error",
            asked="<= 0.05",
            value=error,
            interval=None,
            count=len(statements),
            met=None if not statements else error <= 0.05,
        ),
        _share("calibration: wrong at p >= 0.95", 0.02, sure, at_most=True),
        Row(
            figure="gap closed on unseen excitation, median",
            asked=">= 0.95",
            value=middle,
            interval=None,
            count=len(gaps),
            met=None if not gaps else middle >= 0.95,
        ),
        _share("extended worse than retuned on unseen", 0.0, worse, at_most=True),
    ]


def resolved(ties: Sequence[bool]) -> Row:
    """Row of the proof's table: whether each tie was resolved by one experiment."""
    return _share("a tie resolved by one experiment of the tool's choosing", 0.85, ties)


_ALARMS = ("effect", "unexplained")


def confusion(marks: Sequence[Mark]) -> list[tuple[str, int, int, list[tuple[str, int]]]]:
    """Confusion matrix by rows: true name, cases, right ones, and what was said instead, most frequent first."""
    rows: dict[str, list[Mark]] = {}
    for m in marks:
        if m.kind != "double":
            rows.setdefault(m.true_names[0] if m.true_names else f"({m.kind})", []).append(m)
    out = []
    for name in sorted(rows):
        group = rows[name]
        good = [m.verdict_right if m.kind in ("clean", "outside") else m.first_right for m in group]
        said = Counter(m.named[0] if m.named else m.verdict for m, right in zip(group, good, strict=True) if not right)
        out.append((name, len(group), sum(good), said.most_common()))
    return out
