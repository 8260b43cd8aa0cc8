"""What recordings show of equations or of a closed model, and how effects are read, kept, run and handed out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

from autotune.arrays import BoolArray
from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.closed import ClosedBench
from autotune.diagnosis.equations.equation_bench import EquationBench
from autotune.diagnosis.equations.equation_proposals import search_equations
from autotune.diagnosis.equations.judged import JudgedEquations
from autotune.diagnosis.equations.scores import slow_power, variance_ratio
from autotune.diagnosis.equations.shown import EquationSearch
from autotune.diagnosis.equations.sizes import command_of, spans_at, with_units
from autotune.diagnosis.evidence.adequacy import ResidualTests
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.evidence.misread import BUT_LATE, misread_columns
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.readable import in_commands, readable
from autotune.diagnosis.result import FoundEffect, Verdict
from autotune.diagnosis.safe_extension import safe_extension
from autotune.diagnosis.selection.probability import probability_of
from autotune.diagnosis.selection.search import Found
from autotune.diagnosis.thresholds import Thresholds
from autotune.diagnosis.verdict import Evidence
from autotune.effects import kind_of
from autotune.equations.black_box import BlackBox
from autotune.equations.effects import equation_of
from autotune.equations.files import forecast_any
from autotune.equations.linearise import settles
from autotune.equations.model import EquationModel
from autotune.models import Effect
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationEvidence(Evidence):
    """What recordings show of equations.

    Attributes
    ----------
    model : EquationModel or BlackBox
        The nominal model.
    given : tuple of Recording
        What was measured, rows that samples spoil among them.
    found : Found
        What the search found.
    """

    model: EquationModel | BlackBox
    given: tuple[Recording, ...]
    found: Found[JudgedEquations]

    @cached_property
    def result(self) -> EquationSearch:
        """What the search found."""
        return EquationSearch(model=self.model, recordings=self.given, found=self.found)

    @cached_property
    def quality(self) -> FitQuality:
        """Errors on the last third of every recording, the numbers fitted to the rest."""
        return self.found.quality(self.found.best.noise.total_sd / self.result.bench.spread)

    @property
    def leaves_noise(self) -> bool:
        """Whether what the chosen model leaves is noise."""
        return self.found.chosen.leaves_noise or self.residual.accounted

    @property
    def numbers(self) -> float:
        """Decrease of chi-square that retuning brings beside the nominal numbers."""
        return self.result.score(self.found.nominal) - self.result.score(self.found.retuned)

    def going_on(self, best: JudgedEquations) -> EquationEvidence:
        """Return the evidence with another hypothesis to go on with."""
        found = replace(self.found, chosen=best)
        return replace(self, found=found, residual=residual_left(found, self.samples))

    def described(self) -> list[tuple[float, FoundEffect]]:
        """Return the chosen effects as people read them."""
        found, described = self.found, []
        scores = {frozenset(one.names): self.result.score(one) for one in found.judged}
        for effect in found.chosen.added:
            without = scores.get(frozenset(self.names) - {effect.name}, self.result.score(found.retuned))
            described.append((without - self.result.score(found.chosen), self._described(effect)))
        return described

    def _described(self, effect: Effect) -> FoundEffect:
        named = with_units(self.result.bench.model, effect, self.model.output_unit)
        fitted = {k: q for k, q in named.parameters.items() if math.isfinite(q.sd) and q.sd != 0.0}
        shown = readable(replace(named, parameters=MappingProxyType(fitted or dict(named.parameters))))
        bench, chosen = self.result.bench, self.found.chosen.outcome
        command, unit = command_of(bench, chosen, effect), bench.model.inputs[0]
        return FoundEffect(
            name=effect.name,
            probability=probability_of(effect.name, self.candidates),
            places=self.places(effect.name),
            parameters=MappingProxyType(shown),
            equation=equation_of(bench.model, effect),
            windows=self.acting(effect),
            operating_range=spans_at(bench, chosen, effect),
            as_command=MappingProxyType(in_commands(effect.name, shown, command, unit.unit) if command else {}),
            **{key: getattr(effect, key) for key in ("state", "port", "input", "column")},
        )

    def misread_columns(self) -> str:
        """Say what is wrong with the columns, where the model then explains the recordings."""
        if self.model.columns[0] != "u":
            return ""

        def read(changed: Sequence[Recording], good: Sequence[BoolArray]) -> tuple[float, bool]:
            bench = bench_of(self.model, changed, good, self.limits)
            outcome = bench.retuned()
            error = bench.held_out_error(outcome, True) / bench.spread
            if error >= 1.0:  # no reading: a closed model may overflow where stretches are left out of it
                return error, False
            found = search_equations(bench, BUT_LATE)
            return found.chosen.error, found.chosen.heeds_commands

        return misread_columns(self.given, self.model.inputs[0].offset, self.quality, self.limits, read)

    def handed_out(self, verdict: Verdict) -> tuple[EquationModel | BlackBox, EquationModel | BlackBox]:
        """Return the model to go on with, and the one that was wanted."""
        nominal, wanted = self.model, self._wanted(verdict)
        if wanted is nominal:
            return nominal, nominal
        lasting = not any(kind_of(name).at_a_time for name in self.names)
        comparable = lasting and (isinstance(nominal, BlackBox) or settles(nominal, self.given))
        able = (wanted, _with_numbers(nominal, self.found.retuned.outcome))
        handed_out = safe_extension(able, nominal, self.given, forecast_any, comparable=comparable, retuned=able[1])
        return handed_out, wanted

    def _wanted(self, verdict: Verdict) -> EquationModel | BlackBox:
        """Return the nominal model where nothing is missing, else what explains more."""
        found, quality = self.found, self.quality
        if verdict == "none":
            return self.model
        if self.names and quality.is_better and verdict in ("effect", "unexplained"):
            return _with_numbers(self.model, found.chosen.outcome)
        return self.model if self.nominal_stands else _with_numbers(self.model, found.retuned.outcome)


def bench_of(
    model: EquationModel | BlackBox, recordings: Sequence[Recording], good: Sequence[BoolArray], limits: Thresholds
) -> Bench:
    """Return a model on its recordings, of whose rows some count."""
    kind = ClosedBench if isinstance(model, BlackBox) else EquationBench
    bench: Bench = kind(model, recordings, good, limits)  # type: ignore[arg-type]  # each kind has its bench
    return bench


def residual_left(found: Found[JudgedEquations], samples: Sequence[SampleEffect]) -> ResidualTests:
    """Return what the chosen model leaves; noise of some rows may account for a little more than all rows' has."""
    chosen = found.chosen.outcome
    ratio, (slow, chance) = variance_ratio(chosen, found.best.noise), slow_power(chosen, found.chosen.noise)
    return ResidualTests(
        reduced_chi2=ratio, reduced_chi2_chance=math.sqrt(2.0 / chosen.residual.size), slow=slow, slow_chance=chance,
        uneven=any(kind_of(s.name).uneven for s in samples),
        accounted=bool(samples) and ratio < found.best.limits.clearly_more, limits=found.best.limits,
    )  # fmt: skip


def _with_numbers(model: EquationModel | BlackBox, outcome: Outcome) -> EquationModel | BlackBox:
    """Return a model with the numbers and effects of a fit."""
    own = len(model.parameters)
    values = outcome.fitted.parameters[:own]
    if isinstance(model, BlackBox):
        numbers = tuple(replace(p, value=float(v)) for p, v in zip(model.parameters, values, strict=True))
        return replace(model, parameters=numbers, effects=outcome.effects)
    inputs = [one for one in outcome.fitted.compiled.model.inputs if one.column not in model.columns]
    used = tuple(one for one in inputs if any(one.column == e.column for e in outcome.effects))
    effects = tuple(with_units(outcome.fitted.compiled.model, e, model.output_unit) for e in outcome.effects)
    return replace(model.with_parameters(values), inputs=(*model.inputs, *used), effects=effects)
