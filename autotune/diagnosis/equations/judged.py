"""Hypotheses of equations, judged as those of chains are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np

from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import key_of
from autotune.diagnosis.equations.scores import innovations_variance, is_noise, is_slow, noise_of
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.selection.judged import Judged, total
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of
from autotune.effects.base import PRIOR_ODDS
from autotune.effects.rigs import RigKind
from autotune.models import Effect


@dataclass(frozen=True, kw_only=True, eq=False)
class JudgedEquations(Judged):
    """Equations with effects, judged.

    Attributes
    ----------
    outcome : Outcome
        The fit.
    own : int
        Effects that the model has itself.
    bench : Bench
        What it was fitted on.
    tuned : bool
        Whether its numbers were fitted, or are the nominal ones.
    """

    outcome: Outcome
    own: int
    bench: Bench
    tuned: bool = True

    @property
    def added(self) -> tuple[Effect, ...]:
        """Its effects with their fitted values."""
        return self.outcome.effects[self.own :]

    @property
    def limits(self) -> Thresholds:
        """What decides between two findings."""
        return self.bench.limits

    @cached_property
    def noise(self) -> Noise:
        """The noise that what it leaves shows from row to row."""
        return noise_of(self.bench, self.outcome)

    @cached_property
    def leaves_noise(self) -> bool:
        """Whether what it leaves is noise: no more variance, no slow part, and stretches are foretold about as well."""
        outcome, limits = self.outcome, self.limits
        most = limits.white + math.sqrt(2.0 / outcome.residual.size)
        if not is_noise(self.bench, outcome, most) or is_slow(outcome, self.noise, limits):
            return False
        error = math.sqrt(total(self.long_squares) / outcome.residual.size)
        return error < limits.foretold * self.bench.grows * math.sqrt(outcome.rss / outcome.residual.size)

    @cached_property
    def variance(self) -> float:
        """Variance of the innovations of what it leaves."""
        return innovations_variance(self.outcome, self.noise)

    @property
    def rows(self) -> int:
        """Rows that it was fitted to."""
        return self.outcome.residual.size

    @property
    def numbers(self) -> int:
        """Numbers that were fitted, the model's own ones with them, which all hypotheses have."""
        return self.outcome.count

    @cached_property
    def beside_still(self) -> tuple[float, ...]:
        """Errors on left-out stretches as shares of those with commands that stand still; none if none moves."""
        share = self.bench.error_beside_still(self.outcome)
        return () if share is None else (share,)

    @cached_property
    def error(self) -> float:
        """Error on the last third of every recording, its numbers fitted to the rest, as a share of the spread of y."""
        return self.bench.held_out_error(self.outcome, self.tuned) / self.bench.spread

    def unfelt(self, effects: Sequence[Effect]) -> frozenset[str]:
        """Return the effects that would change what is read by less than one row's noise does."""
        changes = ((e.name, self.bench.with_trial(self.outcome, e)) for e in effects)
        least = self.noise.total_sd**2
        return frozenset(name for name, d in changes if d is not None and float(d @ d) <= least)

    @property
    def identity(self) -> frozenset[object]:
        """What tells hypotheses apart: an effect may act at several places."""
        return frozenset(key_of(e) for e in self.added)


def odds_of(effect: Effect) -> float:
    """Return the prior odds that equations lack an effect: of the rigs that lack it most, usual ones at most.

    Of what kind of rig equations are is not known, so that nothing is expected of them.
    """
    kind = kind_of(effect.name)
    return min(max(kind.prior_odds(rig) for rig in get_args(RigKind)), PRIOR_ODDS["usual"])


def judge(bench: Bench, outcome: Outcome, own: int) -> JudgedEquations | None:
    """Return a fit with its errors on left-out stretches; nothing where an effect is no longer what its name says."""
    if bench.is_stand_in(outcome):
        return None
    squares = bench.left_out_squares(outcome)
    if not np.all(np.isfinite(squares)):
        return None
    added = outcome.effects[own:]
    return JudgedEquations(
        names=tuple(e.name for e in added), long_squares=squares, short_squares=squares,
        log_odds=math.fsum(math.log(odds_of(e)) for e in added), outcome=outcome, own=own, bench=bench,
    )  # fmt: skip
