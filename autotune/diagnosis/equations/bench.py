"""What a search asks of a model: fit it with effects, try one more, and tell what numbers and starts can explain."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

from autotune.arrays import FloatArray
from autotune.diagnosis.equations.candidates import Signals, Trial
from autotune.equations.fit_data import Fitted
from autotune.equations.model import EquationModel
from autotune.models import Effect
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """A model fitted with effects.

    Attributes
    ----------
    effects : tuple of Effect
        With their fitted values; the model's own first.
    fitted : Fitted
        The fit.
    count : int
        Numbers that were fitted, start states apart.
    residual : (rows,) array
        Reading less simulation at the rows that count, all recordings.
    """

    effects: tuple[Effect, ...]
    fitted: Fitted
    count: int
    residual: FloatArray

    @property
    def rss(self) -> float:
        """Residual sum of squares."""
        return float(self.residual @ self.residual)


class Bench(Protocol):
    """A model that a search works on; ``model`` are its equations, or the shell of a closed model."""

    @property
    def model(self) -> EquationModel:
        """The equations, or a shell with the same inputs."""
        ...

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was measured; readings that do not count are no numbers."""
        ...

    @property
    def grows(self) -> float:
        """How many times an error of a start state grows through a window at most; 1 where the plant is stable."""
        ...

    @property
    def is_closed(self) -> bool:
        """Whether only inputs and reading can be reached."""
        ...

    def retuned(self) -> Outcome:
        """Return the model with its own numbers retuned."""
        ...

    def as_it_is(self, retuned: Outcome) -> Outcome:
        """Return the model with its nominal numbers."""
        ...

    def fitted(self, effects: Sequence[Effect], start: Outcome, iterations: int) -> Outcome:
        """Return the model fitted with effects, from where another fit ended."""
        ...

    def shortened(self, outcome: Outcome) -> Outcome | None:
        """Return the same effects on short windows, from the nominal numbers; nothing where there are none."""
        ...

    def lengthened(self, outcome: Outcome) -> Outcome:
        """Return a fit to short windows carried on to long ones."""
        ...

    def part(self, outcome: Outcome, rows: int) -> tuple[Bench, Outcome] | None:
        """Return a bench on the windows that say most, with a fit there; nothing where there are hardly more rows."""
        ...

    def carried(self, outcome: Outcome, iterations: int) -> Outcome:
        """Return a fit to a part of the rows carried on to all of them."""
        ...

    def is_stand_in(self, outcome: Outcome) -> bool:
        """Whether one of the effects is no longer what its name says."""
        ...

    def is_sought_outside(self, effect: Effect) -> bool:
        """Whether a direct search around the fits seeks one of the effect's numbers."""
        ...

    def with_trial(self, outcome: Outcome, effect: Effect) -> FloatArray | None:
        """Return how the readings change at the rows that count with one more effect, None where it runs away."""
        ...

    def each(self, one: Callable[[Trial], FloatArray | None], found: Sequence[Trial]) -> Iterable[FloatArray | None]:
        """Return what a function makes of every trial, several at a time where simulations can run beside another."""
        ...

    def explained(self, outcome: Outcome) -> FloatArray:
        """Return an orthonormal basis of what numbers can explain at the rows that count."""
        ...

    def without_starts(self, outcome: Outcome, d: FloatArray) -> FloatArray:
        """Return a change of the readings without what other start states make of it."""
        ...

    def signals(self, outcome: Outcome) -> Signals:
        """Return what the recordings show under a fit."""
        ...

    def held_out_error(self, outcome: Outcome, refits: bool) -> float:
        """Return the rms error on the last third of every recording, the numbers fitted to the rest."""
        ...

    def left_out_squares(self, outcome: Outcome) -> FloatArray:
        """Return squared errors on stretches, the numbers fitted to the other ones."""
        ...
