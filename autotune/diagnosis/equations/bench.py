"""What a search asks of a model: fit it with effects, try one more, and tell what numbers and starts can explain.

The questions, and equations that answer all of them on their recordings: the file is longer than others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Protocol

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.equations.candidates import Signals, Trial, place_of
from autotune.diagnosis.equations.parts import beyond, telling_windows
from autotune.diagnosis.evidence.stretches import stretches_in
from autotune.equations.effects import compile_with, with_values
from autotune.equations.expressions import Expression, to_text
from autotune.equations.fit import LEAST_ROWS, Fitted, fit, retune, values_of, window_rows
from autotune.equations.left_out import left_out_squares
from autotune.equations.model import EquationModel, ModelParameter
from autotune.equations.sensitivity import Windows, side_by_side
from autotune.equations.simulate import Compiled, Drive, compile_model, drive_of, simulate
from autotune.equations.starts import fitted_starts
from autotune.errors import InputError
from autotune.models import Effect, Parameter
from autotune.recording import Recording

#: Parameters of effects that may have either sign, and those that are not sought.
SIGNED = frozenset({"high", "low", "second_order", "third_order", "offset", "phase", "time", "in_phase", "quadrature",
                    "amplitude", "fold"})  # fmt: skip
SIGNED_RATES = frozenset({"actuator.gain_drift", "sensor.drift", "environment.drifting_load", "plant.leak",
                          "plant.cubic_stiffness"})  # fmt: skip
GIVEN = frozenset({"zero", "end"})
#: Parameters whose change moves nothing or makes a jump: sought from outside, by direct search.
OUTER = frozenset({("actuator.stiction", "band")})
#: Width of a hysteresis, of what the position moves through, below which it is dry friction, which has no width: its
#: springs would swing the faster the narrower it is, and a simulation would follow them.
LEAST_WIDTH = 1.0 / 300.0
#: Steps between two rows, on average, that a simulation with effects may take, and times those of the model without.
STEPS, TIMES_STEPS = 20.0, 5.0
#: How far surroundings may be from the coldest that was met [K].
SURROUNDINGS_SD = 15.0
#: Iterations of a fit from which on such a parameter is sought: fewer only show whether more are worth it.
LEAST_SOUGHT = 3
#: Windows per recording that a search works on: long enough to tell, short enough to converge.
WINDOWS = 3
#: Rows of such a window at most: in longer ones fits take more steps, and say no more.
MOST_ROWS = 500
#: How far a position may go beyond a hard stop, of what it moves through: what gives way by more is no stop.
BEYOND = 0.15
#: A search works on a part of the rows where there are this many times as many.
PARTED = 1.5
#: How many times as long as short windows long ones are.
SHORTER = 8
#: Spreads of y that an error counts at most: a simulation that runs away is that wrong.
FAR_OFF = 10.0
#: Share of the recording that is kept for judging, and of that the share that a start state is found from.
HELD_OUT, SETTLED = 1.0 / 3.0, 0.15


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

    def periodic(self, outcome: Outcome, signals: Signals) -> list[Trial]:
        """Return loads at the frequencies that stand out of a residual."""
        ...

    def held_out_error(self, outcome: Outcome, refits: bool) -> float:
        """Return the rms error on the last third of every recording, the numbers fitted to the rest."""
        ...

    def left_out_squares(self, outcome: Outcome) -> FloatArray:
        """Return squared errors on stretches, the numbers fitted to the other ones."""
        ...


class EquationBench:
    """Equations on recordings.

    Parameters
    ----------
    model : EquationModel
        The nominal model.
    recordings : sequence of Recording
        What was measured.
    good : sequence of (N,) bool array
        Rows whose reading counts.
    """

    def __init__(self, model: EquationModel, recordings: Sequence[Recording], good: Sequence[BoolArray]) -> None:
        self._model = model
        self._recordings = tuple(
            replace(r, y=np.where(ok, r.y, np.nan)) for r, ok in zip(recordings, good, strict=True)
        )
        self._rows = [np.isfinite(r.y) for r in self.recordings]
        self._drives = [drive_of(model, r) for r in self.recordings]
        span = max(float(r.t[-1] - r.t[0]) for r in recordings)
        dt = max(float(np.median(np.diff(r.t))) for r in recordings)
        self.length_s = model.horizon_s or min(span / WINDOWS, MOST_ROWS * dt)

    @property
    def model(self) -> EquationModel:
        """The equations."""
        return self._model

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was measured; readings that do not count are no numbers."""
        return self._recordings

    @property
    def is_closed(self) -> bool:
        """Every state can be reached."""
        return False

    def retuned(self) -> Outcome:
        """Return the model with its own numbers retuned, on windows of the search's length."""
        compiled = self._compiled(self.model.effects, {})
        found = retune(compiled, self.recordings, longest_s=self.length_s)
        self._most_steps = max(STEPS, TIMES_STEPS * self._steps(found))
        return self._outcome(tuple(self.model.effects), found)

    def _steps(self, found: Fitted) -> float:
        """Return how many steps the simulation of a fit takes between two rows."""
        each = zip(self._drives, found.windows, strict=True)
        runs = [simulate(found.compiled, found.parameters, d, w.states, starts=w.starts, stops=w.stops)
                for d, w in each]  # fmt: skip
        return float(sum(run.steps.sum() for run in runs)) / sum(len(r) for r in self.recordings)

    def as_it_is(self, retuned: Outcome) -> Outcome:
        """Return the model with its nominal numbers, only start states fitted."""
        compiled = self._compiled(self.model.effects, {})
        none = np.zeros(len(compiled.parameters), dtype=bool)
        try:
            found = fit(compiled, self.recordings, free=none, windows=retuned.fitted.windows, iterations=4)
        except InputError:
            return retuned
        return self._outcome(tuple(self.model.effects), found)

    def held_out_error(self, outcome: Outcome, refits: bool) -> float:
        """Return the rms error on the last third of every recording, the numbers fitted to the rest."""
        compiled = self._compiled(outcome.effects, self._spreads())
        cuts = [int((1.0 - HELD_OUT) * len(r)) for r in self.recordings]
        z = np.zeros(len(compiled.parameters))
        own = len(self.model.parameters)
        z[:own] = outcome.fitted.z[:own]
        each = list(zip(self.recordings, cuts, outcome.fitted.windows, strict=True))
        errors = []
        try:
            windows = [_until(w, k) for _, k, w in each]
            if refits:
                first = [replace(r, y=np.where(np.arange(len(r)) < k, r.y, np.nan)) for r, k, _ in each]
                found = fit(compiled, first, z=z, windows=windows, iterations=8)
                z, windows = found.z, list(found.windows)
            p = values_of(compiled, z)
            for (r, k, _), drive, w in zip(each, self._drives, windows, strict=True):
                if self.model.horizon_s is not None:
                    errors.append(_forecast_errors(compiled, p, drive, r.y, k, self.model.horizon_s))
                    continue
                at, end = _continued(compiled, p, drive, r.y, w, k), np.array([len(r)])
                y = simulate(compiled, p, drive, at.states, starts=at.starts, stops=end).y
                judged = slice(k + int(SETTLED * (len(r) - k)), None)
                errors.append(_bounded((r.y - y)[judged], r.y[judged], FAR_OFF * float(np.nanstd(r.y))))
        except InputError:
            return float("inf")
        e = np.concatenate(errors)
        return float(np.sqrt(np.nanmean(e**2)))

    def left_out_squares(self, outcome: Outcome) -> FloatArray:
        """Return squared errors on stretches, the numbers fitted to the other ones."""
        windows = outcome.fitted.windows
        rows = [len(r) for r in self.recordings]
        labels = stretches_in(rows, [w.starts for w in windows], [w.stops for w in windows])
        return left_out_squares(outcome.fitted, self.recordings, labels)

    def periodic(self, outcome: Outcome, signals: Signals) -> list[Trial]:
        """Return loads at the frequencies that stand out of a residual."""
        residual = max(outcome.fitted.residuals, key=len)
        e = np.nan_to_num(residual - np.nanmean(residual)) * np.hanning(residual.size)
        power = np.abs(np.fft.rfft(e))
        power[:3] = 0.0
        found = []
        for k in np.argsort(-power)[:3]:
            frequency = float(np.fft.rfftfreq(e.size, signals.dt_s)[k])
            for name, size in signals.sizes.items():
                state = next((s for s in self.model.states if s.name == name), None)
                if (self.model.ports and state) or (state and state.kind not in ("speed", "level", "temperature")):
                    continue
                for key in ("in_phase", "quadrature"):
                    values = {"in_phase": 1e-6 * size, "quadrature": 1e-6 * size, key: 0.05 * size}
                    parameters = {k: Parameter(value=v) for k, v in (values | {"frequency": frequency}).items()}
                    where = {"state" if state else "port": name}
                    effect = Effect(name="environment.periodic_load", parameters=parameters, **where)
                    found.append(Trial(effect=effect, scaled=(key,)))
        return found

    def _compiled(self, effects: Sequence[Effect], spreads: Mapping[str, float]) -> Compiled:
        compiled, own = compile_with(self.model, effects), len(self.model.parameters)
        scaled_for_search = tuple(sought(p, effects, spreads) for p in compiled.parameters[own:])
        parameters = (*compiled.parameters[:own], *scaled_for_search)
        return replace(compiled, parameters=parameters, most_steps=min(self._most_steps, compiled.most_steps))

    def _spreads(self) -> dict[str, float]:
        u = np.concatenate([r[self.model.columns[0]] for r in self.recordings])
        span = max(float(r.t[-1] - r.t[0]) for r in self.recordings)
        y = np.concatenate([r.y for r in self.recordings])
        size = {"high": float(np.std(u)), "low": float(np.std(u)), "time": 0.2 * span, "phase": 1.0,
                "origin of y": float(np.nanstd(y)), "origin of u": float(np.std(u))}  # fmt: skip
        spread = max(float(np.max(s)) for s in self._sizes.values()) if self._sizes else 0.0
        size |= {f"width at {place}": LEAST_WIDTH * span for place, span in self._spans.items()}
        size |= {f"stiffness at {place}": self._sizes.get(place, 0.0) / max(span, 1e-300)
                 for place, span in self._spans.items()}  # fmt: skip
        return size | ({"in_phase": spread, "quadrature": spread} if spread else {})

    def fitted(self, effects: Sequence[Effect], start: Outcome, iterations: int = 15) -> Outcome:
        """Return the model fitted with effects; what moves by jumps is sought by a direct search around."""
        outer = [(i, key) for i, e in enumerate(effects) for key in e.parameters if (e.name, key) in OUTER]
        if not outer or iterations < LEAST_SOUGHT:
            return self._inner(effects, start, iterations)
        i, key = outer[-1]
        best, tried = None, float(effects[i].parameters[key].value)
        factor = 2.0
        while factor > 1.03:
            for value in (tried / factor, tried * factor) if best else (tried / factor, tried, tried * factor):
                try:
                    new = self._inner(_changed(effects, i, key, value), best or start, 4)
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

    def _inner(self, effects: Sequence[Effect], start: Outcome, iterations: int) -> Outcome:
        compiled = self._compiled(effects, self._spreads())
        z = np.zeros(len(compiled.parameters))
        own = len(self.model.parameters)
        z[:own] = start.fitted.z[:own]
        windows = [
            Windows(starts=w.starts, stops=w.stops, states=self._states(compiled, start, w, k))
            for k, w in enumerate(start.fitted.windows)
        ]
        found = fit(compiled, self.recordings, z=z, windows=windows, iterations=iterations)
        return self._outcome(tuple(effects), found)

    def shortened(self, outcome: Outcome) -> Outcome | None:
        """Return the same effects on short windows, from the nominal numbers; nothing where there are none."""
        compiled = self._compiled(outcome.effects, self._spreads())
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
        own = len(self.model.parameters)
        for length in (0.5 * self.length_s, self.length_s):
            compiled = self._compiled(outcome.effects, self._spreads())
            z = np.zeros(len(compiled.parameters))
            z[:own] = outcome.fitted.z[:own]
            found = fit(compiled, self.recordings, z=z, horizon_s=length, iterations=12)
            outcome = self._outcome(outcome.effects, found)
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
        small = EquationBench(self.model, self.recordings, good)
        self.signals(outcome)  # sizes and spans, for fits on all rows too
        small.length_s, small._most_steps = self.length_s, self._most_steps
        there = replace(outcome, fitted=replace(outcome.fitted, windows=tuple(windows)))
        return small, small._inner(outcome.effects, there, LEAST_SOUGHT)

    def carried(self, outcome: Outcome, iterations: int) -> Outcome:
        """Return a fit to a part of the rows carried on to all of them."""
        own = len(self.model.parameters)
        compiled = self._compiled(outcome.effects, self._spreads())
        z = np.zeros(len(compiled.parameters))
        z[:own] = outcome.fitted.z[:own]
        return self._outcome(
            outcome.effects, fit(compiled, self.recordings, z=z, horizon_s=self.length_s, iterations=iterations)
        )

    def is_sought_outside(self, effect: Effect) -> bool:
        """Whether a direct search around the fits seeks one of the effect's numbers."""
        return any((effect.name, key) in OUTER for key in effect.parameters)

    def _states(self, compiled: Compiled, start: Outcome, w: Windows, number: int) -> FloatArray:
        """Return start states by name, those of new effects at what they would hold at rest."""
        known = dict(zip(start.fitted.compiled.states, w.states.T, strict=True))
        u = self._drives[number].inputs[np.maximum(w.starts - 1, 0), 0] - self.model.inputs[0].offset
        y = np.nan_to_num(start.fitted.simulated[number][w.starts])
        columns = []
        for name in compiled.states:
            at_command = name.startswith(("lag_", "asymmetric_lag_", "rate_limit_"))
            at_reading = name.startswith(("slow_mode_", "resonance_")) and name.endswith("memory")
            fresh = u if at_command else y if at_reading else np.zeros(w.starts.size)
            if at_command and any(e.name == "sensor.lag" for e in start.effects):
                fresh = y
            columns.append(known.get(name, fresh))
        return np.column_stack(columns)

    def _outcome(self, effects: tuple[Effect, ...], found: Fitted) -> Outcome:
        values = {
            p.name: (float(v), float(s))
            for p, v, s in zip(found.compiled.parameters, found.parameters, found.sd, strict=True)
        }
        residual = np.concatenate([r[ok] for r, ok in zip(found.residuals, self._rows, strict=True)])
        outer = sum((e.name, key) in OUTER for e in effects for key in e.parameters)
        count = sum(p.spread > 0.0 for p in found.compiled.parameters) + outer
        return Outcome(effects=with_values(effects, values), fitted=found, count=count, residual=residual)

    def _simulated(self, compiled: Compiled, outcome: Outcome) -> FloatArray | None:
        """Return readings at the rows that count, the outcome's numbers and start states given."""
        own = len(self.model.parameters)
        p = compiled.parameter_vector
        p[:own] = outcome.fitted.parameters[:own]
        parts = []
        for k, (drive, w) in enumerate(zip(self._drives, outcome.fitted.windows, strict=True)):
            x = self._states(compiled, outcome, w, k)
            run = simulate(compiled, p, drive, x, starts=w.starts, stops=w.stops)
            parts.append(run.y[self._rows[k]])
        y = np.concatenate(parts)
        return y if np.all(np.isfinite(y)) else None

    def with_trial(self, outcome: Outcome, effect: Effect) -> FloatArray | None:
        """Return how the readings change with one more effect, everything else as it is."""
        if self._base_of is not outcome:
            self._base_of, self._base = outcome, self._simulated(self._compiled(outcome.effects, {}), outcome)
        base = self._base
        new = self._simulated(self._compiled((*outcome.effects, effect), {}), outcome)
        return None if base is None or new is None else new - base

    def each(self, one: Callable[[Trial], FloatArray | None], found: Sequence[Trial]) -> Iterable[FloatArray | None]:
        """Return what a function makes of every trial, several at a time."""
        return side_by_side(one, found)

    def explained(self, outcome: Outcome) -> FloatArray:
        """Return an orthonormal basis of what the numbers of a fit can explain, start states projected out."""
        J = outcome.fitted.jacobian
        U, s, _ = np.linalg.svd(J, full_matrices=False)
        return np.asarray(U[:, s > 1.0])

    def without_starts(self, outcome: Outcome, d: FloatArray) -> FloatArray:
        """Return a change of the readings without what other start states make of it, to first order."""
        parts, at = [], 0
        for k, w in enumerate(outcome.fitted.windows):
            rows = self._rows[k]
            X = self._start_bases(outcome)[k]
            here = d[at : at + int(rows.sum())].copy()
            at += here.size
            index = np.cumsum(rows) - 1
            for (a, b), Q in zip(zip(w.starts, w.stops, strict=True), X, strict=True):
                part = index[a:b][rows[a:b]]
                here[part] -= Q @ (Q.T @ here[part])
            parts.append(here)
        return np.concatenate(parts)

    def _start_bases(self, outcome: Outcome) -> list[list[FloatArray]]:
        if self._bases_of is not outcome:
            self._bases_of, self._bases = outcome, [self._basis(outcome, k) for k in range(len(self.recordings))]
        return self._bases

    def _basis(self, outcome: Outcome, k: int) -> list[FloatArray]:
        from autotune.equations.sensitivity import STEP, sensitivities
        from autotune.equations.starts import state_scales

        f = outcome.fitted
        w = f.windows[k]
        drive = self._drives[k]
        scales = state_scales(f.compiled, f.parameters, drive, w.states[0])
        s = sensitivities(
            f.compiled, f.parameters, drive, w, parameter_steps=np.ones(f.parameters.size), state_steps=STEP * scales,
            which=(),
        )  # fmt: skip
        found = []
        for a, b in zip(w.starts, w.stops, strict=True):
            X = np.nan_to_num(s.to_states[a:b][self._rows[k][a:b]] * scales)
            U, v, _ = np.linalg.svd(X, full_matrices=False)
            found.append(U[:, v > 1e-6 * max(float(v.max(initial=0.0)), 1e-300)])
        return found

    _base_of: Outcome | None = None
    _bases_of: Outcome | None = None
    _base: FloatArray | None = None
    _sizes: Mapping[str, float] = MappingProxyType({})
    _spans: Mapping[str, float] = MappingProxyType({})
    _most_steps = np.inf

    def _signals(self, outcome: Outcome) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Return the simulated reading, and states and differences across ports by name, where a simulation goes on."""
        model = self.model
        positions = {one.name: _position_text(model, one.across) for one in model.ports}
        wanted = {name: name for name in model.state_names}
        wanted |= {one.name: to_text(one.across) for one in model.ports if one.across is not None}
        wanted |= {f"{name}:position": text for name, text in positions.items() if text}
        compiled = compile_with(model, outcome.effects, list(wanted.values()))
        p = outcome.fitted.parameters
        runs: list[FloatArray] = []
        for drive, w in zip(self._drives, outcome.fitted.windows, strict=True):
            states = self._states(compiled, outcome, w, len(runs))
            runs.append(simulate(compiled, p, drive, states, starts=w.starts, stops=w.stops).outputs)
        columns = np.concatenate(runs)
        columns = columns[np.all(np.isfinite(columns), axis=1)]
        return columns[:, 0], {name: columns[:, 1 + i] for i, name in enumerate(wanted)}

    @property
    def _positions(self) -> dict[str, str]:
        """The name of the position that goes with each state and port."""
        return {s.name: s.of or s.name for s in self.model.states} | {
            one.name: f"{one.name}:position" for one in self.model.ports
        }

    def is_stand_in(self, outcome: Outcome) -> bool:
        """Whether one of the effects is no longer what its name says: a stop that the position goes far beyond."""
        stops = [e for e in outcome.effects[len(self.model.effects) :] if e.name == "plant.hard_stop"]
        if not stops:
            return False
        values = self._signals(outcome)[1]
        return any(
            beyond(values[self._positions[place_of(e)]], e) > BEYOND for e in stops
            if self._positions[place_of(e)] in values
        )  # fmt: skip

    def signals(self, outcome: Outcome) -> Signals:
        """Return states, differences across ports, and sizes of derivatives under a fit."""
        model = self.model
        y, values = self._signals(outcome)
        dt = float(np.median(np.concatenate([np.diff(r.t) for r in self.recordings])))
        sizes = {n: float(np.std(np.diff(values[n]) / dt)) + 1e-12 for n in model.state_names}
        for port in model.ports:
            sizes[port.name] = self._force_size(outcome, port.name, sizes)
        self._sizes = sizes
        self._spans = {
            place: float(np.ptp(values[name])) for place, name in self._positions.items()
            if name in values and name != place
        }  # fmt: skip
        duration = max(float(r.t[-1] - r.t[0]) for r in self.recordings)
        u = np.concatenate([d.inputs[:, 0] for d in self._drives])
        return Signals(u=u, y=y, values=values, sizes=sizes, dt_s=dt, duration_s=duration,
                       slow_s=0.05 * duration)  # fmt: skip

    def _force_size(self, outcome: Outcome, port: str, sizes: Mapping[str, float]) -> float:
        """Return the force at a port that would make the largest derivative as large as it is."""
        from autotune.equations.expressions import Number
        from autotune.equations.model import Extension
        from autotune.equations.simulate import derivatives

        x = np.zeros((1, len(self.model.states)))
        u = self._drives[0].inputs[:1]
        p = outcome.fitted.parameters[: len(self.model.parameters)]
        none = derivatives(compile_model(self.model), p, x, u)[0]
        one = Extension(name="unit", port={port: Number(1.0)})
        change = np.abs(derivatives(compile_model(self.model, [one]), p, x, u)[0] - none)[0]
        ratios = [sizes[n] / c for n, c in zip(self.model.state_names, change, strict=True) if c > 0.0]
        return max(ratios, default=1.0)


def jumping(compiled: Compiled, effects: Sequence[Effect]) -> tuple[ModelParameter, ...]:
    """Return the parameters whose change moves nothing or makes a jump."""
    found = (one.parameter for one in compiled.held)
    return tuple(p for p in found if _in_outer(p, effects))


def _in_outer(p: ModelParameter, effects: Sequence[Effect]) -> bool:
    number, key = _number_and_key(p.name, effects)
    return (effects[number].name, key) in OUTER


def _changed(effects: Sequence[Effect], i: int, key: str, value: float) -> tuple[Effect, ...]:
    parameters = dict(effects[i].parameters)
    parameters[key] = replace(parameters[key], value=value)
    return (*effects[:i], replace(effects[i], parameters=parameters), *effects[i + 1 :])


def scaled(trial: Trial, factor: float) -> Effect:
    """Return a trial's effect with its amplitude times a factor; what may not change its sign keeps it."""
    parameters = dict(trial.effect.parameters)
    for key in trial.scaled:
        signed = key in SIGNED or trial.effect.name in SIGNED_RATES
        times = factor if signed else abs(factor)
        parameters[key] = replace(parameters[key], value=parameters[key].value * times)
    return replace(trial.effect, parameters=parameters)


def sought(p: ModelParameter, effects: Sequence[Effect], spreads: Mapping[str, float]) -> ModelParameter:
    """Return an effect's parameter with the scale that it is sought on."""
    number, key = _number_and_key(p.name, effects)
    name = effects[number].name
    if key in GIVEN or p.spread == 0.0 or (name, key) in OUTER:
        return replace(p, spread=0.0)
    if (name, key) == ("plant.sine_torque", "period") and "phase" not in effects[number].parameters:
        return replace(p, spread=0.0)  # gravity on an angle
    if (name, key) == ("plant.hysteresis", "width"):
        return replace(p, least=spreads.get(f"width at {place_of(effects[number])}", 0.0))
    if (name, key) == ("plant.hard_stop", "stiffness"):
        # softer than what it turns round moves by itself it would be no stop, and its damping a loss of free place
        return replace(p, least=spreads.get(f"stiffness at {place_of(effects[number])}", 0.0))
    if key == "surroundings":
        return replace(p, linear=True, spread=SURROUNDINGS_SD)
    if key == "origin":
        size = spreads.get("origin of y" if name.startswith("sensor.") else "origin of u", 0.0)
        return replace(p, linear=True, spread=size)
    if key in SIGNED or (key in ("rate", "coefficient") and name in SIGNED_RATES):
        return replace(p, linear=True, spread=spreads.get(key, 3.0 * abs(p.value) + 1e-300))
    return p


def _number_and_key(name: str, effects: Sequence[Effect]) -> tuple[int, str]:
    for number, effect in enumerate(effects):
        prefix = f"{effect.name.split('.')[1]}_{number}_"
        if name.startswith(prefix):
            return number, name.removeprefix(prefix)
    raise AssertionError(name)


def _position_text(model: EquationModel, across: Expression | None) -> str:
    from autotune.equations.effects import position_under

    tree = None if across is None else position_under(model, across)
    return "" if tree is None else to_text(tree)


def _continued(compiled: Compiled, p: FloatArray, drive: Drive, y: FloatArray, before: Windows, row: int) -> Windows:
    """Return a window from a row to the end: what came before goes on, or rest, whatever the first readings fit better.

    From rest alone dry friction that holds a state would hide from the readings where that state is.
    """
    at, end, good = np.array([row]), np.array([y.size]), np.isfinite(y)
    until = np.array([row + max(int(SETTLED * (y.size - row)), 1)])
    guesses: list[FloatArray | None] = [None]
    if before.starts.size:
        run = simulate(compiled, p, drive, before.states[-1:], starts=before.starts[-1:], stops=at)
        guesses += [run.ends[0]] if np.all(np.isfinite(run.ends)) else []
    best, least = None, np.inf
    for guess in guesses:
        w = fitted_starts(compiled, p, drive, y, good, at, end, guess=guess, share=SETTLED)
        e = (y - simulate(compiled, p, drive, w.states, starts=at, stops=until).y)[at[0] : until[0]]
        left = float(np.nansum(e**2)) if np.all(np.isfinite(e[good[at[0] : until[0]]])) else np.inf
        if best is None or left < least:
            best, least = w, left
    assert best is not None
    return best


def _forecast_errors(
    compiled: Compiled, p: FloatArray, drive: Drive, y: FloatArray, row: int, horizon_s: float
) -> FloatArray:
    """Return the errors from a row on of forecasts, each from a state that the horizon before it tells."""
    edges, _ = window_rows(drive.t, horizon_s)
    edges = np.append(edges, y.size)
    errors, most, guess = [], FAR_OFF * float(np.nanstd(y)), None
    for before, a, b in zip(edges, edges[1:], edges[2:], strict=False):
        if a < row:
            continue
        w = fitted_starts(
            compiled, p, drive, y, np.isfinite(y), np.array([before]), np.array([b]), share=(a - before) / (b - before),
            least=int(a - before), guess=guess,
        )  # fmt: skip
        run = simulate(compiled, p, drive, w.states, starts=w.starts, stops=w.stops)
        now = simulate(compiled, p, drive, w.states, starts=w.starts, stops=np.array([a])).ends[0]
        guess = now if np.all(np.isfinite(now)) else None
        errors.append(_bounded((y - run.y)[a:b], y[a:b], most))
    return np.concatenate(errors) if errors else np.full(1, np.inf)


def _bounded(e: FloatArray, y: FloatArray, most: float) -> FloatArray:
    """Return errors no larger than a bound: where a simulation runs away, how far does not matter."""
    away = np.isfinite(y) & ~np.isfinite(e)
    return np.clip(np.where(away, most, e), -most, most)


def _until(w: Windows, row: int) -> Windows:
    """Return the windows that begin before a row, the last one cut there."""
    keep = w.starts < row - 20
    return replace(w, starts=w.starts[keep], stops=np.minimum(w.stops[keep], row), states=w.states[keep])
