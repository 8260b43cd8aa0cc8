"""Fits by free-run simulation error: whitened residuals, Gauss-Newton with damping, start states as nuisances.

The simulated output is y_sim(theta, x0); r = y - y_sim; e_k = (r_k - a1 r_{k-1} - a2 r_{k-2}) / sd. The start states
of all windows are free and eliminated by their Schur complement. In closed loop u depends on past noise; with e white
at the true parameters the criterion stays consistent as soon as there is a sample of delay in the loop, which the
zero-order hold provides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.fitting.bases import basis
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.descent import (
    STATE_PRIOR,
    Derivatives,
    Iterate,
    Problem,
    bounded,
    continue_windows,
    descend,
    eliminate,
    freed_of,
    simulate,
)
from autotune.diagnosis.fitting.parameters import Parametrisation
from autotune.diagnosis.simulation.kernel import SIGNALS
from autotune.diagnosis.simulation.simulator import Simulator, Windows
from autotune.errors import AutotuneError, IdentificationError
from autotune.models import Model

#: Gauss-Newton steps of a fit in a search, and of the leading ones at its end.
STEPS, LAST_STEPS = 12, 40
#: What a fit raises where the simulation runs away: that start is no hypothesis.
RUNAWAY = (AutotuneError, OverflowError, np.linalg.LinAlgError)


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """Outcome of a fit.

    Attributes
    ----------
    parametrisation : Parametrisation
        What was free.
    theta : (p,) array
        Estimate in units of the search.
    x0 : tuple of (W, n) array
        Start states per recording.
    chi2 : float
        Sum of squared whitened residuals.
    penalty : float
        Squared distance from the prior in its standard deviations.
    covariance : (p, p) array
        Of theta, scaled with the residual's variance where that exceeds the noise.
    residuals, whitened : tuple of (N,) array
        Per recording.
    signals : tuple of (N, 4) array
        Simulated reading, speed, position, plant input.
    explained : (N, q) array
        What moving the free numbers can explain of a residual beyond the start states: columns that are orthonormal
        together with the rows of the numbers' prior.
    jacobian : (N, p) and (N, n) array
        Derivatives of the whitened residual to the free numbers and to every window's start state.
    windows : tuple of (first, last)
        Rows of every window in the concatenated residual.
    starts : tuple of (W,) int array
        The windows' first rows in the recordings with all their rows.
    rows : int
        Rows that count.
    sim : Simulator
        The fitted model, assembled.
    """

    parametrisation: Parametrisation
    theta: FloatArray
    x0: tuple[FloatArray, ...]
    chi2: float
    penalty: float
    covariance: FloatArray
    residuals: tuple[FloatArray, ...]
    whitened: tuple[FloatArray, ...]
    signals: tuple[FloatArray, ...]
    explained: FloatArray = field(repr=False)
    windows: tuple[tuple[int, int], ...]
    starts: tuple[IntArray, ...]
    rows: int
    sim: Simulator = field(repr=False)
    jacobian: tuple[FloatArray, FloatArray] = field(repr=False)

    @property
    def e(self) -> FloatArray:
        """All whitened residuals, one recording after the other."""
        return np.concatenate(self.whitened)

    @cached_property
    def model(self) -> Model:
        """The fitted model."""
        return self.parametrisation.with_values(self.theta)

    @cached_property
    def states_explain(self) -> tuple[FloatArray, ...]:
        """The same as ``explained`` for the start state of every window: (L, m) arrays."""
        return tuple(basis(self.jacobian[1][a:b]) for a, b in self.windows)

    @cached_property
    def free_states(self) -> float:
        """How many start states the windows have, each as far as it is felt beside its prior: 1 of chi2 from noise."""
        squares = (np.linalg.svd(self.jacobian[1][a:b], compute_uv=False) ** 2 for a, b in self.windows)
        return float(sum(np.sum(each / (each + STATE_PRIOR)) for each in squares))

    def without_states(self, direction: FloatArray) -> FloatArray:
        """Return what is left of a whitened direction when all start states may move against it."""
        windows = np.array(self.windows, dtype=np.int64)
        return np.asarray(freed_of(direction, self._states_together, windows))

    @cached_property
    def _states_together(self) -> FloatArray:
        """What start states explain, all windows in one (N, n) array: columns of 0 where a window has fewer."""
        together = np.zeros((self.jacobian[1].shape[0], max((Q.shape[1] for Q in self.states_explain), default=0)))
        for (a, b), Q in zip(self.windows, self.states_explain, strict=True):
            together[a:b, : Q.shape[1]] = Q
        return together

    def without_numbers(self, direction: FloatArray) -> FloatArray:
        """Return what is left of a direction freed of start states when the free numbers may move against it too.

        They pay for how far they move from their prior: what moves them far is not explained by them whole.
        """
        return np.asarray(direction - self.explained @ (self.explained.T @ direction))

    @property
    def cost(self) -> float:
        """chi2 and penalty together."""
        return self.chi2 + self.penalty


def start_states(sim: Simulator, data: Data) -> list[FloatArray]:
    """Return a first guess of every window's start state: rest at the row's command and reading."""
    result = []
    rows = zip(data.recordings, data.good, data.starts, data.driving, data.first_rows, data.sample_times, strict=True)
    for recording, good, starts, driving, first, dt in rows:
        y = np.empty(starts.size)
        for k, s in enumerate(starts):
            near = good[s : s + 20]
            y[k] = recording.y[s + int(near.argmax())] if near.any() else float(np.mean(recording.y[good]))
        result.append(sim.rest_states(driving.u[np.maximum(first - 1, 0)], y, dt))
    return result


def states_in(result: Fit, data: Data, there: Data) -> list[FloatArray]:
    """Return the states that a fit's simulation has where other windows begin; rest where it has none.

    Parameters
    ----------
    result, data
        A fit, and what it was fitted to.
    there : Data
        Other windows of the same recordings, or of their first rows.
    """
    states = start_states(result.sim, there)
    for i, (x, first) in enumerate(zip(states, there.first_rows, strict=True)):
        known = data.windows[i]
        own = np.searchsorted(known.starts, first, side="right") - 1
        inside = (own >= 0) & (first < known.stops[own])
        until = Windows(starts=known.starts[own[inside]], stops=first[inside])
        number, dt = data.numbers[i] if data.numbers else i, data.sample_times[i]
        x[inside] = result.sim.run(
            data.driving[i], result.x0[i][own[inside]], until, number=number, sample_time_s=dt, signals=1
        )[1]
    return states


def states_of(result: Fit, data: Data) -> list[FloatArray]:
    """Return a fit's start states of the windows that thinned data have."""
    pairs = zip(result.x0, result.starts, data.first_rows, strict=True)
    return [x0[np.searchsorted(known, starts)] for x0, known, starts in pairs]


def fit(
    parametrisation: Parametrisation,
    data: Data,
    theta: FloatArray | None = None,
    x0: Sequence[FloatArray] | None = None,
    iterations: int = 10,
    rounds: int = 2,
    free: BoolArray | None = None,
    inherit: Fit | None = None,
) -> Fit:
    """Fit by simulation error.

    Parameters
    ----------
    parametrisation : Parametrisation
        What is free, and where to start.
    data : Data
        What to fit to.
    theta, x0 : (p,) array, sequence of (W, n) array, optional
        Start; the parametrisation's centre and rest by default.
    iterations, rounds : int
        Most Gauss-Newton steps per round, and most rounds; each begins with start states carried over from the window
        before where that fits better.
    free : (p,) bool array, optional
        Numbers that may move; all by default.
    inherit : Fit, optional
        A fit of the same chain with fewer effects near the start, whose derivatives are used at first.

    Returns
    -------
    Fit
        Estimate with covariance, residuals and signals.

    Raises
    ------
    IdentificationError
        The simulation diverges at the start, or derivatives leave the range of numbers.

    Notes
    -----
    A local search: effects with thresholds need several starts. The covariance is the linearised one.
    """
    point = parametrisation.centre.copy() if theta is None else theta.copy()
    problem = Problem(parametrisation, data)
    sim = parametrisation.simulator(point)
    problem.scales = data.state_sizes(sim)
    fits_in = x0 is not None and x0[0].shape[1] == sim.order
    states = [x.copy() for x in x0] if x0 is not None and fits_in else start_states(sim, data)
    may = np.ones(point.size, dtype=bool) if free is None else free
    iterate = problem.iterate(point, states)
    if not bounded(iterate.e):
        raise IdentificationError("the simulation runs away at the starting point", where="fit")
    derivatives = None
    alike = inherit is not None and inherit.jacobian[1].shape[1] == sim.order
    if inherit is not None and alike and float(iterate.e @ iterate.e) < 2.0 * inherit.chi2:
        derivatives = problem.inherited(point, states, iterate.e, inherit.jacobian)
    return _descended(problem, iterate, derivatives, may, iterations, rounds)


def fit_from(
    parametrisation: Parametrisation,
    data: Data,
    theta: FloatArray,
    *,
    iterations: int,
    states: int = STEPS,
    rounds: int = 2,
) -> Fit:
    """Fit from numbers that were found on other windows: start states first, then the numbers as well.

    Parameters
    ----------
    parametrisation, data, theta, iterations, rounds
        As of :func:`fit`.
    states : int
        Most Gauss-Newton steps of the start states, with the numbers held.
    """
    held = np.zeros(theta.size, dtype=bool)
    begun = fit(parametrisation, data, theta, iterations=states, free=held)
    return fit(parametrisation, data, begun.theta, begun.x0, iterations=iterations, rounds=rounds)


def _descended(
    problem: Problem, iterate: Iterate, derivatives: Derivatives | None, may: BoolArray, iterations: int, rounds: int
) -> Fit:
    """Return the fit that rounds of descent lead to, start states carried over between them."""
    for _ in range(rounds):
        iterate, derivatives = descend(problem, iterate, derivatives, may, iterations)
        before = iterate.e @ iterate.e
        iterate = continue_windows(problem, iterate)
        if before - iterate.e @ iterate.e < 2.0 + 1e-4 * before:
            break
        derivatives = None
    if derivatives is None:
        derivatives = problem.jacobian(iterate, may)
    return _finish(problem, iterate, derivatives, may)


def residual_at(
    parametrisation: Parametrisation, data: Data, theta: FloatArray, x0: tuple[FloatArray, ...]
) -> FloatArray:
    """Return the whitened residual at a point, all recordings one after the other."""
    return Problem(parametrisation, data).iterate(theta, list(x0)).e


def _finish(problem: Problem, iterate: Iterate, derivatives: Derivatives, may: BoolArray) -> Fit:
    _, J_left, _, _ = eliminate(problem, derivatives, iterate.e)
    chi2 = float(iterate.e @ iterate.e)
    prior = problem.prior(iterate.e, may)
    stiffness = np.where(may, 1.0 / problem.parametrisation.spreads, 0.0)
    excess = max(1.0, chi2 / max(problem.data.rows - iterate.theta.size, 1))
    with np.errstate(over="ignore", invalid="ignore"):
        H = J_left.T @ J_left / excess + np.diag(stiffness**2)
    if not np.all(np.isfinite(H)):
        raise IdentificationError("derivatives leave the range of numbers", where="fit")
    edges = np.cumsum([len(r) for r in problem.data.recordings])[:-1]
    signals = simulate(iterate.sim, iterate.x0, problem.data, SIGNALS)[0]
    rows = zip(problem.data.recordings, signals, problem.data.good, strict=True)
    return Fit(
        parametrisation=problem.parametrisation,
        theta=iterate.theta,
        x0=tuple(iterate.x0),
        chi2=chi2,
        penalty=float(np.sum((prior * (iterate.theta - problem.parametrisation.centre)) ** 2)),
        covariance=np.asarray(np.linalg.pinv(H, rcond=1e-14, hermitian=True)),
        residuals=tuple(np.where(good, r.y - out[:, 0], 0.0) for r, out, good in rows),
        whitened=tuple(np.split(iterate.e, edges)),
        signals=tuple(signals),
        explained=basis(J_left, prior),
        jacobian=derivatives,
        windows=tuple(zip(problem.first.tolist(), problem.last.tolist(), strict=True)),
        starts=problem.data.first_rows,
        rows=problem.data.rows,
        sim=iterate.sim,
    )
