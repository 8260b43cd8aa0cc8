"""The iterate of a fit: Gauss-Newton with Levenberg's damping, start states eliminated by projection.

References
----------
M. K. Transtrum, J. P. Sethna, Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
minimization, arXiv:1201.5885, 2012, section 3: along a narrow curved valley straight moves alone are short.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray, deviations_beside_prior
from autotune.equations.fit_data import FitData, Fitted, covered_rows, mean_squares
from autotune.equations.parameter_scales import linear, slopes_of, values_of
from autotune.equations.rest import state_scales, stated_starts
from autotune.equations.sensitivity import (
    STEP,
    WORTH_A_THREAD,
    Sensitivities,
    Windows,
    run_windows,
    sensitivities,
    side_by_side,
)
from autotune.equations.simulate import Compiled, Drive, Run
from autotune.equations.starts import restart_some
from autotune.errors import InputError

#: Relative decrease of the penalised sum of squares below which a fit has converged.
_SMALL = 1e-4
#: Moves with the derivatives of one point at most, and the share of the decrease before that one more must bring.
MOVES, WORTH_MOVING = 4, 0.1
#: Weight of the belief that a start state is where it was, of what the readings tell of all, and by what it grows
#: where a move fails: a state that readings hardly feel would jump, and hold up every number beside it.
FIRMNESS, FIRMER = 1e-9, 10.0
#: Damping at most that one descent begins with after another: where nothing helped there, the next one may still move.
MOST_DAMPED = 1e3
#: Times the median window's mean square from which on a window stands out and is started anew.
STANDS_OUT = 4.0
#: Windows at least of which one may stand out, and what of its mean square a new start may leave to be taken.
LEAST_WINDOWS, RESTARTED = 4, 0.7

#: Per window of a recording: derivatives to start states, which of these are free, derivatives to z, and a basis of
#: what the start states explain.
_Back: TypeAlias = list[tuple[FloatArray, IntArray, FloatArray, FloatArray]]
#: J to z with the start states projected out, and per window what gives those back.
_Derivatives: TypeAlias = tuple[FloatArray, _Back]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Iterate:
    """Parameters, start states, what they simulate at every row, and the errors that they leave at those that count."""

    z: FloatArray
    windows: list[Windows]
    runs: list[FloatArray]
    errors: list[FloatArray]


class Descent:
    """The iterate of one fit."""

    def __init__(self, compiled: Compiled, data: Sequence[FitData], which: IntArray, z: FloatArray) -> None:
        self._compiled, self._data, self._which = compiled, list(data), which
        self._known: list[Sensitivities] | None = None  # derivatives at every row of every recording, once they are
        self._free_first = np.flatnonzero(~np.isfinite(stated_starts(compiled)))
        start = values_of(compiled, z)
        scales = [state_scales(compiled, start, one.drive, one.windows.states[0]) for one in data]
        self._scales = np.max(scales, axis=0)
        self._damping, self._firmness = 1e-3, FIRMNESS
        self._last: FloatArray | None = None
        begun = self._iterate(z, [one.windows for one in data])
        if begun is None:
            raise InputError(
                "the simulation runs away from every start", where=compiled.model.name,
                remedy="check signs and units, or give horizon_s: an unstable plant is compared as forecasts",
            )  # fmt: skip
        self._at = begun
        self._sd = self._noise(begun.errors)

    def on_fewer_rows(self, good: Sequence[BoolArray]) -> Descent:
        """Return this descent from where it is with fewer rows that count; what was simulated is not simulated again.

        Parameters
        ----------
        good : sequence of (N,) bool arrays
            Per recording, which rows count; of those that count here.
        """
        self._known = self._known or self.sensitivities()
        other = copy(self)
        each = list(zip(self._data, good, self._at.errors, strict=True))
        errors = [e[new[one.good & covered_rows(one.y.size, one.windows)]] for one, new, e in each]
        other._at, other._sd = replace(self._at, errors=errors), self._noise(errors)
        other._data = [replace(one, good=new) for one, new, _ in each]
        return other

    def begin_as(self, other: Descent) -> None:
        """Begin with the damping at which another descent moved from the same place: about as much is needed again."""
        self._damping, self._firmness = min(other._damping, MOST_DAMPED), other._firmness

    def _iterate(self, z: FloatArray, windows: list[Windows]) -> _Iterate | None:
        """Return parameters and start states with what they simulate, None where a run does not reach its end."""
        runs, errors, p = [], [], values_of(self._compiled, z)
        each = list(zip(self._data, windows, strict=True))

        def run_of(pair: tuple[FitData, Windows]) -> Run:
            one, w = pair
            return run_windows(self._compiled, p, one.drive, w)

        rows = sum(int(np.sum(w.stops - w.starts)) for w in windows)
        found = side_by_side(run_of, each) if len(each) > 1 and rows > WORTH_A_THREAD else map(run_of, each)
        for (one, w), run in zip(each, found, strict=True):
            error = (one.y - run.y)[one.good & covered_rows(one.y.size, w)]
            if not np.all(np.isfinite(error)):
                return None
            runs.append(run.y)
            errors.append(error)
        return _Iterate(z=z, windows=windows, runs=runs, errors=errors)

    @staticmethod
    def _noise(errors: Sequence[FloatArray]) -> float:
        return float(np.sqrt(np.mean(np.concatenate(list(errors)) ** 2))) + 1e-300

    def _derivatives(self) -> list[_Derivatives]:
        """Return per recording J to z with the start states projected out, and per window what gives those back."""
        per_z = slopes_of(self._compiled, self._at.z)
        known, self._known = self._known or self.sensitivities(), None
        return [self._project_windows(one, s, per_z) for one, s in zip(self._data, known, strict=True)]

    def sensitivities(self) -> list[Sensitivities]:
        """Return the derivatives of every recording's readings at the iterate."""
        compiled = self._compiled
        p = values_of(compiled, self._at.z)
        spread = np.array([q.spread for q in compiled.parameters])
        steps = STEP * np.maximum(np.abs(p), np.abs(np.where(linear(compiled), spread, p * spread)))
        steps = np.where(steps > 0.0, steps, STEP)
        return [
            sensitivities(
                compiled, p, one.drive, one.windows, parameter_steps=steps, state_steps=STEP * self._scales,
                which=self._which.tolist(),
            )
            for one in self._data
        ]  # fmt: skip

    def simulated(self, drives: Sequence[Drive] | None = None) -> list[FloatArray]:
        """Return y at every row of every recording, of other drives if given; NaN from where a simulation runs away."""
        if drives is None and self._at.runs:
            return self._at.runs
        p = values_of(self._compiled, self._at.z)
        each = zip(self._data, drives or [one.drive for one in self._data], strict=True)
        return [run_windows(self._compiled, p, drive, one.windows).y for one, drive in each]

    def _project_windows(self, one: FitData, s: Sensitivities, per_z: FloatArray) -> _Derivatives:
        J = (s.to_parameters * per_z)[:, self._which]
        X = s.to_states * self._scales
        parts, back = [], []
        for a, b in zip(one.windows.starts, one.windows.stops, strict=True):
            rows = np.flatnonzero(one.good[a:b]) + a
            free = self._free_first if a == 0 else np.arange(X.shape[1])
            Q, R = np.linalg.qr(np.nan_to_num(X[rows][:, free]))
            # a state that the window does not tell is left where it is
            keep = np.abs(np.diag(R)) > 1e-6 * max(float(np.max(np.abs(np.diag(R)), initial=0.0)), 1e-300)
            Q = Q[:, keep]
            Jw = np.nan_to_num(J[rows])
            parts.append(Jw - Q @ (Q.T @ Jw))
            back.append((np.nan_to_num(X[rows][:, free]), free, Jw, Q))
        return np.vstack(parts), back

    def step(self, most: int = MOVES) -> bool:
        """Move while the derivatives of one point lower the cost, and return whether there was next to none to take.

        Derivatives cost a simulation for each number and each state, a move one.
        """
        derivatives = self._derivatives()
        self._last = np.vstack([part for part, _ in derivatives])
        before = cost = self._cost()
        gained = 0.0
        for k in range(most):
            damping = self._damping
            if not self._attempt_move(derivatives, 12 if k == 0 else 1):
                self._damping = damping if k else self._damping
                break
            cost, previous = self._cost(), cost
            if previous - cost < max(WORTH_MOVING * gained, _SMALL * previous):
                break
            gained = previous - cost
        self._sd = self._noise(self._at.errors)
        return bool(before - cost < _SMALL * before)

    def _attempt_move(self, derivatives: Sequence[_Derivatives], tries: int) -> bool:
        """Take a move that lowers the penalised sum of squares, shorter ones where the first does not.

        Where a move ends too high, what its derivatives did not foresee is taken back by one more with the same ones:
        to second order that leads back to the bottom of a curved valley.
        """
        J = np.vstack([part for part, _ in derivatives]) / self._sd
        H = J.T @ J + np.eye(self._which.size)
        backs, before = [back for _, back in derivatives], self._cost()
        for k in range(tries):
            damping = self._damping * np.diag(np.diag(H))
            at = self._at
            foreseen = np.zeros(self._which.size)
            for _ in range(2):
                new = self._next(at, J, H + damping, backs, foreseen)
                if new is None:
                    break
                if self._cost_of(new.errors, new.z) < before:
                    self._at = new
                    self._data = [replace(one, windows=w) for one, w in zip(self._data, new.windows, strict=True)]
                    self._damping = max(self._damping * 0.2, 1e-9)
                    self._firmness = max(self._firmness / FIRMER, FIRMNESS)
                    return True
                foreseen = damping @ (new.z - at.z)[self._which]
                at = new
            self._firmness = min(self._firmness * FIRMER**2, 1.0)
            self._damping *= 10.0 if k % 2 else 1.0
        return False

    def _next(
        self, at: _Iterate, J: FloatArray, damped: FloatArray, backs: Sequence[_Back], foreseen: FloatArray
    ) -> _Iterate | None:
        """Return what a damped move from an iterate leads to, the gradient that was foreseen there left as it is.

        None where the simulation runs away.
        """
        z = at.z[self._which]
        e = np.concatenate([_project_error(back, error) for back, error in zip(backs, at.errors, strict=True)])
        move = np.linalg.solve(damped, J.T @ (e / self._sd) - z - foreseen) if z.size else np.zeros(0)
        new_z = at.z.copy()
        new_z[self._which] += np.clip(move, -3.0, 3.0)
        each = zip(at.windows, backs, at.errors, strict=True)
        windows = [self._move_starts(w, back, error, new_z[self._which] - z) for w, back, error in each]
        return self._iterate(new_z, windows)

    def _cost(self) -> float:
        return self._cost_of(self._at.errors, self._at.z)

    def _cost_of(self, errors: Sequence[FloatArray], z: FloatArray) -> float:
        e = np.concatenate(list(errors)) / self._sd
        return float(e @ e + z[self._which] @ z[self._which])

    def _move_starts(self, windows: Windows, back: _Back, error: FloatArray, move: FloatArray) -> Windows:
        """Return windows whose start states take up what the parameters' move leaves."""
        states, at = windows.states.copy(), 0
        for k, (X, free, J, _) in enumerate(back):
            wanted = error[at : at + X.shape[0]] - J @ move
            at += X.shape[0]
            # a weak belief that the state is where it was keeps what the readings do not tell
            H = X.T @ X + self._firmness * np.eye(free.size) * max(float(np.trace(X.T @ X)), 1e-300)
            states[k, free] += self._scales[free] * np.linalg.solve(H, X.T @ wanted)
        return replace(windows, states=states)

    def restart_windows(self) -> bool:
        """Start windows that stand out anew, from where the one before ends; return whether that explains any better.

        A start state that made up for wrong numbers may lead to another swing than the right one, for good.
        """
        p, runs = values_of(self._compiled, self._at.z), self.simulated()
        before = [mean_squares(one, one.windows, y) for one, y in zip(self._data, runs, strict=True)]
        known = np.concatenate(before)
        if known.size < LEAST_WINDOWS or not np.any(known > STANDS_OUT * np.median(known)):
            return False
        most = STANDS_OUT * float(np.median(known))
        windows = [
            restart_some(
                self._compiled, p, one.drive, one.y, one.good, one.windows, np.flatnonzero(size > most), self._scales
            )
            for one, size in zip(self._data, before, strict=True)
        ]
        found = False
        for i, (one, new, old) in enumerate(zip(self._data, windows, before, strict=True)):
            better = mean_squares(one, new, run_windows(self._compiled, p, one.drive, new).y) < RESTARTED * old
            states = np.where(better[:, None], new.states, one.windows.states)
            self._data[i] = replace(one, windows=replace(one.windows, states=states))
            found = found or bool(better.any())
        windows = [one.windows for one in self._data]
        if found:  # where a run no longer reaches its end its errors stay, and it is simulated where it is asked for
            self._at = self._iterate(self._at.z, windows) or replace(self._at, windows=windows, runs=[])
        return found

    def fitted(self) -> Fitted:
        """Return what was found."""
        compiled, p = self._compiled, values_of(self._compiled, self._at.z)
        if self._last is None:
            self._last = np.vstack([part for part, _ in self._derivatives()])
        J = self._last / self._sd
        per_z = np.abs(slopes_of(compiled, self._at.z))
        sd, whole = np.zeros(p.size), np.zeros((J.shape[0], p.size))
        sd[self._which] = deviations_beside_prior(J) * per_z[self._which]
        whole[:, self._which] = J
        simulated = tuple(self.simulated())
        residuals = tuple(np.where(one.good, one.y - y, np.nan) for one, y in zip(self._data, simulated, strict=True))
        return Fitted(
            compiled=compiled, parameters=p, sd=sd, z=self._at.z, windows=tuple(one.windows for one in self._data),
            simulated=simulated, residuals=residuals, noise_sd=self._sd, jacobian=whole,
        )  # fmt: skip


def _project_error(back: _Back, error: FloatArray) -> FloatArray:
    """Return the errors without what start states explain."""
    parts, at = [], 0
    for *_, Q in back:
        e = error[at : at + Q.shape[0]]
        at += Q.shape[0]
        parts.append(e - Q @ (Q.T @ e))
    return np.concatenate(parts)
