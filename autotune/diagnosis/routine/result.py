"""What a look at a routine record says: the fields of routine.json as frozen data."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.routine.candidates import Bench
from autotune.diagnosis.routine.fitting import Family, Fitted, LeftOut
from autotune.diagnosis.routine.oscillation import SetpointAnswer

Verdict: TypeAlias = Literal["stiction", "backlash", "tight_tuning", "outside_oscillation", "none", "abstain"]


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float

    def as_json(self, unit: str) -> dict[str, Any]:
        """Return the value with its bounds and unit."""
        return {"value": self.value, "low": self.low, "high": self.high, "unit": unit}


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Free runs of two families on stretches left out.

    Attributes
    ----------
    decrease : float
        Mean over the stretches of the logarithm of the squared error of the first over that of the second.
    chance : float
        Probability that the second wins as clearly by chance: Student's t of those logarithms, one-sided.
    won : int
        Stretches on which the second is better.
    """

    decrease: float
    chance: float
    won: int


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
    band, jump : Interval or None
        S and J of the valve [u], where a valve's fault is named; J of play is 0.
    kinds_apart : bool
        Whether sticking and play are told apart.
    fits : mapping of str to Fitted
        Best candidate of every family over all stretches.
    runs : mapping of str to LeftOut
        Free runs of every family on stretches left out.
    spread : (M,) array
        Sum of squares of y on every stretch, without mean and slope of its windows.
    against_linear : mapping of str to Comparison
        Play and stiction against a linear valve.
    wide : mapping of str to Comparison
        The same for valves whose band is wide enough to keep the loop swinging: what the verdict rests on. A narrow
        band is hardly more than a dead time.
    oscillation : Oscillation
        Of y.
    answer : SetpointAnswer or None
        To the set-point, where it moves.
    sentences : tuple of str
        The finding in words, the verdict first.
    following : str
        What to do next.
    bench : Bench
        Recordings and candidates, for the report.
    """

    verdict: Verdict
    band: Interval | None
    jump: Interval | None
    kinds_apart: bool
    fits: dict[Family, Fitted]
    runs: dict[Family, LeftOut]
    spread: FloatArray
    against_linear: dict[Family, Comparison]
    wide: dict[Family, Comparison]
    oscillation: Oscillation
    answer: SetpointAnswer | None
    sentences: tuple[str, ...]
    following: str
    bench: Bench

    @property
    def family(self) -> Family:
        """The family of candidates that the verdict is about: linear where no valve's fault is named."""
        named: dict[str, Family] = {"stiction": "stiction", "backlash": "play"}
        return named.get(self.verdict, "linear")

    def error_of(self, family: Family) -> float:
        """Return the root mean square error on stretches left out over the spread of y there."""
        return float(np.sqrt(self.runs[family].errors.sum() / max(float(self.spread.sum()), 1e-300)))

    def as_json(self) -> dict[str, Any]:
        """Return the content of routine.json."""
        answer, seen = self.answer, self.oscillation
        compared: dict[str, Comparison] = {str(family): one for family, one in self.against_linear.items()}
        compared |= {f"wide_{family}": one for family, one in self.wide.items()}
        return {
            "schema": 1,
            "verdict": self.verdict,
            "valve": self._valve(),
            "plant": self._plant(),
            "free_run": {
                "metric": "nrmse",
                "held_out": True,
                "stretches": int(self.spread.size),
                **{family: _number(self.error_of(family)) for family in self.runs},
            },
            "against_linear": {
                name: {"decrease": c.decrease, "chance": c.chance, "stretches_won": c.won}
                for name, c in compared.items()
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
        return {
            "band": self.band.as_json(self.bench.of.u_unit),
            "slip_jump": self.jump.as_json(self.bench.of.u_unit),
            "band_of_range": self.band.value / self.bench.span,
            "kinds_apart": self.kinds_apart,
            "runs_on": self.fits[self.family].at.runs_on,
        }

    def _plant(self) -> dict[str, Any]:
        fitted = self.fits[self.family]
        lag, operation = self.bench.lag(fitted.at), self.bench.of
        length = float(np.median(np.diff(operation.windows, axis=1))) * operation.dt_s
        slow = lag.lag_s > length  # longer than the free runs: it cannot be told from an integrator
        return {
            "gain": fitted.gain / lag.lag_s if slow else fitted.gain,
            "gain_unit": "{y}/{u}/s" if slow else "{y}/{u}",
            "integrating": slow,
            "lag_s": None if slow else lag.lag_s,
            "second_lag_s": lag.second_s,
            "dead_time_s": float(self.bench.delays[fitted.delay]) * operation.dt_s,
        }

    def write(self, path: Path) -> None:
        """Write routine.json."""
        path.write_text(json.dumps(self.as_json(), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
