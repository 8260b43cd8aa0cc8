"""What a search found: the nominal model, the retuned one, and every hypothesis with its fit."""

from __future__ import annotations

from dataclasses import dataclass

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.selection.hypothesis import Hypothesis


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
