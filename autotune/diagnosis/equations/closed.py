"""A closed model (an FMU, a step function) on recordings, as a search asks for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray, deviations_beside_prior
from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import Signals
from autotune.diagnosis.equations.held_out import HELD_OUT
from autotune.diagnosis.equations.sought import jumping, scale_parameter
from autotune.diagnosis.evidence.stretches import cuttings_in
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.effects.in_equations import Scales
from autotune.equations.black_box import BlackBox, driven, read_out
from autotune.equations.effects import apply, at_reading, compile_with, with_values
from autotune.equations.fit_data import Fitted
from autotune.equations.parameter_scales import slopes_of, values_of
from autotune.equations.simulate import Compiled, Drive, drive_of
from autotune.errors import InputError
from autotune.models import Effect
from autotune.recording import Recording

#: Relative step of the finite differences in units of belief: a closed model's own solver makes noise.
_STEP = 1e-2


class ClosedBench(Bench):
    """A closed model on recordings; each recording is one run from the model's own start.

    Parameters
    ----------
    box : BlackBox
        The model.
    recordings : sequence of Recording
        What was measured.
    good : sequence of (N,) bool array
        Rows whose reading counts.
    limits : Thresholds
        What decides between two findings.
    """

    def __init__(
        self, box: BlackBox, recordings: Sequence[Recording], good: Sequence[BoolArray], limits: Thresholds = IN_USE
    ) -> None:
        super().__init__(box.shell(), recordings, good, len(box.parameters), limits)
        self._box = box

    def _compiled(self, effects: Sequence[Effect]) -> Compiled:
        """Return the shell with the model's parameters and those of effects, dead times among them."""
        compiled = compile_with(self.model, effects)
        u = np.concatenate([d.inputs[:, 0] for d in self._drives])
        y = np.concatenate([r.y for r in self.recordings])
        size = float(np.std(u))
        scales = Scales(u=size, y=float(np.nanstd(y)), duration_s=self._duration_s, size=size, span=0.0, column=0.0)
        # a step of the finite differences is wide enough for what moves by jumps
        inside = tuple(p if p in jumping(compiled, effects) else scale_parameter(p, effects, lambda effect: scales)
                       for p in compiled.parameters)  # fmt: skip
        return replace(compiled, parameters=(*self._box.parameters, *inside))

    def _simulated(
        self, compiled: Compiled, effects: Sequence[Effect], z: FloatArray, drives: Sequence[Drive] | None = None
    ) -> list[FloatArray]:
        """Return y at every row of every recording, of other drives if given."""
        p = values_of(compiled, z)
        values = {q.name: (float(v), 0.0) for q, v in zip(compiled.parameters, p, strict=True)}
        now = with_values(effects, values)
        applied = apply(self.model, now)
        at_input = [e for e in applied.extensions if e.output is None]
        own = {q.name: values[q.name][0] for q in self._box.parameters}
        found = []
        for drive in drives or self._drives:
            arriving = driven(self._box, at_input, applied.delays, applied.before(drive))
            y = self._box.simulation(own, arriving)
            found.append(applied.after(read_out(y, drive, at_reading(self.model, now))))
        return found

    def _fit(
        self, effects: Sequence[Effect], start: Outcome | None, iterations: int, rows: Sequence[BoolArray] | None = None
    ) -> Outcome:
        """Return a Gauss-Newton fit with Levenberg's damping, beliefs counted; without iterations nothing is free."""
        compiled, counted = self._compiled(effects), self._rows if rows is None else rows
        z = self._start(compiled, start)
        which = np.flatnonzero([iterations > 0 and q.spread > 0.0 for q in compiled.parameters])
        y = np.concatenate([r.y[ok] for r, ok in zip(self.recordings, counted, strict=True)])

        def left(at: FloatArray) -> FloatArray:
            runs = self._simulated(compiled, effects, at)
            return np.asarray(y - np.concatenate([run[ok] for run, ok in zip(runs, counted, strict=True)]))

        e, damping, J = left(z), 1e-3, np.zeros((y.size, which.size))
        if not np.all(np.isfinite(e)):
            raise InputError("the simulation runs away", where=self._box.name, remedy="check its parameters and inputs")
        for _ in range(iterations if which.size else 0):
            sd = float(np.sqrt(np.mean(e**2))) + 1e-300
            J = self._jacobian(left, z, e, which)
            H, g = J.T @ J / sd**2 + np.eye(which.size), J.T @ e / sd**2 - z[which]
            moved, gained = False, 0.0
            for _ in range(8):
                new = z.copy()
                new[which] += np.clip(np.linalg.solve(H + damping * np.diag(np.diag(H)), g), -2.0, 2.0)
                try:
                    after = left(new)
                except InputError:
                    after = np.full_like(e, np.inf)
                cost = float(e @ e / sd**2 + z[which] @ z[which])
                then = float(after @ after / sd**2 + new[which] @ new[which]) if np.all(np.isfinite(after)) else np.inf
                if then < cost:
                    z, e, moved, gained = new, after, True, (cost - then) / cost
                    damping = max(0.2 * damping, 1e-9)
                    break
                damping *= 10.0
            if not moved or gained < 1e-4:
                break
        return self._outcome(tuple(effects), compiled, z, e, J, which)

    @staticmethod
    def _jacobian(
        left: Callable[[FloatArray], FloatArray], z: FloatArray, e: FloatArray, which: IntArray
    ) -> FloatArray:
        J = np.zeros((e.size, which.size))
        for column, i in enumerate(which):
            step = z.copy()
            step[i] += _STEP
            J[:, column] = (e - left(step)) / _STEP
        return J

    def _outcome(
        self, effects: tuple[Effect, ...], compiled: Compiled, z: FloatArray, e: FloatArray, J: FloatArray,
        which: IntArray,
    ) -> Outcome:  # fmt: skip
        sd = float(np.sqrt(np.mean(e**2))) + 1e-300
        p = values_of(compiled, z)
        deviation = np.zeros(p.size)
        if which.size:
            deviation[which] = deviations_beside_prior(J / sd) * np.abs(slopes_of(compiled, z))[which]
        whole = np.zeros((e.size, p.size))
        whole[:, which] = J / sd
        runs = self._simulated(compiled, effects, z)
        residuals = tuple(r.y - y for r, y in zip(self.recordings, runs, strict=True))
        fitted = Fitted(
            compiled=compiled, parameters=p, sd=deviation, z=z, windows=(), simulated=tuple(runs), residuals=residuals,
            noise_sd=sd, jacobian=whole,
        )  # fmt: skip
        return self._made(effects, fitted, int(which.size))

    def retuned(self) -> Outcome:
        """Return the model with its own numbers retuned."""
        return self._fit(self._box.effects, None, 20)

    def as_it_is(self, retuned: Outcome) -> Outcome:
        """Return the model with its nominal numbers."""
        return self._fit(self._box.effects, None, 0)

    def fitted(self, effects: Sequence[Effect], start: Outcome, iterations: int = 15) -> Outcome:
        """Return the model fitted with effects, from where another fit ended."""
        return self._fit(effects, start, iterations)

    def with_trial(self, outcome: Outcome, effect: Effect) -> FloatArray | None:
        """Return how the readings change at the rows that count with one more effect."""
        effects = (*outcome.effects, effect)
        compiled = self._compiled(effects)
        runs = self._simulated(compiled, effects, self._start(compiled, outcome))
        d = np.concatenate([
            (new - old)[ok] for new, old, ok in zip(runs, outcome.fitted.simulated, self._rows, strict=True)
        ])  # fmt: skip
        return d if np.all(np.isfinite(d)) else None

    def signals(self, outcome: Outcome) -> Signals:
        """Return command, reading and sizes of inputs that take forces."""
        u = np.concatenate([d.inputs[:, 0] for d in self._drives])
        sizes = {one.column: float(np.std(u)) for one in self._box.inputs if one.kind}
        return Signals(u=u, y=np.concatenate(outcome.fitted.simulated), values={}, sizes=sizes, columns={}, lines=(),
                       dt_s=self._dt_s, duration_s=self._duration_s, slow_s=0.05 * self._duration_s)  # fmt: skip

    def left_out_squares(self, outcome: Outcome) -> FloatArray:
        """Return squared errors on stretches, the numbers fitted to the other ones."""
        squares = []
        for out, there in self._left_out(outcome):
            squares.append(_squares(there.fitted.residuals, out))
        return np.array(squares)

    def error_beside_still(self, outcome: Outcome) -> float | None:
        """Return the error there as a share of what it is with inputs that stand still; None where none moves."""
        own = still = 0.0
        for out, there in self._left_out(outcome):
            pairs = zip(self.recordings, out, strict=True)
            driving = [r.standing_still(rows, self.model.columns) for r, rows in pairs]
            if any(one is not r for one, r in zip(driving, self.recordings, strict=True)):
                drives = [drive_of(self.model, r) for r in driving]
                runs = self._simulated(there.fitted.compiled, outcome.effects, there.fitted.z, drives)
                own += _squares(there.fitted.residuals, out)
                still += _squares([r.y - y for r, y in zip(self.recordings, runs, strict=True)], out)
        return math.sqrt(own / still) if still > 0.0 else None

    def _left_out(self, outcome: Outcome) -> Iterator[tuple[list[BoolArray], Outcome]]:
        """Yield the rows of each stretch, a mask per recording, and a fit moved to what the other rows say."""
        y = [r.y for r in self.recordings]
        labels, *_ = cuttings_in(y, [np.zeros(1, np.int64) for _ in y], [np.array([one.size]) for one in y])
        for k in range(1 + max(int(label.max(initial=-1)) for label in labels)):
            kept = [ok & (label != k) for ok, label in zip(self._rows, labels, strict=True)]
            yield [label == k for label in labels], self._fit(outcome.effects, outcome, 1, kept)

    def held_out_error(self, outcome: Outcome, refits: bool) -> float:
        """Return the rms error on the last third of every recording, the numbers fitted to the rest."""
        cut = [int((1.0 - HELD_OUT) * len(r)) for r in self.recordings]
        first = [ok & (np.arange(ok.size) < k) for ok, k in zip(self._rows, cut, strict=True)]
        if refits:
            outcome = self._fit(outcome.effects, outcome, 6, first)
        e = np.concatenate([r[k:] for r, k in zip(outcome.fitted.residuals, cut, strict=True)])
        return float(np.sqrt(np.nanmean(e**2)))


def _squares(residuals: Sequence[FloatArray], out: Sequence[BoolArray]) -> float:
    """Return the sum of squared residuals in some rows, those that are no numbers not counting."""
    return float(sum(np.nansum(e[rows] ** 2) for e, rows in zip(residuals, out, strict=True)))
