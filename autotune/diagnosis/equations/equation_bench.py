"""Equations on recordings: they answer all that a search asks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import Signals, Trial, form_of
from autotune.diagnosis.equations.first_order import explained, start_bases, without_starts
from autotune.diagnosis.equations.followed import followed, positions_of, sizes_of
from autotune.diagnosis.equations.further import further_columns
from autotune.diagnosis.equations.held_out import HELD_OUT, bounded_errors, forecasts, free_run, until
from autotune.diagnosis.equations.parts import standing_out, telling_windows
from autotune.diagnosis.equations.sought import change_number, outer, scale_parameter
from autotune.diagnosis.evidence.stretches import STRETCHES, cuttings_in
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.effects import KINDS
from autotune.effects.in_equations import Scales
from autotune.equations.effects import compile_with, where_of
from autotune.equations.fit import LEAST_ROWS, fit, retune
from autotune.equations.fit_data import Fitted
from autotune.equations.left_out import error_beside_still, left_out_squares
from autotune.equations.linearise import growth_rate
from autotune.equations.model import EquationModel, InputColumn
from autotune.equations.parameter_scales import values_of
from autotune.equations.sensitivity import Windows, run_windows, side_by_side
from autotune.equations.simulate import Compiled
from autotune.errors import InputError
from autotune.models import Effect
from autotune.recording import Recording

#: Steps between two rows, on average, that a simulation with effects may take, and times those of the model without.
STEPS, TIMES_STEPS = 20.0, 5.0
#: For so many rows of a window steps may be taken ahead: numbers that make a plant stiff are no way to explain it.
SPARE_ROWS = 200
#: Iterations of a fit from which on a number that moves by jumps is sought: fewer show whether more are worth it.
LEAST_SOUGHT = 3
#: By what such a number is multiplied and divided first, and where an earlier fit has sought it already.
FAR, NEAR = 2.0, 1.2
#: Windows per recording that a search works on: long enough to tell, short enough to converge.
WINDOWS = 3
#: Rows of such a window at most: in longer ones fits take more steps, and say no more.
MOST_ROWS = 500
#: Logarithm of how far a deviation may grow through a window of a plant that is not stable: no free run is told beyond.
GROWTH = 3.0
#: A search works on a part of the rows where there are this many times as many.
PARTED = 1.5
#: Shares of the search's length, where a fit to short windows is carried on to long ones, and iterations on each.
LONGER_AND_LONGER, LENGTHENED = (0.25, 1.0), 12
#: How many times as long as short windows long ones are.
SHORTER = 8


class EquationBench(Bench):
    """Equations on recordings: every state can be reached.

    Parameters
    ----------
    model : EquationModel
        The nominal model.
    recordings : sequence of Recording
        What was measured.
    good : sequence of (N,) bool array
        Rows whose reading counts.
    limits : Thresholds
        What decides between two findings.
    """

    is_closed = False

    def __init__(
        self, model: EquationModel, recordings: Sequence[Recording], good: Sequence[BoolArray],
        limits: Thresholds = IN_USE,
    ) -> None:  # fmt: skip
        self._nominal, self._further = model, further_columns(model, recordings)
        # further columns drive nothing until an effect takes them; what is measured runs on between rows
        measured = (InputColumn(column=name, hold="linear") for name in self._further)
        whole = replace(model, inputs=(*model.inputs, *measured))
        told = [ok & _is_told(model, r) for ok, r in zip(good, recordings, strict=True)]
        super().__init__(whole, recordings, told, len(model.parameters), limits)
        dt = max(float(np.median(np.diff(r.t))) for r in recordings)
        longest = min(self._duration_s / WINDOWS, MOST_ROWS * dt)
        rate = growth_rate(model, recordings) if model.horizon_s is None else 0.0
        unstable = GROWTH / rate if rate * longest > GROWTH else None
        self._horizon_s = model.horizon_s or unstable
        self.grows = math.exp(GROWTH) if unstable else 1.0
        self.length_s = self._horizon_s or longest

    def retuned(self) -> Outcome:
        """Return the model with its own numbers retuned, on windows of the search's length."""
        compiled = self._compiled(self.model.effects)
        found = retune(compiled, self.recordings, longest_s=self.length_s)
        self._most_steps = max(STEPS, TIMES_STEPS * self._steps(found))
        return self._outcome(tuple(self.model.effects), found)

    def _steps(self, found: Fitted) -> float:
        """Return how many steps the simulation of a fit takes between two rows."""
        each = zip(self._drives, found.windows, strict=True)
        runs = [run_windows(found.compiled, found.parameters, d, w) for d, w in each]
        return float(sum(run.steps.sum() for run in runs)) / sum(len(r) for r in self.recordings)

    def as_it_is(self, retuned: Outcome) -> Outcome:
        """Return the model with its nominal numbers, only start states fitted."""
        compiled = self._compiled(self.model.effects)
        none = np.zeros(len(compiled.parameters), dtype=bool)
        try:
            found = fit(compiled, self.recordings, free=none, windows=retuned.fitted.windows, iterations=4)
        except InputError:
            return retuned
        return self._outcome(tuple(self.model.effects), found)

    def held_out_error(self, outcome: Outcome, refits: bool) -> float:
        """Return the rms error on the last third of every recording, the numbers fitted to the rest."""
        runs = self.held_out_runs(outcome, refits)
        each = zip(self.recordings, runs, strict=False)
        e = np.concatenate([np.zeros(0), *(bounded_errors(r.y, run, first) for r, (run, first) in each)])
        return float(np.sqrt(np.nanmean(e**2))) if e.size else float("inf")

    def held_out_runs(self, outcome: Outcome, refits: bool) -> list[tuple[FloatArray, int]]:
        """Return readings of the last third of every recording, (N,), NaN before, and the row that judging begins at.

        The numbers are fitted to the rest; nothing is returned where that runs away.
        """
        compiled = self._compiled(outcome.effects)
        cuts = [int((1.0 - HELD_OUT) * len(r)) for r in self.recordings]
        z = self._start(compiled, outcome)
        each, runs = list(zip(self.recordings, cuts, outcome.fitted.windows, strict=True)), []
        try:
            windows = [until(w, k) for _, k, w in each]
            if refits:
                first = [replace(r, y=np.where(np.arange(len(r)) < k, r.y, np.nan)) for r, k, _ in each]
                found = fit(compiled, first, z=z, windows=windows, iterations=8)
                z, windows = found.z, list(found.windows)
            p = values_of(compiled, z)
            for (r, k, _), drive, w in zip(each, self._drives, windows, strict=True):
                if self._horizon_s is not None:
                    runs.append(forecasts(compiled, p, drive, r.y, w, k, self._horizon_s))
                else:
                    runs.append(free_run(compiled, p, drive, r.y, w, k))
        except InputError:
            return []
        return runs

    def left_out_squares(self, outcome: Outcome) -> FloatArray:
        """Return squared errors on stretches, the numbers fitted to the other ones."""
        cuttings = self._cuttings(outcome)
        return np.array([left_out_squares(outcome.fitted, self.recordings, one, STRETCHES) for one in cuttings])

    def error_beside_still(self, outcome: Outcome) -> float | None:
        """Return the error there as a share of what it is with inputs that stand still; None where none moves."""
        return error_beside_still(outcome.fitted, self.recordings, self._cuttings(outcome)[0])

    def _cuttings(self, outcome: Outcome) -> list[list[IntArray]]:
        windows = outcome.fitted.windows
        return cuttings_in([r.y for r in self.recordings], [w.starts for w in windows], [w.stops for w in windows])

    def _compiled(self, effects: Sequence[Effect]) -> Compiled:
        compiled, own = compile_with(self.model, effects), self._own
        scaled_for_search = tuple(scale_parameter(p, effects, self._scales) for p in compiled.parameters[own:])
        parameters = (*compiled.parameters[:own], *scaled_for_search)
        most, spare = min(self._most_steps, compiled.most_steps), SPARE_ROWS * self._most_steps
        return replace(compiled, parameters=parameters, most_steps=most, spare_steps=min(spare, compiled.spare_steps))

    @cached_property
    def _columns(self) -> dict[str, FloatArray]:
        names = ("y", self.model.columns[0], *self._further)
        return {name: np.concatenate([r[name] for r in self.recordings]) for name in names}

    def _scales(self, effect: Effect) -> Scales:
        """Return what the numbers of an effect are measured by."""
        place, column = where_of(effect), self._columns.get(effect.column, np.zeros(1))
        return Scales(
            u=float(np.std(self._columns[self.model.columns[0]])), y=float(np.nanstd(self._columns["y"])),
            duration_s=self._duration_s, size=self._sizes.get(place, 0.0),
            span=self._spans.get(place, 0.0), column=float(np.sqrt(np.mean(column**2))),
        )  # fmt: skip

    def fitted(self, effects: Sequence[Effect], start: Outcome, iterations: int = 15) -> Outcome:
        """Return the model fitted with effects; what moves by jumps is sought by a direct search around."""
        jumps = outer(effects)
        if not jumps or iterations < LEAST_SOUGHT:
            return self._inner(effects, start, iterations)
        i, key = jumps[-1]
        best, tried = None, float(effects[i].parameters[key].value)
        factor = NEAR if i < len(start.effects) and start.effects[i].name == effects[i].name else FAR
        while factor > 1.03:
            values = self._promising(best, i, key, tried, factor) if best else (tried / factor, tried, tried * factor)
            for value in values:
                try:
                    new = self._inner(change_number(effects, i, key, value), best or start, 4)
                except InputError:
                    continue
                if best is None or new.rss < best.rss:
                    best = new
            if best is None:
                break
            moved = float(best.effects[i].parameters[key].value)
            factor = factor if moved != tried and factor < 2.5 else np.sqrt(factor)
            tried = moved
        return best or self._inner(effects, start, iterations)

    def _promising(self, best: Outcome, i: int, key: str, tried: float, factor: float) -> list[float]:
        """Return the value, of one below and one above, that to first order in all others leaves less than a fit."""
        basis = explained(best.fitted)
        readings = np.concatenate([r.y[ok] for r, ok in zip(self.recordings, self._rows, strict=True)])
        left: list[tuple[float, float]] = []
        for value in (tried / factor, tried, tried * factor):
            y = self._simulated(self._compiled(change_number(best.effects, i, key, value)), best)
            if y is not None:
                e = self.without_starts(best, readings - y)
                e = e - basis @ (basis.T @ e)
                left.append((float(e @ e), value))
        return [value for _, value in sorted(left)[:1] if value != tried]

    def _inner(self, effects: Sequence[Effect], start: Outcome, iterations: int) -> Outcome:
        compiled = self._compiled(effects)
        windows = [replace(w, states=self._states(compiled, start, w, k)) for k, w in enumerate(start.fitted.windows)]
        z = self._start(compiled, start)
        found = fit(compiled, self.recordings, z=z, windows=windows, iterations=iterations)
        return self._outcome(tuple(effects), found)

    def shortened(self, outcome: Outcome) -> Outcome | None:
        """Return the same effects on short windows, from the nominal numbers; nothing where there are none."""
        compiled = self._compiled(outcome.effects)
        length = self.length_s / SHORTER
        dt = max(float(np.median(np.diff(r.t))) for r in self.recordings)
        if length / dt < LEAST_ROWS:
            return None
        try:
            return self._outcome(outcome.effects, retune(compiled, self.recordings, longest_s=length))
        except InputError:
            return None

    def lengthened(self, outcome: Outcome) -> Outcome:
        """Return a fit to short windows carried on to long ones."""
        outcome = self._inner(outcome.effects, outcome, LENGTHENED)
        for share in LONGER_AND_LONGER:
            outcome = self._on(outcome, share * self.length_s, LENGTHENED, outcome.fitted.windows)
        return outcome

    def part(self, outcome: Outcome, rows: int) -> tuple[Bench, Outcome] | None:
        """Return a bench on the windows that say most, with a fit there; nothing where there are hardly more rows."""
        if sum(int(ok.sum()) for ok in self._rows) < PARTED * rows:
            return None
        kept = telling_windows(outcome.fitted, rows)
        good, windows = [], []
        for ok, w, keep in zip(self._rows, outcome.fitted.windows, kept, strict=True):
            mask = np.zeros(ok.size, dtype=bool)
            for a, b in zip(w.starts[keep], w.stops[keep], strict=True):
                mask[a:b] = True
            good.append(ok & mask)
            windows.append(Windows(starts=w.starts[keep], stops=w.stops[keep], states=w.states[keep]))
        small = EquationBench(self._nominal, self.recordings, good, self.limits)
        self.signals(outcome)  # sizes and spans, for fits on all rows too
        small.length_s, small._most_steps = self.length_s, self._most_steps
        there = replace(outcome, fitted=replace(outcome.fitted, windows=tuple(windows)))
        return small, small._inner(outcome.effects, there, LEAST_SOUGHT)

    def carried(self, outcome: Outcome, iterations: int) -> Outcome:
        """Return a fit to a part of the rows carried on to all of them."""
        return self._on(outcome, self.length_s, iterations, outcome.fitted.windows)

    def _on(
        self, outcome: Outcome, length_s: float, iterations: int, known: Sequence[Windows] | None = None
    ) -> Outcome:
        """Return the same effects fitted on windows of a length, from a fit's numbers and states that are known."""
        compiled = self._compiled(outcome.effects)
        found = fit(compiled, self.recordings, z=self._start(compiled, outcome), known=known, horizon_s=length_s,
                    iterations=iterations)  # fmt: skip
        return self._outcome(outcome.effects, found)

    def refitted(self, outcome: Outcome, iterations: int) -> Outcome:
        """Return a fit to other rows fitted to these, from its numbers: start states are those of these rows.

        Parameters
        ----------
        outcome, iterations
            As of :meth:`Bench.refitted`.
        """
        return self.fitted(outcome.effects, self._on(outcome, self.length_s, LEAST_SOUGHT), iterations)

    def is_sought_outside(self, effect: Effect) -> bool:
        """Whether a direct search around the fits seeks one of the effect's numbers."""
        return bool(outer([effect]))

    def _states(self, compiled: Compiled, start: Outcome, w: Windows, number: int) -> FloatArray:
        """Return start states by name, those of new effects at what they would hold at rest."""
        known = dict(zip(start.fitted.compiled.states, w.states.T, strict=True))
        u = self._drives[number].inputs[np.maximum(w.starts - 1, 0), 0] - self.model.inputs[0].offset
        y = np.nan_to_num(start.fitted.simulated[number][w.starts])
        fresh = {one.name: np.zeros(w.starts.size) for e in compiled.extensions for one in e.states}
        for extension in compiled.extensions:
            form = KINDS[extension.name].in_equations
            if form is not None and form.follows:
                fresh[extension.states[0].name] = u if form.acts == "input" else y
        columns = [known[name] if name in known else fresh[name] for name in compiled.states]
        return np.column_stack(columns)

    def _outcome(self, effects: tuple[Effect, ...], found: Fitted) -> Outcome:
        count = sum(p.spread > 0.0 for p in found.compiled.parameters) + len(outer(effects))
        return self._made(effects, found, count)

    def _simulated(self, compiled: Compiled, outcome: Outcome) -> FloatArray | None:
        """Return readings at the rows that count, the outcome's numbers and start states given."""
        p = compiled.parameter_vector
        p[: self._own] = outcome.fitted.parameters[: self._own]
        parts = []
        for k, (drive, w) in enumerate(zip(self._drives, outcome.fitted.windows, strict=True)):
            run = run_windows(compiled, p, drive, replace(w, states=self._states(compiled, outcome, w, k)))
            parts.append(run.y[self._rows[k]])
        y = np.concatenate(parts)
        return y if np.all(np.isfinite(y)) else None

    def with_trial(self, outcome: Outcome, effect: Effect) -> FloatArray | None:
        """Return how the readings change with one more effect, everything else as it is."""
        if self._base_of is not outcome:
            self._base_of, self._base = outcome, self._simulated(self._compiled(outcome.effects), outcome)
        base = self._base
        new = self._simulated(self._compiled((*outcome.effects, effect)), outcome)
        return None if base is None or new is None else new - base

    def each(self, one: Callable[[Trial], FloatArray | None], found: Sequence[Trial]) -> Iterable[FloatArray | None]:
        """Return what a function makes of every trial, several at a time."""
        return side_by_side(one, found)

    def without_starts(self, outcome: Outcome, d: FloatArray) -> FloatArray:
        """Return a change of the readings without what other start states make of it, to first order."""
        if self._bases_of is not outcome:
            each = enumerate(zip(self._drives, self._rows, strict=True))
            self._bases = [start_bases(outcome.fitted, drive, rows, k) for k, (drive, rows) in each]
            self._bases_of = outcome
        return without_starts(d, outcome.fitted, self._rows, self._bases)

    _base_of: Outcome | None = None
    _bases_of: Outcome | None = None
    _base: FloatArray | None = None
    _sizes: Mapping[str, float] = MappingProxyType({})
    _spans: Mapping[str, float] = MappingProxyType({})
    _most_steps = np.inf

    def _followed(self, outcome: Outcome) -> tuple[FloatArray, dict[str, FloatArray]]:
        def states(compiled: Compiled, w: Windows, number: int) -> FloatArray:
            return self._states(compiled, outcome, w, number)

        return followed(self.model, outcome.effects, outcome.fitted, self._drives, states)

    def is_stand_in(self, outcome: Outcome) -> bool:
        """Whether one of the effects is no longer what its name says: a stop that the position goes far beyond."""
        added = outcome.effects[len(self.model.effects) :]
        seen = [(e, judge) for e in added if (judge := form_of(e).stand_in) is not None]
        if not seen:
            return False
        values, at = self._followed(outcome)[1], positions_of(self.model)
        return any(judge(e.values, values[at[where_of(e)]]) for e, judge in seen if at[where_of(e)] in values)

    def signals(self, outcome: Outcome) -> Signals:
        """Return states, differences across ports, and sizes of derivatives under a fit."""
        y, values = self._followed(outcome)
        self._sizes = sizes_of(self.model, outcome.fitted.parameters, values, self._drives[0].inputs[:1], self._dt_s)
        self._spans = {
            place: float(np.ptp(values[name])) for place, name in positions_of(self.model).items() if name in values
        }  # fmt: skip
        u = np.concatenate([d.inputs[:, 0] for d in self._drives])
        columns = {name: self._columns[name] for name in self._further}
        lines = standing_out(max(outcome.fitted.residuals, key=len), self._dt_s)
        return Signals(u=u, y=y, values=values, sizes=self._sizes, columns=columns, lines=lines, dt_s=self._dt_s,
                       duration_s=self._duration_s, slow_s=0.05 * self._duration_s)  # fmt: skip


def _is_told(model: EquationModel, recording: Recording) -> BoolArray:
    """Return at which rows commands of the recording act: those before are on their way through a dead time.

    A start state stands for what was commanded before it, but not for what is still to come. A start that is given
    is that of the first row.
    """
    late_s = max((one.delay_s for one in model.inputs if np.ptp(recording[one.column]) > 0.0), default=0.0)
    if model.has_given_start:
        late_s = 0.0
    told: BoolArray = recording.t >= recording.told_from_s(late_s) - 1e-6 * recording.sample_time_s
    return told
