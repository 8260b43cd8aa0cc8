"""What a diagnosis says: the fields of diagnosis.json as frozen data, of chains, equations and closed models alike."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.adequacy import ResidualTests
from autotune.diagnosis.evidence.description import Description
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.evidence.missing_law import MissingLaw
from autotune.diagnosis.evidence.unseen_run import UnseenRun
from autotune.diagnosis.selection.probability import Candidate
from autotune.diagnosis.selection.retuned_numbers import RetunedNumber
from autotune.diagnosis.thresholds import Thresholds
from autotune.equations.files import AnyModel
from autotune.equations.identifiability import Combination, undetermined
from autotune.models import Model, Parameter
from autotune.recording import Recording
from autotune.whole_files import write_whole

Verdict: TypeAlias = Literal["none", "parameters", "effect", "unexplained"]


@dataclass(frozen=True, kw_only=True)
class OperatingRange:
    """Between which values of a signal an effect was seen."""

    signal: str
    low: float
    high: float
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class FoundEffect:
    """An effect that was added to the model.

    Attributes
    ----------
    name, equation : str
        Name in the catalogue, and what it does.
    probability : float
        That it is part of the truth, by all rows and by the parts that tell of it.
    places : tuple of str
        Where it may sit.
    parameters : mapping of str to Parameter
        Its numbers with units.
    windows : tuple of (recording, t0, t1)
        When it acts, recordings counted from 0 in the order given.
    operating_range : OperatingRange, optional
        Between which values of its signal it was seen.
    state, port, input, column : str
        Where it acts in equations, and the recorded column that it is of.
    as_command : mapping of str to Parameter
        Its sizes as the steady command that does the same: one unit for a chain and for equations.
    alike : tuple of str
        Effects that do nearly the same and are not ruled out beside it.
    together : float
        Where there are any: that it, or one of them, is part of the truth.
    """

    name: str
    probability: float
    places: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    equation: str
    windows: tuple[tuple[int, float, float], ...]
    operating_range: OperatingRange | None = None
    state: str = ""
    port: str = ""
    input: str = ""
    column: str = ""
    as_command: Mapping[str, Parameter] = field(default_factory=dict)
    alike: tuple[str, ...] = ()
    together: float = 0.0

    @property
    def in_odds(self) -> str:
        """Its probability in words, and that of it together with those that do nearly the same."""
        beside = (
            f"; {self.together:.2f} with {' or '.join(self.alike)}, which does nearly the same" if self.alike else ""
        )
        return f"probability {self.probability:.2f}{beside}"

    @property
    def at(self) -> str:
        """Where it acts in equations, for a reader; nothing in a chain, whose places its name says."""
        where = self.state or self.port or self.input
        return f"{where or 'the reading'} from column {self.column}" if self.column else where


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


class SearchResult(Protocol):
    """What a search found, as pages and planning ask for it: of a chain and of equations alike."""

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was measured, as it was simulated."""

    @property
    def limits(self) -> Thresholds:
        """What decided between two findings."""

    @property
    def units(self) -> tuple[str, str]:
        """Units of the command and of the reading."""

    @property
    def drawn(self) -> Model:
        """The chain of boxes that the model is drawn as."""

    @property
    def several_levels(self) -> bool:
        """Whether every box of a place is concerned by what is missing there."""

    @property
    def has_effects(self) -> bool:
        """Whether the hypothesis to go on with has effects that the model lacks."""

    def simulated(self) -> Mapping[str, tuple[FloatArray, ...]]:
        """Return the readings (N,) of every recording as ``retuned`` and, where effects were added, ``extended``."""

    def runs(self) -> tuple[int, ...]:
        """Return in how many runs each recording was simulated, a start state fitted for each."""

    def numbers(self) -> tuple[RetunedNumber, ...]:
        """Return the model's numbers before and after."""

    def combinations(self) -> list[Combination]:
        """Return the directions of the numbers by how well the recordings determine them, the least first."""

    def hypotheses(self) -> list[tuple[str, float]]:
        """Return what was fitted to all rows with the decrease of chi-square, numbers paid for, the best first."""

    def laws(self) -> tuple[MissingLaw, ...]:
        """Return the laws of added effects over their signals, with the data in bins."""

    def unseen_run(self) -> UnseenRun | None:
        """Return free runs through a stretch that no number was fitted to."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Diagnosis:
    """Outcome of a diagnosis.

    Attributes
    ----------
    verdict : str
        ``none``, ``parameters``, ``effect`` or ``unexplained``.
    effects : tuple of FoundEffect
        What was added to the model, and what samples show, the most important first.
    candidates : tuple of Candidate
        Hypotheses with their probabilities; those of an effect add up to the probability that is stated for it.
    places : tuple of str
        Where the mismatch sits.
    fit : FitQuality
        Errors on rows that were not fitted.
    extended_model : Model, EquationModel or BlackBox
        The model to go on with, of the kind that was given.
    sentences : tuple of str
        The finding in words.
    is_clean : bool
        Whether nothing larger than noise is left.
    residual : ResidualTests
        What the chosen model leaves, and whether that is noise.
    search : SearchResult
        All hypotheses, for the report.
    description : Description, optional
        What is left of the residual as a function of the signals, where no effect of the catalogue explains it; not a
        cause.
    next_experiment : NextExperiment, optional
        What would decide between what is left.
    withheld : str
        Why the extended model is without what was found, where it is.
    order : tuple of int
        Number, in the order in which they were given, of each recording of ``search``.
    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    candidates: tuple[Candidate, ...]
    places: tuple[str, ...]
    fit: FitQuality
    extended_model: AnyModel
    sentences: tuple[str, ...]
    is_clean: bool
    residual: ResidualTests
    search: Any  # a SearchResult; planning asks chains and equations for more
    description: Description | None = None
    next_experiment: NextExperiment | None = None
    withheld: str = ""
    order: tuple[int, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the content of diagnosis.json."""
        following, search = self.next_experiment, self.search
        return {
            "schema": 1,
            "verdict": self.verdict,
            "effects": [_effect(effect) for effect in self.effects],
            "candidates": [{"name": c.name, "probability": round(c.probability, 4)} for c in self.candidates],
            "places": list(self.places),
            "fit": {"metric": "nrmse", "held_out": True} | asdict(self.fit),
            "residual": self.residual.as_json(),
            "parameters": {
                f"{n.block} {n.name}".strip(): {
                    "value": n.value[0],
                    "sd": n.value[1],
                    "nominal": n.nominal,
                    "unit": n.unit,
                }
                for n in search.numbers()
            },
            "undetermined": [one.sentence for one in undetermined(search.combinations())],
            "next_experiment": None if following is None else asdict(following),
        } | ({} if self.description is None else {"description": self.description.as_json()})

    def write(self, path: Path) -> None:
        """Write diagnosis.json."""
        write_whole(path, json.dumps(self.as_json(), indent=2) + "\n")


def _effect(effect: FoundEffect) -> dict[str, Any]:
    table: dict[str, Any] = {
        "name": effect.name,
        "probability": round(effect.probability, 4),
        "places": list(effect.places),
        "parameters": _numbers(effect.parameters),
        **{key: getattr(effect, key) or None for key in ("state", "input", "port", "column")},
        "equation": effect.equation,
        "windows": [list(w) for w in effect.windows],
    }
    if effect.as_command:
        table["as_command"] = _numbers(effect.as_command)
    if effect.operating_range is not None:
        table["operating_range"] = asdict(effect.operating_range)
    return table


def _numbers(parameters: Mapping[str, Parameter]) -> dict[str, Any]:
    return {
        name: {"value": p.value, "sd": p.sd if np.isfinite(p.sd) else None, "unit": p.unit}
        for name, p in parameters.items()
    }
