"""The descent of a fit: damped Gauss-Newton on whitened simulation errors, start states eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.parameters import Parametrisation
from autotune.diagnosis.simulation.simulator import Simulator
from autotune.errors import AutotuneError, IdentificationError

#: Decrease of the cost at which a descent stops, in units of the noise variance.
TOLERANCE = 0.05
#: Damping below which a small decrease means that the bottom is reached.
SETTLED = 1e-7
#: Inverse variance of a start state beside where it is, in units of its size: what is not felt stays in place. Share of
#: what is felt of a state that is added to it: equations of two that are felt alike can be solved.
STATE_PRIOR, ALIKE = 1e-2, 1e-10


@dataclass(frozen=True, eq=False)
class Iterate:
    """A point of the descent with what its simulation left."""

    theta: FloatArray
    x0: list[FloatArray]
    sim: Simulator
    ends: list[FloatArray]
    e: FloatArray


Derivatives: TypeAlias = tuple[FloatArray, FloatArray]


def simulate(
    sim: Simulator, x0: list[FloatArray], data: Data, signals: int = 1
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return every recording's reading, or all its signals, and the states that its windows end with."""
    result, ends = [], []
    for i, (recording, x) in enumerate(zip(data.driving, x0, strict=True)):
        number = data.numbers[i] if data.numbers else i
        dt = data.sample_times[i]
        out, end = sim.run(recording, x, data.windows[i], number=number, sample_time_s=dt, signals=signals)
        result.append(out)
        ends.append(end)
    return result, ends


AnyArray: TypeAlias = NDArray[Any]


class Problem:
    """Residuals and their derivatives for one parametrisation on one set of data (a scratch pad, not an engine)."""

    def __init__(self, parametrisation: Parametrisation, data: Data) -> None:
        self.parametrisation = parametrisation
        self.data = data
        #: Largest step of every number in one iteration: a factor e for chain and effect sizes
        self.reach = np.array([0.5 if f.kind in ("gain", "den", "num") else 1.0 for f in parametrisation.free])
        self.reach[[f.kind == "effect" and not f.positive for f in parametrisation.free]] = 5.0
        #: Steps of the derivatives
        self.nudge = np.array([1e-2 if f.kind == "effect" else 1e-3 for f in parametrisation.free])
        for i, f in enumerate(parametrisation.free):
            if f.turns:
                angle = 2.0 * np.pi * np.exp(parametrisation.centre[i]) * max(r.duration_s for r in data.driving)
                self.reach[i], self.nudge[i] = 1.0 / angle, 0.05 / angle
        #: First row of every window and the row after its last, in the concatenated residual
        self.first, self.last = data.edges
        #: How many windows every recording has
        self.counts = [len(a) for a in data.starts]
        ends = np.cumsum(self.counts).tolist()
        self._shares = list(zip([0, *ends[:-1]], ends, strict=True))

    def iterate(self, theta: FloatArray, x0: list[FloatArray]) -> Iterate:
        """Simulate at a point."""
        sim = self.parametrisation.simulator(theta)
        signals, ends = simulate(sim, x0, self.data)
        return Iterate(theta, x0, sim, ends, self.data.whitened_runs(signals))

    def per_recording(self, values: AnyArray) -> list[AnyArray]:
        """Split what is known per window into recordings."""
        return [values[first:last] for first, last in self._shares]

    def chi2(self, e: FloatArray) -> FloatArray:
        """Return every window's sum of squares."""
        sums = np.concatenate([[0.0], np.cumsum(e**2)])
        return np.asarray(sums[self.last] - sums[self.first])

    def prior(self, e: FloatArray, may: BoolArray) -> FloatArray:
        """Return what a unit of theta weighs against the data.

        Where the structure is wrong its residual counts as noise, else the fit would move the chain out of all reason.
        """
        weight = max(1.0, float(np.sqrt(e @ e / max(self.data.rows, 1))))
        return np.where(may, weight / self.parametrisation.spreads, 0.0)

    def cost(self, e: FloatArray, theta: FloatArray, prior: FloatArray) -> float:
        """Return chi2 and the prior's penalty."""
        return float(e @ e + np.sum((prior * (theta - self.parametrisation.centre)) ** 2))

    def jacobian(self, iterate: Iterate, may: BoolArray) -> Derivatives:
        """Return de/dtheta (N, p) and de/dx0 (N, n), all windows' states moved at once."""
        J = np.zeros((iterate.e.size, iterate.theta.size))
        for i in np.flatnonzero(may):
            J[:, i] = self._column(int(i), iterate.theta, iterate.x0, iterate.e)
        return J, self.state_columns(iterate, range(iterate.sim.order))

    def state_columns(self, iterate: Iterate, which: Sequence[int]) -> FloatArray:
        """Return de/dx0 (N, s) of some states in units of their scales, all windows' states moved at once."""
        columns = np.empty((iterate.e.size, len(which)))
        for k, j in enumerate(which):
            h = 1e-3 * self.scales[j]
            shifted = [x.copy() for x in iterate.x0]
            for x in shifted:
                x[:, j] += h
            moved = self.data.whitened_runs(simulate(iterate.sim, shifted, self.data)[0])
            column = (moved - iterate.e) * (self.scales[j] / h)
            columns[:, k] = column if bounded(column) else 0.0
        return columns

    def inherited(self, theta: FloatArray, x0: list[FloatArray], e: FloatArray, smaller: Derivatives) -> Derivatives:
        """Return derivatives that take a smaller model's for the numbers they share, new ones for the rest."""
        J_old, Jx = smaller
        J = np.empty((e.size, theta.size))
        J[:, : J_old.shape[1]] = J_old
        for i in range(J_old.shape[1], theta.size):
            J[:, i] = self._column(i, theta, x0, e)
        return J, Jx

    def _column(self, i: int, theta: FloatArray, x0: list[FloatArray], e: FloatArray) -> FloatArray:
        h = self.nudge[i]
        moved = theta.copy()
        moved[i] += h
        column = (self.iterate(moved, x0).e - e) / h
        return column if bounded(column) else np.zeros_like(column)

    scales: FloatArray


def eliminate(
    problem: Problem, derivatives: Derivatives, e: FloatArray, damping: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Project residual and Jacobian on what the start states cannot explain.

    Damped, the start states explain less, and move less: a window that begins where dry friction holds the plant
    tells nothing true of how far its state may go.

    Returns
    -------
    e_left, J_left
        (N,) and (N, p) array: what is left of residual and Jacobian.
    gain_e, gain_J
        (W, n) and (W, n, p) array: start states that explain the rest, in units of their scales.
    """
    J, Jx = derivatives
    left = np.empty((e.size, 1 + J.shape[1]))
    left[:, 0], left[:, 1:] = e, J
    try:
        gains = _freed(left, Jx, problem.first, problem.last, damping)
    except np.linalg.LinAlgError as failure:
        raise IdentificationError("the start states cannot be told from the data", where="fit") from failure
    return left[:, 0], left[:, 1:], gains[:, :, 0], gains[:, :, 1:]


@njit(cache=True, nogil=True)
def _freed(left: FloatArray, Jx: FloatArray, first: IntArray, last: IntArray, damping: float) -> FloatArray:
    """Free columns of what each window's start state explains, in place; return the states that do, (W, n, columns)."""
    n = Jx.shape[1]
    gains = np.empty((first.size, n, left.shape[1]))
    for w in range(first.size):
        X, Y = Jx[first[w] : last[w]], left[first[w] : last[w]]
        G = X.T @ X
        for i in range(n):
            G[i, i] += STATE_PRIOR + (damping + ALIKE) * G[i, i]
        gains[w] = np.linalg.solve(G, X.T @ Y)
        Y -= X @ gains[w]
    return gains


@njit(cache=True, nogil=True)
def freed_of(direction: FloatArray, Q: FloatArray, windows: IntArray) -> FloatArray:
    """Return a direction without what orthonormal columns (N, n) explain of it within each window's rows (W, 2)."""
    left = direction.copy()
    for w in range(windows.shape[0]):
        first, last = windows[w]
        for column in range(Q.shape[1]):
            share = 0.0
            for k in range(first, last):
                share += Q[k, column] * direction[k]
            for k in range(first, last):
                left[k] -= share * Q[k, column]
    return left


def descend(
    problem: Problem,
    iterate: Iterate,
    derivatives: Derivatives | None,
    may: BoolArray,
    iterations: int,
) -> tuple[Iterate, Derivatives | None]:
    """Damped Gauss-Newton steps; derivatives are kept as long as they predict the decrease (chord method)."""
    damping, fresh = 1e-4, False
    for _ in range(iterations):
        prior = problem.prior(iterate.e, may)
        cost = problem.cost(iterate.e, iterate.theta, prior)
        if derivatives is None:
            derivatives, fresh = problem.jacobian(iterate, may), True
        e_left, J_left, gain_e, gain_J = eliminate(problem, derivatives, iterate.e, damping)
        if not (np.all(np.isfinite(J_left)) and np.all(np.isfinite(e_left))):
            return iterate, None  # a derivative ran out of the model's range: the last good point stands
        step = step_of(problem, iterate, derivatives[0], (e_left, J_left), prior, may, damping)
        left = e_left + J_left @ step
        predicted = cost - problem.cost(left, iterate.theta + step, prior)
        moves = problem.per_recording(problem.scales * (gain_e + gain_J @ step))
        trial = [x - move for x, move in zip(iterate.x0, moves, strict=True)]
        new = try_point(problem, iterate.theta + step, trial)
        decrease = -np.inf if new is None else cost - problem.cost(new.e, new.theta, prior)
        if new is not None and decrease < 0.6 * predicted:
            # start states follow the step in theta to first order alone: they are put right before it is judged
            settled = resettle(problem, new, derivatives[1], damping)
            better = -np.inf if settled is None else cost - problem.cost(settled.e, settled.theta, prior)
            if better > decrease:
                new, decrease = settled, better
        if new is not None and decrease > 0.0:
            iterate = new
            damping = max(damping / 10.0, 1e-9)
            small = decrease < TOLERANCE + 1e-5 * cost and (fresh or decrease > 0.5 * predicted)
            if small and damping < SETTLED:  # damped, a step along a flat valley is small far from its end
                break
            if decrease < 0.6 * predicted:
                derivatives = None
            fresh = False
        elif fresh:
            if predicted < TOLERANCE or damping > 1e4:
                break
            damping *= 30.0
        else:
            derivatives = None
    return iterate, derivatives


def step_of(
    problem: Problem,
    iterate: Iterate,
    J: FloatArray,
    left: Derivatives,
    prior: FloatArray,
    may: BoolArray,
    damping: float = 0.0,
) -> FloatArray:
    """Return the step in theta; ``left`` is what start states cannot explain of residual and Jacobian."""
    e_left, J_left = left
    H = J.T @ J_left + np.diag(prior**2)
    g = J.T @ e_left + prior**2 * (iterate.theta - problem.parametrisation.centre)
    step = np.linalg.lstsq(H + damping * np.diag(np.maximum(np.diag(H), 1e-12)), -g, rcond=1e-15)[0]
    step[~may] = 0.0
    step /= max(1.0, float(np.max(np.abs(step) / problem.reach, initial=0.0)))
    return np.asarray(step)


def resettle(problem: Problem, iterate: Iterate, Jx: FloatArray, damping: float) -> Iterate | None:
    """Return a point with the start states that fit its theta, one linear step from where they are."""
    gain = eliminate(problem, (np.empty((iterate.e.size, 0)), Jx), iterate.e, damping)[2]
    moves = problem.per_recording(problem.scales * gain)
    return try_point(problem, iterate.theta, [x - move for x, move in zip(iterate.x0, moves, strict=True)])


def continue_windows(problem: Problem, iterate: Iterate) -> Iterate:
    """Start every window where the one before ended, where that fits better: a restart for stuck start states."""
    if all(len(x) == 1 for x in iterate.x0):
        return iterate
    trial = [x.copy() for x in iterate.x0]
    for i, (x, ends) in enumerate(zip(trial, iterate.ends, strict=True)):
        follows = problem.data.stops[i][:-1] == problem.data.starts[i][1:]
        x[1:][follows] = ends[:-1][follows]
    new = try_point(problem, iterate.theta, trial)
    if new is None:
        return iterate
    better = problem.per_recording(problem.chi2(new.e) < 0.9 * problem.chi2(iterate.e) - 2.0)
    trial = [np.where(b[:, None], x, old) for b, x, old in zip(better, trial, iterate.x0, strict=True)]
    mixed = try_point(problem, iterate.theta, trial)
    return iterate if mixed is None or mixed.e @ mixed.e >= iterate.e @ iterate.e else mixed


def bounded(values: FloatArray) -> bool:
    """Whether a simulation stayed within bounds: one that runs away is finite for a while."""
    return bool(np.max(np.abs(values), initial=0.0) < 1e15)  # NaN compares false


def try_point(problem: Problem, theta: FloatArray, x0: list[FloatArray]) -> Iterate | None:
    """Return a trial point, None where the model there is refused or the simulation diverges."""
    try:
        iterate = problem.iterate(theta, x0)
    except (AutotuneError, OverflowError):
        return None
    return iterate if bounded(iterate.e) else None
