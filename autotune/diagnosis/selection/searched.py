"""What a search found: the nominal model, the retuned one, and every hypothesis with its fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.selection.hypothesis import Hypothesis
from autotune.diagnosis.selection.parsimony import worth_adding


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """Everything that the search found.

    Attributes
    ----------
    data : Data
        Recordings with windows and noise.
    nominal : Fit
        Nominal numbers, start states fitted.
    retuned : Hypothesis
        Nominal structure, numbers fitted.
    singles, pairs, triples : tuple of Hypothesis
        Hypotheses fitted, best first.
    chosen : Hypothesis
        The one that the data ask for; the retuned model where no effect is needed.
    """

    data: Data
    nominal: Fit
    retuned: Hypothesis
    singles: tuple[Hypothesis, ...] = ()
    pairs: tuple[Hypothesis, ...] = ()
    triples: tuple[Hypothesis, ...] = ()
    chosen: Hypothesis

    @property
    def all(self) -> tuple[Hypothesis, ...]:
        """Every hypothesis, the retuned model first."""
        return (self.retuned, *self.singles, *self.pairs, *self.triples)

    def asking(self, least: float) -> Search:
        """Return the search with a least decrease that effects must bring, for the choice and for the probabilities."""
        thresholds = replace(self.data.thresholds, least_decrease=least, least_decrease_beyond=least)
        keeps = worth_adding(self.retuned, self.chosen, thresholds)
        chosen = self.chosen if keeps else self.retuned
        return replace(self, data=replace(self.data, thresholds=thresholds), chosen=chosen)

    @property
    def gained(self) -> float:
        """Decrease of the penalised chi-square that the chosen effects bring."""
        return self.retuned.penalised_chi2 - self.chosen.penalised_chi2
