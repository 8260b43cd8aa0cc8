"""What a search for equations found, as pages and planning ask for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.equations.bench import Bench
from autotune.diagnosis.equations.equation_bench import EquationBench
from autotune.diagnosis.equations.held_out import HELD_OUT, bounded_errors
from autotune.diagnosis.equations.judged import JudgedEquations
from autotune.diagnosis.equations.laws import line_in_equations
from autotune.diagnosis.equations.scores import quick_score
from autotune.diagnosis.evidence.missing_law import MissingLaw, law_of
from autotune.diagnosis.evidence.unseen_run import UnseenRun
from autotune.diagnosis.selection.retuned_numbers import RetunedNumber
from autotune.diagnosis.selection.search import Found
from autotune.diagnosis.thresholds import Thresholds
from autotune.equations.black_box import BlackBox
from autotune.equations.effects import where_told
from autotune.equations.identifiability import Combination, combinations
from autotune.equations.model import EquationModel
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationSearch:
    """Everything that the search found; it answers what :class:`autotune.diagnosis.result.SearchResult` asks.

    Attributes
    ----------
    model : EquationModel or BlackBox
        The nominal model.
    recordings : tuple of Recording
        What was measured.
    found : Found
        All hypotheses.
    """

    model: EquationModel | BlackBox
    recordings: tuple[Recording, ...]
    found: Found[JudgedEquations]

    @property
    def bench(self) -> Bench:
        """The model on the rows that count."""
        return self.found.best.bench

    @property
    def limits(self) -> Thresholds:
        """What decided."""
        return self.found.best.limits

    @property
    def units(self) -> tuple[str, str]:
        """Units of the command and of the reading."""
        return self.model.inputs[0].unit, self.model.output_unit

    @property
    def drawn(self) -> Model:
        """A chain with the equations as one box, named after what they hold."""
        inside = ", ".join(self.model.state_names) if isinstance(self.model, EquationModel) else self.model.name
        one = Block(name=inside or self.model.name, place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0,)))
        u, y = self.units
        return Model(name=self.model.name, input=Port(unit=u), output=Port(unit=y), blocks=(one,))

    @property
    def several_levels(self) -> bool:
        """One box is all that is drawn."""
        return False

    @property
    def has_effects(self) -> bool:
        """Whether the hypothesis to go on with has effects that the model lacks."""
        return bool(self.found.chosen.names)

    def simulated(self) -> Mapping[str, tuple[FloatArray, ...]]:
        """Return the readings of every recording by the retuned and the extended model."""
        fits = {"retuned": self.found.retuned} | ({"extended": self.found.chosen} if self.has_effects else {})
        return {name: one.outcome.fitted.simulated for name, one in fits.items()}

    def runs(self) -> tuple[int, ...]:
        """Return in how many runs each recording was simulated."""
        return tuple(w.starts.size for w in self.found.retuned.outcome.fitted.windows) or (1,) * len(self.recordings)

    def numbers(self) -> tuple[RetunedNumber, ...]:
        """Return the model's own numbers before and after."""
        retuned, chosen = self.found.retuned.outcome.fitted, self.found.chosen.outcome.fitted
        each = zip(
            self.model.parameters, retuned.parameters, retuned.sd, chosen.parameters, chosen.sd, strict=False
        )  # fmt: skip
        return tuple(
            RetunedNumber(name=p.name, unit=p.unit, nominal=p.value, retuned=(float(a), float(s)),
                          value=(float(b), float(d)))
            for p, a, s, b, d in each
        )  # fmt: skip

    def combinations(self) -> list[Combination]:
        """Return the directions of the numbers by how well the recordings determine them, the least first."""
        return combinations(self.found.chosen.outcome.fitted, len(self.model.parameters))

    def score(self, one: JudgedEquations) -> float:
        """Return Schwarz's criterion of a fit, up to a constant."""
        return quick_score(one.outcome, self.found.best.noise)

    def hypotheses(self) -> list[tuple[str, float]]:
        """Return what was fitted to all rows with the decrease of chi-square, numbers paid for, the best first."""
        base = self.score(self.found.retuned)
        each = ((one, [f"{e.name} at {where_told(e)}" for e in one.added]) for one in self.found.others)
        found = ((" + ".join(names), base - self.score(one)) for one, names in each)
        return sorted(found, key=lambda pair: -pair[1])

    def laws(self) -> tuple[MissingLaw, ...]:
        """Return the laws of the chosen effects over their signals, with the data in bins."""
        if not isinstance(self.bench, EquationBench):
            return ()
        chosen = self.found.chosen
        numbers = range(chosen.own, len(chosen.outcome.effects))
        lines = (line_in_equations(self.bench, chosen.outcome, i) for i in numbers)
        return tuple(law for law in map(law_of, lines) if law is not None)

    def unseen_run(self) -> UnseenRun | None:
        """Return runs through the last third of the longest recording, the numbers fitted to the rest of all."""
        if not isinstance(self.bench, EquationBench):
            return None
        number = int(np.argmax([len(r) for r in self.recordings]))
        fits = {"nominal": self.found.nominal, "retuned": self.found.retuned}
        fits |= {"extended": self.found.chosen} if self.has_effects else {}
        found = {name: self.bench.held_out_runs(one.outcome, name != "nominal") for name, one in fits.items()}
        runs = {name: one[number] for name, one in found.items() if one}
        r = self.recordings[number]
        row = int((1.0 - HELD_OUT) * len(r))
        first = min((first for _, first in runs.values()), default=len(r))
        if first >= len(r):
            return None
        y = self.bench.recordings[number].y
        spread = float(np.nanstd(y[first:])) or 1.0
        errors = {name: bounded_errors(y, run, first) for name, (run, first) in runs.items()}
        return UnseenRun(
            number=number, name=r.name, unit=self.units[1], t=r.t[row:], y=y[row:], starts_s=(float(r.t[row]),),
            heads_s=(float(r.t[first]),),
            runs={name: run[row:] for name, (run, _) in runs.items() if np.all(np.isfinite(run[first:]))},
            errors={name: float(np.sqrt(np.nanmean(e**2))) / spread for name, e in errors.items()},
        )  # fmt: skip
