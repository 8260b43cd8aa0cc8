"""What a search asks of a model: fit it with effects, try one more, and tell what numbers and starts can explain."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.equations.candidates import Signals, Trial
from autotune.diagnosis.equations.first_order import explained
from autotune.diagnosis.thresholds import Thresholds
from autotune.equations.effects import with_values
from autotune.equations.fit_data import Fitted
from autotune.equations.model import EquationModel
from autotune.equations.simulate import Compiled, drive_of
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


class Bench(ABC):
    """A model on its recordings, as a search asks for it: by default one of which inputs and reading alone are reached.

    Such a model starts where it starts: there are no short windows, no parts of the rows, and no other start states.

    Parameters
    ----------
    model : EquationModel
        The equations, or a shell with the same inputs.
    recordings : sequence of Recording
        What was measured.
    good : sequence of (N,) bool array
        Rows whose reading counts.
    own : int
        How many numbers the model has itself; those of effects come after them.
    limits : Thresholds
        What decides between two findings.

    Attributes
    ----------
    recordings : tuple of Recording
        What was measured; readings that do not count are no numbers.
    grows : float
        How many times an error of a start state grows through a window at most; 1 where the plant is stable.
    is_closed : bool
        Whether only inputs and reading can be reached.
    """

    grows = 1.0
    is_closed = True

    def __init__(
        self, model: EquationModel, recordings: Sequence[Recording], good: Sequence[BoolArray], own: int,
        limits: Thresholds,
    ) -> None:  # fmt: skip
        self.model, self._own, self.limits = model, own, limits
        self.recordings = tuple(replace(r, y=np.where(ok, r.y, np.nan)) for r, ok in zip(recordings, good, strict=True))
        self._rows = [np.isfinite(r.y) for r in self.recordings]
        self._drives = [drive_of(model, r) for r in self.recordings]
        self._dt_s = float(np.median(np.concatenate([np.diff(r.t) for r in recordings])))
        self._duration_s = max(float(r.t[-1] - r.t[0]) for r in recordings)

    @property
    def spread(self) -> float:
        """Standard deviation of the readings that count, which errors are shares of."""
        return float(np.nanstd(np.concatenate([r.y for r in self.recordings]))) or 1.0

    @abstractmethod
    def retuned(self) -> Outcome:
        """Return the model with its own numbers retuned."""

    @abstractmethod
    def as_it_is(self, retuned: Outcome) -> Outcome:
        """Return the model with its nominal numbers."""

    @abstractmethod
    def fitted(self, effects: Sequence[Effect], start: Outcome, iterations: int) -> Outcome:
        """Return the model fitted with effects, from where another fit ended."""

    def refitted(self, outcome: Outcome, iterations: int) -> Outcome:
        """Return a fit to other rows fitted to these, from its numbers.

        Parameters
        ----------
        outcome : Outcome
            The fit to other rows.
        iterations : int
            Gauss-Newton steps at most.
        """
        return self.fitted(outcome.effects, outcome, iterations)

    @abstractmethod
    def with_trial(self, outcome: Outcome, effect: Effect) -> FloatArray | None:
        """Return how the readings change at the rows that count with one more effect, None where it runs away."""

    @abstractmethod
    def signals(self, outcome: Outcome) -> Signals:
        """Return what the recordings show under a fit."""

    @abstractmethod
    def held_out_error(self, outcome: Outcome, refits: bool) -> float:
        """Return the rms error on the last third of every recording, the numbers fitted to the rest."""

    @abstractmethod
    def left_out_squares(self, outcome: Outcome) -> FloatArray:
        """Return squared errors on stretches, the numbers fitted to the other ones."""

    @abstractmethod
    def error_beside_still(self, outcome: Outcome) -> float | None:
        """Return the error there as a share of what it is with inputs that stand still; None where none moves."""

    def _start(self, compiled: Compiled, start: Outcome | None) -> FloatArray:
        """Return where a fit begins: the model's own numbers where another fit ended, if any, the others nominal."""
        z = np.zeros(len(compiled.parameters))
        if start is not None:
            z[: self._own] = start.fitted.z[: self._own]
        return z

    def _made(self, effects: Sequence[Effect], fitted: Fitted, count: int) -> Outcome:
        """Return a fit with its effects at their fitted values."""
        named = zip(fitted.compiled.parameters, fitted.parameters, fitted.sd, strict=True)
        values = {p.name: (float(v), float(s)) for p, v, s in named}
        residual = np.concatenate([r[ok] for r, ok in zip(fitted.residuals, self._rows, strict=True)])
        return Outcome(effects=with_values(effects, values), fitted=fitted, count=count, residual=residual)

    def shortened(self, outcome: Outcome) -> Outcome | None:
        """Return the same effects on short windows, from the nominal numbers; nothing where there are none."""
        return None

    def lengthened(self, outcome: Outcome) -> Outcome:
        """Return a fit to short windows carried on to long ones."""
        return outcome

    def part(self, outcome: Outcome, rows: int) -> tuple[Bench, Outcome] | None:
        """Return a bench on the windows that say most, with a fit there; nothing where there are hardly more rows."""
        return None

    def carried(self, outcome: Outcome, iterations: int) -> Outcome:
        """Return a fit to a part of the rows carried on to all of them."""
        return outcome

    def is_stand_in(self, outcome: Outcome) -> bool:
        """Whether one of the effects is no longer what its name says."""
        return False

    def is_sought_outside(self, effect: Effect) -> bool:
        """Whether a direct search around the fits seeks one of the effect's numbers."""
        return False

    def each(self, one: Callable[[Trial], FloatArray | None], found: Sequence[Trial]) -> Iterable[FloatArray | None]:
        """Return what a function makes of every trial, several at a time where simulations can run beside another."""
        return map(one, found)

    def explained(self, outcome: Outcome) -> FloatArray:
        """Return an orthonormal basis of what the numbers of a fit can explain at the rows that count."""
        return explained(outcome.fitted)

    def without_starts(self, outcome: Outcome, d: FloatArray) -> FloatArray:
        """Return a change of the readings without what other start states make of it, to first order."""
        return d
