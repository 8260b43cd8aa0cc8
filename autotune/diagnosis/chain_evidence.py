"""What recordings show of a chain, and how its effects are read, kept, run and handed out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from autotune.arrays import BoolArray
from autotune.diagnosis.evidence.adequacy import residual_tests
from autotune.diagnosis.evidence.description import Description, describe
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.evidence.misread import BUT_LATE, misread_columns
from autotune.diagnosis.evidence.operating_point import unmoved
from autotune.diagnosis.evidence.own_noise import OwnNoise
from autotune.diagnosis.extended import extended_model, with_uncertainty
from autotune.diagnosis.fitting.retuning import under_noise
from autotune.diagnosis.readable import in_commands, readable
from autotune.diagnosis.result import FoundEffect, OperatingRange, Verdict
from autotune.diagnosis.safe_extension import safe_extension
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.selection.hypothesis import contradicted_effects
from autotune.diagnosis.selection.judged_chain import JudgedChain, as_search, at_both_scales, quality, varies_more
from autotune.diagnosis.selection.probability import probability_of
from autotune.diagnosis.selection.search import Found
from autotune.diagnosis.selection.searched import Search
from autotune.diagnosis.simulation.chain import build_chain
from autotune.diagnosis.simulation.forecast import forecast
from autotune.diagnosis.verdict import OFFSET, Evidence
from autotune.effects import STRUCTURES, kind_of
from autotune.models import Effect, Model, Parameter
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class ChainEvidence(Evidence):
    """What recordings show of a chain.

    Attributes
    ----------
    model : Model
        The nominal chain.
    search : Search
        Hypotheses with their fits.
    quality_of : callable
        Returns errors on rows that were not fitted.
    own : OwnNoise, optional
        What is left, where it is noise of its own colour.
    """

    free = frozenset({OFFSET})
    model: Model
    search: Search
    quality_of: Callable[[], FitQuality]
    found: Found[JudgedChain] | None = None
    own: OwnNoise | None = None

    @property
    def result(self) -> Search:
        """What the search found."""
        return self.search

    @cached_property
    def quality(self) -> FitQuality:
        """Errors on rows that were not fitted."""
        return self.quality_of()

    @property
    def varies_more(self) -> bool:
        """Whether what varies beside chosen effects that leave noise explains more than it may where they are true."""
        return self.found is not None and varies_more(self.found)

    @property
    def jitter_explains_more(self) -> bool:
        """Whether a clock that jitters explains more than what varies: it disturbs commands too."""
        jitter = sum(s.evidence for s in self.samples if kind_of(s.name).sought == "residual")
        return self.residual.varies.gain < self.limits.majority * jitter

    @cached_property
    def contradicted(self) -> frozenset[str]:
        """Chosen effects by whose name readings do not behave; asked where the model's error and not noise decides."""
        if self.found is None or self.found.chosen.leaves_noise:
            return frozenset()
        return contradicted_effects(self.search.chosen, self.search.data)

    @property
    def own_noise(self) -> str:
        """What is said of a residual that is noise of its own colour."""
        return "" if self.own is None else self.own.sentence

    @property
    def unsaid(self) -> str:
        """What the model does not say of itself, so that some effects were not looked for."""
        model, chain = self.model, self.search.retuned.fit.sim.chain
        told = model.output.unit or any(b.output or b.unit for b in model.blocks)
        if told or chain.is_mechanical or not any(len(b.dynamics.den) == 2 for b in model.blocks):
            return ""
        return (
            'The model does not say what y is. If it is a speed, output = "speed" in its block lets dry friction and'
            " drag be looked for."
        )

    @property
    def numbers(self) -> float:
        """Decrease of chi-square that retuning brings beside the nominal numbers."""
        if self.own is not None:
            return self.own.numbers
        retuned = self.search.retuned.fit
        return self.search.nominal.chi2 - retuned.chi2 - retuned.penalty

    def going_on(self, best: JudgedChain) -> ChainEvidence:
        """Return the evidence with another hypothesis to go on with."""
        assert self.found is not None
        found, residual, floor = self.found, self.residual, self.quality.noise_floor
        left = at_both_scales(best, found.judged).spread_out() if best.names else found.retuned
        if found.chosen.leaves_noise or left.leaves_noise:
            residual = residual_tests(left.fit, under_noise(left.fit, left.data), uneven=residual.uneven)
        found = replace(found, chosen=left)
        return replace(
            self, search=as_search(found), residual=residual, quality_of=lambda: quality(found, floor), found=found
        )

    def untold(self, part: Sequence[Recording]) -> frozenset[str]:
        """Return the effects that are not told from others where no command moves."""
        return frozenset(unmoved(self.model, part))

    def described(self) -> list[tuple[float, FoundEffect]]:
        """Return the chosen effects as people read them, and the offset that is one."""
        chosen, found = self.search.chosen, []
        for effect in with_uncertainty(chosen, chosen.fit.model.effects)[chosen.fit.parametrisation.own :]:
            if effect.name not in self.contradicted and effect.name not in STRUCTURES:
                found.append((self._lost_without(effect.name), self._described(effect)))
        if self.offset is not None and not any(e.name in kind_of(OFFSET).same for _, e in found):
            found.append((-math.inf, self._offset(self.offset.value, self.offset.sd)))
        return found

    def _offset(self, value: float, sd: float) -> FoundEffect:
        kind, unit = kind_of(OFFSET), self.model.input.unit
        parameters = {"offset": Parameter(value=value, sd=sd, unit=unit)}
        return FoundEffect(
            name=OFFSET, probability=1.0 / (1.0 + self.unknown_odds), places=kind.places,
            parameters=MappingProxyType(parameters), equation=kind.equation, windows=self.everywhere,
        )  # fmt: skip

    def _lost_without(self, name: str) -> float:
        """Return the penalised chi-square that is lost without a chosen effect, as far as that was fitted."""
        rest = frozenset(self.names) - {name}
        known = {frozenset(h.names): h.penalised_chi2 for h in reversed(self.search.all)}
        return known.get(rest, self.search.retuned.penalised_chi2) - self.search.chosen.penalised_chi2

    def _described(self, effect: Effect) -> FoundEffect:
        kind, parameters = kind_of(effect.name), readable(effect)
        return FoundEffect(
            name=effect.name,
            probability=probability_of(effect.name, self.candidates),
            places=self.places(effect.name),
            parameters=MappingProxyType(parameters),
            equation=kind.equation,
            windows=self.acting(effect),
            operating_range=self._range(kind.place),
            as_command=MappingProxyType(self._as_command(effect.name, parameters)),
        )

    def _as_command(self, name: str, parameters: Mapping[str, Parameter]) -> dict[str, Parameter]:
        """Return sizes at the plant's input as the steady command that does the same."""
        fitted, gain = self.search.chosen.fit.model, 1.0
        for block in fitted.blocks:
            if block.place != "actuator":
                break
            gain *= block.dynamics.num[-1] / block.dynamics.den[-1] if block.dynamics.den[-1] else math.inf
        return in_commands(name, parameters, 1.0 / gain, self.model.input.unit) if gain else {}

    def _range(self, place: str) -> OperatingRange:
        column, name = {"plant": (2, "position"), "sensor": (0, "y")}.get(place, (3, "plant input"))
        values = np.concatenate([s[:, column] for s in self.search.chosen.fit.signals])
        unit = self.model.plant_input_unit if name == "plant input" else self.model.output.unit
        return OperatingRange(signal=name, low=float(np.nanmin(values)), high=float(np.nanmax(values)), unit=unit)

    def misread_columns(self) -> str:
        """Say what is wrong with the columns, where the model then explains the recordings."""

        def read(changed: Sequence[Recording], good: Sequence[BoolArray]) -> tuple[float, bool]:
            found = search_chain(self.model, changed, good, BUT_LATE, limits=self.limits)
            return found.chosen.error, found.chosen.heeds_commands

        return misread_columns(self.measured, self.model.input.offset, self.quality, self.limits, read)

    @property
    def measured(self) -> tuple[Recording, ...]:
        """What was measured, all rows."""
        return self.search.data.driving

    def description(self) -> Description | None:
        """Return what is left as a function of the signals."""
        return describe(self.search.retuned.fit, self.search.data)

    def handed_out(self, verdict: Verdict) -> tuple[Model, Model]:
        """Return the chain to go on with, and the one that was wanted."""
        wanted, nominal = extended_model(self, verdict), self.model
        if wanted is nominal:
            return nominal, nominal
        # a model without what happened at a time of these recordings cannot follow them to their end
        lasting = not any(kind_of(name).at_a_time for name in self.names)
        comparable = lasting and bool(np.all(np.linalg.eigvals(build_chain(nominal).A).real < 0.0))
        able = (wanted, self.search.retuned.fit.model)
        handed_out = safe_extension(able, nominal, self.measured, forecast, comparable=comparable, retuned=able[1])
        return handed_out, wanted
