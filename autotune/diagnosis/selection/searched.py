"""What a search for a chain found: the nominal model, the retuned one, and every hypothesis with its fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.effect_line import line_of
from autotune.diagnosis.evidence.missing_law import MissingLaw, law_of
from autotune.diagnosis.evidence.unseen_run import UnseenRun, unseen_run
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.selection.hypothesis import Hypothesis
from autotune.diagnosis.selection.retuned_numbers import RetunedNumber, retuned_numbers
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of
from autotune.equations.identifiability import Combination, combinations_by_certainty
from autotune.models import Model
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """Everything that the search found; it answers what :class:`autotune.diagnosis.result.SearchResult` asks.

    Attributes
    ----------
    data : Data
        Recordings with windows and noise.
    nominal : Fit
        Nominal numbers, start states fitted.
    retuned : Hypothesis
        Nominal structure, numbers fitted.
    others : tuple of Hypothesis
        Hypotheses with effects, the best first.
    chosen : Hypothesis
        The one that the data ask for; the retuned model where no effect is needed.
    """

    data: Data
    nominal: Fit
    retuned: Hypothesis
    others: tuple[Hypothesis, ...] = ()
    chosen: Hypothesis

    @property
    def all(self) -> tuple[Hypothesis, ...]:
        """Every hypothesis, the retuned model first."""
        return (self.retuned, *self.others)

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was measured, as it was simulated."""
        return self.data.recordings

    @property
    def limits(self) -> Thresholds:
        """What decided."""
        return self.data.thresholds

    @property
    def units(self) -> tuple[str, str]:
        """Units of the command and of the reading."""
        return self.drawn.input.unit, self.drawn.output.unit

    @property
    def drawn(self) -> Model:
        """The nominal chain."""
        return self.retuned.fit.parametrisation.model

    @property
    def several_levels(self) -> bool:
        """Whether the plant has levels one above the other, which an effect of the plant acts on alike."""
        return self.chosen.fit.sim.chain.levels > 1

    @property
    def has_effects(self) -> bool:
        """Whether the hypothesis to go on with has effects that the model lacks."""
        return self.chosen.fit is not self.retuned.fit

    def simulated(self) -> Mapping[str, tuple[FloatArray, ...]]:
        """Return the readings of every recording by the retuned and the extended model."""
        fits = {"retuned": self.retuned.fit} | ({"extended": self.chosen.fit} if self.has_effects else {})
        return {name: tuple(s[:, 0] for s in one.signals) for name, one in fits.items()}

    def runs(self) -> tuple[int, ...]:
        """Return in how many runs each recording was simulated."""
        return tuple(len(starts) for starts in self.data.starts)

    def numbers(self) -> tuple[RetunedNumber, ...]:
        """Return the chain's numbers before and after."""
        return retuned_numbers(self.retuned.fit, self.chosen.fit)

    def combinations(self) -> list[Combination]:
        """Return the directions of the numbers by how well the recordings determine them, the least first."""
        result = self.chosen.fit
        own = (f.name for f in self.retuned.fit.parametrisation.free if f.kind != "effect")
        called = dict(zip(own, self.numbers(), strict=True))
        free = result.parametrisation.free
        told = [i for i, f in enumerate(free) if f.name in called and np.isfinite(f.spread) and f.spread > 0.0]
        spread = np.array([free[i].spread for i in told])
        believed = result.covariance[np.ix_(told, told)] / np.outer(spread, spread)
        names = [f"{called[free[i].name].block} {called[free[i].name].name}" for i in told]
        return combinations_by_certainty(believed, spread, names)

    def hypotheses(self) -> list[tuple[str, float]]:
        """Return combinations of effects with the decrease of chi-square, numbers paid for, the best first."""
        order = sorted(self.others, key=lambda h: h.penalised_chi2)
        best = {frozenset(h.names): h for h in reversed(order)}  # the better fit of each
        base = self.retuned.penalised_chi2
        return [(" + ".join(h.names), base - h.penalised_chi2) for h in order if h is best[frozenset(h.names)]]

    def laws(self) -> tuple[MissingLaw, ...]:
        """Return the laws of the chosen effects over their signals, with the data in bins."""
        chosen, own = self.chosen, self.chosen.fit.parametrisation.own
        lines = (line_of(chosen.fit, self.data, own + i, kind_of(name)) for i, name in enumerate(chosen.names))
        return tuple(law for law in map(law_of, lines) if law is not None)

    def unseen_run(self) -> UnseenRun | None:
        """Return free runs through a stretch that no number was fitted to."""
        return unseen_run(self.nominal, self.retuned.fit, self.chosen.fit, self.data)
