"""What a diagnosis says: the fields of diagnosis.json as frozen data."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from autotune.diagnosis.evidence.adequacy import ResidualTests
from autotune.diagnosis.evidence.description import Description
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.selection.probability import Candidate
from autotune.diagnosis.selection.searched import Search
from autotune.models import Model, Parameter

Verdict: TypeAlias = Literal["none", "parameters", "effect", "unexplained"]


@dataclass(frozen=True, kw_only=True)
class OperatingRange:
    """Between which values of a signal an effect was seen."""

    signal: str
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class FoundEffect:
    """An effect that was added to the model."""

    name: str
    probability: float
    places: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    equation: str
    windows: tuple[tuple[int, float, float], ...]
    operating_range: OperatingRange | None = None


def told_apart(hypotheses: Sequence[str]) -> str:
    """Return the purpose of an experiment between hypotheses, each with its effects joined by a plus sign."""
    *others, last = (name.replace("+", " + ") for name in hypotheses)
    return f"tell {', '.join(others)} from {last}" if len(others) == 1 else f"tell {', '.join(others)} and {last} apart"


@dataclass(frozen=True, kw_only=True)
class NextExperiment:
    """What to record next, and what it would show."""

    purpose: str
    kind: str
    settings: Mapping[str, Any]
    expected: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Diagnosis:
    """Outcome of a diagnosis.

    Attributes
    ----------
    verdict : str
        ``none``, ``parameters``, ``effect`` or ``unexplained``.
    effects : tuple of FoundEffect
        What was added to the model, the most important first.
    candidates : tuple of Candidate
        Hypotheses with their probabilities.
    places : tuple of str
        Where the mismatch sits.
    fit : FitQuality
        Errors on rows that were not fitted.
    next_experiment : NextExperiment, optional
        What would decide between what is left.
    extended_model : Model
        The model to go on with.
    sentences : tuple of str
        The finding in words.
    residual : ResidualTests
        What the chosen model leaves, and whether that is noise.
    description : Description, optional
        What is left of the residual as a function of the signals, where no effect of the catalogue explains it; not a
        cause.
    search : Search
        All hypotheses, for the report.
    withheld : str
        Why the extended model is without what was found, where it is.
    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    candidates: tuple[Candidate, ...]
    places: tuple[str, ...]
    fit: FitQuality
    next_experiment: NextExperiment | None
    extended_model: Model
    sentences: tuple[str, ...]
    residual: ResidualTests
    description: Description | None
    search: Search
    withheld: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the content of diagnosis.json."""
        following = self.next_experiment
        return {
            "schema": 1,
            "verdict": self.verdict,
            "effects": [_effect(effect) for effect in self.effects],
            "candidates": [{"name": c.name, "probability": round(c.probability, 4)} for c in self.candidates],
            "places": list(self.places),
            "fit": {
                "metric": "nrmse",
                "held_out": True,
                "nominal": self.fit.nominal,
                "retuned": self.fit.retuned,
                "extended": self.fit.extended,
                "noise_floor": self.fit.noise_floor,
            },
            "residual": self.residual.as_json(),
            "next_experiment": None
            if following is None
            else {
                "purpose": following.purpose,
                "kind": following.kind,
                "settings": dict(following.settings),
                "expected": following.expected,
            },
        } | ({} if self.description is None else {"description": self.description.as_json()})

    def write(self, path: Path) -> None:
        """Write diagnosis.json."""
        path.write_text(json.dumps(self.as_json(), indent=2) + "\n", encoding="utf-8")


def _effect(effect: FoundEffect) -> dict[str, Any]:
    table: dict[str, Any] = {
        "name": effect.name,
        "probability": round(effect.probability, 4),
        "places": list(effect.places),
        "parameters": {
            name: {"value": p.value, "sd": p.sd if np.isfinite(p.sd) else None, "unit": p.unit}
            for name, p in effect.parameters.items()
        },
        "equation": effect.equation,
        "windows": [list(w) for w in effect.windows],
    }
    if effect.operating_range is not None:
        r = effect.operating_range
        table["operating_range"] = {"signal": r.signal, "low": r.low, "high": r.high}
    return table
