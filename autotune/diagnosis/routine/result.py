"""What a look at a routine record says: the fields of routine.json as frozen data."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from autotune.diagnosis.routine.operation import Operation
from autotune.diagnosis.routine.oscillation import SetpointAnswer
from autotune.diagnosis.routine.valves import Interval, ValveComparison
from autotune.whole_files import write_json

Verdict: TypeAlias = Literal["stiction", "backlash", "tight_tuning", "outside_oscillation", "none", "abstain"]


@dataclass(frozen=True, kw_only=True)
class Oscillation:
    """The dominant oscillation of y.

    Attributes
    ----------
    period_s : float
        Its period [s], NaN where no line stands out.
    regularity : float
        Of y; over 1 it oscillates.
    share : float
        Of y's variance in the line.
    phase_kept : float
        Share of y's variance on stretches left out that one sine predicts.
    periods : float
        That the record holds.
    """

    period_s: float
    regularity: float
    share: float
    phase_kept: float
    periods: float


@dataclass(frozen=True, kw_only=True, eq=False)
class RoutineDiagnosis:
    """Outcome of a look at a loop in operation.

    Attributes
    ----------
    verdict : str
        ``stiction``, ``backlash``, ``tight_tuning``, ``outside_oscillation``, ``none`` (the loop neither oscillates nor
        shows a fault) or ``abstain`` (it oscillates, and the record does not say why).
    kinds_apart : bool
        Whether sticking and play are told apart.
    valves : ValveComparison
        The best faulty valve against a linear one.
    oscillation : Oscillation
        Of y.
    answer : SetpointAnswer or None
        To the set-point, where it moves.
    sentences : tuple of str
        The finding in words, the verdict first.
    following : str
        What to do next.
    operation : Operation
        The recordings, for the report.
    """

    verdict: Verdict
    kinds_apart: bool
    valves: ValveComparison
    oscillation: Oscillation
    answer: SetpointAnswer | None
    sentences: tuple[str, ...]
    following: str
    operation: Operation

    @property
    def faulty(self) -> bool:
        """Whether a valve's fault is named."""
        return self.verdict in ("stiction", "backlash")

    @property
    def band(self) -> Interval | None:
        """S of the valve [u], where its fault is named."""
        return self.valves.band if self.faulty else None

    @property
    def jump(self) -> Interval | None:
        """J of the valve [u], where its fault is named; 0 for play."""
        return self.valves.jump if self.faulty else None

    def as_json(self) -> dict[str, Any]:
        """Return the content of routine.json."""
        answer, seen, valves = self.answer, self.oscillation, self.valves
        return {
            "schema": 2,
            "verdict": self.verdict,
            "valve": self._valve(),
            "against_linear": {
                "decrease": valves.decrease, "chance": valves.chance, "reversals": valves.reversals,
            },
            "oscillation": {
                "period_s": _number(seen.period_s), "periods": _number(seen.periods), "regularity": seen.regularity,
                "share": seen.share, "phase_kept": seen.phase_kept,
            },
            "setpoint_answer": None
            if answer is None
            else {"damping": answer.damping, "period_s": answer.period_s, "explained": answer.explained},
            "sentences": list(self.sentences),
            "next": self.following,
        }  # fmt: skip

    def _valve(self) -> dict[str, Any] | None:
        if self.band is None or self.jump is None:
            return None
        unit = self.operation.u_unit
        return {
            "band": asdict(self.band) | {"unit": unit},
            "slip_jump": asdict(self.jump) | {"unit": unit},
            "band_of_range": self.band.value / self.valves.span,
            "kinds_apart": self.kinds_apart,
            "runs_on": self.valves.valve.runs_on,
        }

    def write(self, path: Path) -> None:
        """Write routine.json."""
        write_json(path, self.as_json())


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
