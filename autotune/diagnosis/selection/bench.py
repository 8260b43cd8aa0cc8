"""What a search works with: data at both scales, fits that go from short windows to long, judgement."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Self, TypeVar

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.stretches import correlation_rows, held_out_squares, rms
from autotune.diagnosis.fitting.data import Data, as_white
from autotune.diagnosis.fitting.fit import LAST_STEPS, RUNAWAY, STEPS, Fit, fit, fit_from, residual_at, states_in
from autotune.diagnosis.fitting.long_windows import spread_of
from autotune.diagnosis.fitting.parameters import Parametrisation
from autotune.diagnosis.fitting.restarts import realign_effects
from autotune.diagnosis.fitting.retuning import is_unfelt
from autotune.diagnosis.selection.hypothesis import hypothesis, is_stand_in
from autotune.diagnosis.selection.judged_chain import JudgedChain
from autotune.diagnosis.simulation.assembly import states_that_stay
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects.base import EffectKind
from autotune.models import Effect

#: Share of the bench's residual below which a fit is made again at its own.
CLOSER = 0.7
#: Tasks side by side at most.
SIDE_BY_SIDE = 4
_T = TypeVar("_T")
_R = TypeVar("_R")


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """What the search works with.

    Attributes
    ----------
    cuts : tuple of Data
        The recordings in windows from short to long.
    few : Data
        In short windows.
    odds : tuple of (EffectKind, float)
        What may be missing, with its prior odds.
    pool : Executor
        Where simulations run.
    lasting : tuple of Effect
        What long direct searches found beside the retuned model.
    """

    cuts: tuple[Data, ...]
    few: Data
    odds: tuple[tuple[EffectKind, float], ...]
    pool: Executor
    lasting: tuple[Effect, ...] = ()

    @property
    def long(self) -> Data:
        """The recordings in long windows."""
        return self.cuts[-1]

    @property
    def limits(self) -> Thresholds:
        """What decides between two findings."""
        return self.long.thresholds

    @property
    def two_scales(self) -> bool:
        """Whether hypotheses are judged on short windows too: what swings tells of itself on long ones alone."""
        return len(self.cuts) == 1 and self.has_shorter

    @property
    def has_shorter(self) -> bool:
        """Whether short windows are shorter than the long ones."""
        return self.few.starts[0].size > self.long.starts[0].size

    @property
    def near(self) -> Data:
        """What hypotheses are judged on beside long windows: short ones, or the same where one scale is enough."""
        return self.few if self.two_scales else self.long

    def with_sd(self, long: float, short: float) -> Self:
        """Return the bench with other standard deviations of the residual."""
        return replace(self, cuts=tuple(as_white(d, long) for d in self.cuts), few=as_white(self.few, short))

    def settled(self, p: Parametrisation, theta: FloatArray | None) -> Fit:
        """Return a fit to long windows that went there from short ones."""
        result: Fit | None = None
        for data, before in zip(self.cuts, (None, *self.cuts), strict=False):
            x0 = None if result is None or before is None else states_in(result, before, data)
            result = fit(p, data, theta if result is None else result.theta, x0, iterations=STEPS + 3)
        assert result is not None
        return result

    def shortened(self, result: Fit) -> Fit:
        """Return a fit to short windows from one to long windows: start states first, then the numbers as well."""
        return fit_from(result.parametrisation, self.few, result.theta, iterations=STEPS)

    def in_units_of(self, one: JudgedChain) -> Self:
        """Return the bench in the units that a hypothesis was fitted in, for what is fitted on from it."""
        return self if one.data.noise.sd == self.long.noise.sd else self._at(one.data.noise.sd)

    def finished(self, one: JudgedChain) -> JudgedChain | None:
        """Return a hypothesis fitted to the end, at the residual that it leaves; nothing if not better so."""
        bench = self.in_units_of(one)
        try:
            result = fit(one.fit.parametrisation, bench.long, one.fit.theta, one.fit.x0, iterations=LAST_STEPS)
        except RUNAWAY:
            return None
        if rms(result.residuals, self.long.good) >= rms(one.fit.residuals, self.long.good):
            return None
        return bench.judged(result, one.log_odds)

    def _at(self, sd: float) -> Self:
        """Return the bench at another residual of long windows, that of short ones in proportion."""
        return self.with_sd(sd, self.few.noise.sd * sd / self.long.noise.sd)

    def again(self, one: JudgedChain) -> JudgedChain:
        """Return a hypothesis fitted again, to data with another residual."""
        try:
            result = fit(one.fit.parametrisation, self.long, one.fit.theta, one.fit.x0, iterations=STEPS)
            short = self.shortened(result) if self.two_scales else result
        except RUNAWAY:
            return one
        return replace(one, fit=result, short=short, data=self.long, few=self.near)

    def judged(self, result: Fit, log_odds: float) -> JudgedChain | None:
        """Return a fit to long windows, judged; nothing where it runs away, or where an effect stands for another.

        Where it leaves far less than the residual that it was fitted at, it is fitted again first, and again until it
        does not: priors weighed too much, beside rows that tell more than they were taken to.
        """
        if names_more_than_it_is(result, self.long):
            return None
        bench = self
        try:
            while (sd := residual_sd(result, self.long)) < CLOSER * bench.long.noise.sd:
                bench = self._at(sd)
                closer = fit(result.parametrisation, bench.long, result.theta, result.x0, iterations=STEPS)
                result = realign_effects(closer, bench.long)
            return bench._judged(result, log_odds)
        except RUNAWAY:
            return None

    def _judged(self, result: Fit, log_odds: float) -> JudgedChain:
        squares = held_out_squares(result, self.long)
        short = self.shortened(result) if self.two_scales else result
        return JudgedChain(
            names=hypothesis(result).names,
            fit=result,
            short=short,
            data=self.long,
            few=self.near,
            long_squares=squares,
            short_squares=held_out_squares(short, self.few) if self.two_scales else squares,
            log_odds=log_odds,
        )


def _left_out(result: Fit, index: int) -> tuple[Parametrisation, FloatArray, list[FloatArray]]:
    """Return parametrisation, numbers and start states of a fit without one of the effects that it adds."""
    p = result.parametrisation
    index += p.own  # the nominal model's own effects stay
    keep = [i for i, f in enumerate(p.free) if f.kind != "effect" or f.index[0] != index]
    moved = [
        replace(f, index=(f.index[0] - 1, f.index[1])) if f.kind == "effect" and f.index[0] > index else f
        for f in (p.free[i] for i in keep)
    ]
    effects = tuple(e for i, e in enumerate(p.model.effects) if i != index)
    smaller = replace(p, model=replace(p.model, effects=effects), free=tuple(moved), centre=p.centre[keep])
    theta = result.theta[keep]
    stay = states_that_stay(p.model.effects[index].name, result.sim.order, smaller.simulator(theta).order)
    return smaller, theta, [x[:, stay] for x in result.x0]


def fit_without(result: Fit, index: int, data: Data) -> Fit | None:
    """Fit again without one of the effects that a fit adds; nothing where the simulation runs away without it."""
    try:
        p, theta, x0 = _left_out(result, index)
        return fit(p, data, theta, x0, iterations=20, rounds=2)
    except RUNAWAY:
        return None


def names_more_than_it_is(result: Fit, data: Data) -> bool:
    """Whether one of a fit's effects is a simpler one by its numbers, or does nothing.

    What a lag of nanoseconds comes with are numbers that the fit without it has not found: what it gains is theirs.

    Parameters
    ----------
    result, data
        A fit with the effects that it adds, and what it was fitted to.
    """
    p = result.parametrisation

    def is_felt(index: int) -> bool:
        own = [i for i, f in enumerate(p.free) if f.kind == "effect" and f.index[0] == index + p.own]
        # under a constant command all that a lag does is how its start state decays: its number shows there
        if not all(is_unfelt(result, result.jacobian[0][:, i], data) for i in own):
            return True
        with suppress(*RUNAWAY):
            fewer, theta, x0 = _left_out(result, index)
            return not is_unfelt(result, residual_at(fewer, data, theta, tuple(x0)) - result.e, data)
        return True

    return is_stand_in(hypothesis(result), data) or not all(map(is_felt, range(len(p.added))))


def residual_sd(result: Fit, data: Data) -> float:
    """Return a residual's standard deviation as of independent rows, at least a millionth of the readings' spread."""
    return max(rms(result.residuals, data.good) * math.sqrt(correlation_rows(result, data)), 1e-6 * spread_of(data))


def at_once(task: Callable[[_T], _R], over: Sequence[_T]) -> list[_R]:
    """Return a task's results, in order; the tasks go on side by side and leave what takes long to a pool.

    A pool that waits for one task's slowest simulation works on the next task's meanwhile.
    """
    if len(over) < 2:
        return [task(one) for one in over]
    with ThreadPoolExecutor(min(len(over), SIDE_BY_SIDE)) as threads:
        return list(threads.map(task, over))
