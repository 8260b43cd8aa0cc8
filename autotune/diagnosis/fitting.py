"""Fits by free-run simulation error: whitened residuals, Gauss-Newton with damping, start states as nuisances.

The simulated output is y_sim(theta, x0); r = y - y_sim; e_k = (r_k - a1 r_{k-1} - a2 r_{k-2}) / sd. The start states
of all windows are free and eliminated by their Schur complement. In closed loop u depends on past noise; with e white
at the true parameters the criterion stays consistent as soon as there is a sample of delay in the loop, which the
zero-order hold provides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.noise import Noise
from autotune.diagnosis.parameters import Parametrisation
from autotune.diagnosis.simulation import Simulator, assemble
from autotune.errors import AutotuneError, IdentificationError
from autotune.models import Model
from autotune.recording import Recording

#: Windows of a recording that thinning leaves: fewer would miss a direction or a level of the motion.
LEAST_WINDOWS_KEPT = 6


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """Recordings with what a fit needs to know of them.

    Attributes
    ----------
    recordings : tuple of Recording
        What was measured.
    good : tuple of (N,) bool array
        Rows whose reading counts.
    starts : tuple of (W,) int array
        Rows where the state starts anew: the first row alone, or every window's.
    stops : tuple of (W,) int array
        Rows before which the windows end.
    noise : Noise
        Autoregressive noise model that whitens residuals.
    numbers : tuple of int
        The recordings' numbers in the order given by the user.
    """

    recordings: tuple[Recording, ...]
    good: tuple[BoolArray, ...]
    starts: tuple[IntArray, ...]
    stops: tuple[IntArray, ...]
    noise: Noise
    numbers: tuple[int, ...] = ()

    def thinned(self, rows: int) -> Data:
        """Return the data with windows left out evenly, until about as many rows count."""
        share = max(1.0, self.rows / rows)
        if share < 1.5:
            return self
        starts, stops, good = [], [], []
        for a, b, ok in zip(self.starts, self.stops, self.good, strict=True):
            count = min(len(a), max(LEAST_WINDOWS_KEPT, round(len(a) / share)))
            keep = np.unique(np.linspace(0, len(a) - 1, count).round().astype(np.int64))
            inside = np.zeros(ok.size, dtype=bool)
            for first, last in zip(a[keep], b[keep], strict=True):
                inside[first:last] = True
            starts.append(a[keep])
            stops.append(b[keep])
            good.append(ok & inside)
        return replace(self, starts=tuple(starts), stops=tuple(stops), good=tuple(good))

    @property
    def rows(self) -> int:
        """Rows that count."""
        return int(sum(g.sum() for g in self.good))

    def whitened(self, residuals: list[FloatArray]) -> list[FloatArray]:
        """Return the residuals whitened by the noise model, zero where a row or one that it needs does not count."""
        result = []
        for r, good, starts in zip(residuals, self.good, self.starts, strict=True):
            e, use = r.copy(), good.copy()
            fresh = np.zeros(r.size, dtype=bool)
            fresh[starts] = True
            for lag, a in enumerate(self.noise.ar, start=1):
                back = np.flatnonzero(~fresh[lag:]) + lag
                e[back] -= a * r[back - lag]
                use[back] &= good[back - lag]
                fresh[1:] |= fresh[:-1]  # a row that near to a start has no older one
            e[~use] = 0.0
            result.append(e / self.noise.sd)
        return result


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
        Orthonormal columns: what moving the free numbers can explain of a residual beyond the start states.
    states_explain : tuple of (L, m) array
        The same for the start state of every window.
    jacobian : (N, p) and (N, n) array
        Derivatives of the whitened residual to the free numbers and to every window's start state.
    windows : tuple of (first, last)
        Rows of every window in the concatenated residual.
    starts : tuple of (W,) int array
        The windows' first rows in their recordings.
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
    states_explain: tuple[FloatArray, ...] = field(repr=False)
    windows: tuple[tuple[int, int], ...]
    starts: tuple[IntArray, ...]
    rows: int
    sim: Simulator = field(repr=False)
    jacobian: tuple[FloatArray, FloatArray] = field(repr=False)

    @property
    def e(self) -> FloatArray:
        """All whitened residuals, one recording after the other."""
        return np.concatenate(self.whitened)

    @property
    def model(self) -> Model:
        """The fitted model."""
        return self.parametrisation.with_values(self.theta)

    def unexplained(self, direction: FloatArray) -> FloatArray:
        """Return what is left of a whitened direction when all free numbers and states may move against it."""
        left = direction.copy()
        for (a, b), Q in zip(self.windows, self.states_explain, strict=True):
            left[a:b] -= Q @ (Q.T @ left[a:b])
        return np.asarray(left - self.explained @ (self.explained.T @ left))

    @property
    def cost(self) -> float:
        """chi2 and penalty together."""
        return self.chi2 + self.penalty


def _simulate(sim: Simulator, x0: list[FloatArray], data: Data) -> tuple[list[FloatArray], list[FloatArray]]:
    signals, ends = [], [np.empty_like(x) for x in x0]
    for i, (recording, x, starts) in enumerate(zip(data.recordings, x0, data.starts, strict=True)):
        signals.append(sim.run(recording, x, starts, data.numbers[i] if data.numbers else i, ends[i], data.stops[i]))
    return signals, ends


def _whiten(signals: list[FloatArray], data: Data) -> tuple[list[FloatArray], FloatArray]:
    residuals = []
    for recording, out, good in zip(data.recordings, signals, data.good, strict=True):
        r = np.where(good, recording.y - out[:, 0], 0.0)
        residuals.append(r)
    return residuals, np.concatenate(data.whitened(residuals))


def start_states(sim: Simulator, data: Data) -> list[FloatArray]:
    """Return a first guess of every window's start state: rest at the row's command and reading."""
    result = []
    for recording, good, starts in zip(data.recordings, data.good, data.starts, strict=True):
        states = []
        for s in starts:
            near = np.flatnonzero(good[s : s + 20])
            y = recording.y[s + near[0]] if near.size else float(np.mean(recording.y[good]))
            states.append(sim.rest_state(recording.u[max(s - 1, 0)], y))
        result.append(np.array(states))
    return result


def state_scales(sim: Simulator, commands: Sequence[FloatArray], readings: Sequence[FloatArray]) -> FloatArray:
    """Return a size for every state: what the command's span makes of it, bounded by what the readings show."""
    span = max(float(np.std(u)) for u in commands)
    spread = max(float(np.std(y)) for y in readings)
    A, b = sim.chain.A, sim.chain.B[:, 0]
    n = sim.chain.order
    damped = A - 1e-3 * np.eye(n) * max(float(np.abs(A).max()), 1e-9)
    states = np.abs(np.linalg.solve(damped, b)) * span
    tap = np.abs(sim.chain.taps[3])
    states = np.where(tap > 0, np.minimum(states, spread / np.maximum(tap, 1e-300)), states)
    return np.asarray(np.maximum(states, 1e-9))


class _Problem:
    """Residuals and their derivatives for one parametrisation on one set of data (a scratch pad, not an engine)."""

    def __init__(self, parametrisation: Parametrisation, data: Data) -> None:
        self.parametrisation = parametrisation
        self.data = data
        #: Largest step of every number in one iteration: a factor e for chain and effect sizes
        self.reach = np.array([0.5 if f.kind in ("gain", "den", "num") else 1.0 for f in parametrisation.free])
        self.reach[[f.kind == "effect" and not f.positive for f in parametrisation.free]] = 5.0
        self.edges = np.cumsum([0] + [len(r) for r in data.recordings])

    def windows(self) -> list[tuple[int, int, int, int]]:
        """Return (recording, window, first, last) rows in the concatenated residual."""
        result = []
        for i, starts in enumerate(self.data.starts):
            for w, (a, b) in enumerate(zip(starts, self.data.stops[i], strict=True)):
                result.append((i, w, int(self.edges[i] + a), int(self.edges[i] + b)))
        return result

    def spot(self, theta: FloatArray, x0: list[FloatArray]) -> _Spot:
        """Simulate at a point."""
        sim = assemble(self.parametrisation.with_values(theta))
        signals, ends = _simulate(sim, x0, self.data)
        return _Spot(theta, x0, sim, signals, ends, _whiten(signals, self.data)[1])

    def prior(self, e: FloatArray, may: BoolArray) -> FloatArray:
        """Return what a unit of theta weighs against the data.

        Where the structure is wrong its misfit counts as noise, else the fit would bend the chain out of all reason.
        """
        weight = max(1.0, float(np.sqrt(e @ e / max(self.data.rows, 1))))
        return np.where(may, weight / self.parametrisation.spreads, 0.0)

    def cost(self, e: FloatArray, theta: FloatArray, prior: FloatArray) -> float:
        """Return chi2 and the prior's penalty."""
        return float(e @ e + np.sum((prior * (theta - self.parametrisation.centre)) ** 2))

    def jacobian(self, spot: _Spot, may: BoolArray) -> _Derivatives:
        """Return de/dtheta (N, p) and de/dx0 (N, n), all windows' states moved at once."""
        J = np.zeros((spot.e.size, spot.theta.size))
        for i in np.flatnonzero(may):
            J[:, i] = self._column(int(i), spot.theta, spot.x0, spot.e)
        Jx = np.empty((spot.e.size, spot.sim.chain.order))
        for j in range(spot.sim.chain.order):
            h = 1e-3 * self.scales[j]
            shifted = [x.copy() for x in spot.x0]
            for x in shifted:
                x[:, j] += h
            moved = _whiten(_simulate(spot.sim, shifted, self.data)[0], self.data)[1]
            column = (moved - spot.e) * (self.scales[j] / h)
            Jx[:, j] = column if _bounded(column) else 0.0
        return J, Jx

    def inherited(self, theta: FloatArray, x0: list[FloatArray], e: FloatArray, base: Fit) -> _Derivatives:
        """Return derivatives that take a smaller model's for the numbers they share, new ones for the rest."""
        J_old, Jx = base.jacobian
        J = np.empty((e.size, theta.size))
        J[:, : J_old.shape[1]] = J_old
        for i in range(J_old.shape[1], theta.size):
            J[:, i] = self._column(i, theta, x0, e)
        return J, Jx

    def _column(self, i: int, theta: FloatArray, x0: list[FloatArray], e: FloatArray) -> FloatArray:
        h = 1e-3 if self.parametrisation.free[i].kind != "effect" else 1e-2
        moved = theta.copy()
        moved[i] += h
        column = (self.spot(moved, x0).e - e) / h
        return column if _bounded(column) else np.zeros_like(column)

    scales: FloatArray
    reach: FloatArray


def _eliminate(
    J: FloatArray, Jx: FloatArray, e: FloatArray, windows: list[tuple[int, int, int, int]]
) -> tuple[FloatArray, FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Project residual and Jacobian on what the start states cannot explain; also what recovers the states."""
    e_left, J_left = e.copy(), J.copy()
    back = []
    for _, _, a, b in windows:
        X = Jx[a:b]
        # a little of the prior that start states are of the signals' size keeps unfelt ones in place
        G = X.T @ X
        G += (1e-2 + 1e-10 * float(np.trace(G))) * np.eye(X.shape[1])
        try:
            solve = np.linalg.solve(G, X.T)
        except np.linalg.LinAlgError as failure:
            raise IdentificationError("the start states cannot be told from the data", where="fit") from failure
        gain_e, gain_J = solve @ e[a:b], solve @ J[a:b]
        e_left[a:b] -= X @ gain_e
        J_left[a:b] -= X @ gain_J
        back.append((gain_e, gain_J))
    return e_left, J_left, back


def fit(
    parametrisation: Parametrisation,
    data: Data,
    theta: FloatArray | None = None,
    x0: Sequence[FloatArray] | None = None,
    iterations: int = 10,
    rounds: int = 2,
    tolerance: float = 0.05,
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
    theta : (p,) array, optional
        Start; the parametrisation's centre by default.
    x0 : sequence of (W, n) array, optional
        Start states to begin from; rest by default.
    iterations : int
        Most Gauss-Newton steps per round.
    rounds : int
        Most rounds; each begins with start states carried over from the window before where that fits better.
    tolerance : float
        Decrease of the cost at which to stop, in units of the noise variance.
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
        The simulation diverges at the starting point, or derivatives leave the range of numbers.

    Notes
    -----
    A local search: effects with thresholds need several starts. The covariance is the linearised one.
    """
    point = parametrisation.centre.copy() if theta is None else theta.copy()
    problem = _Problem(parametrisation, data)
    sim = assemble(parametrisation.with_values(point))
    problem.scales = state_scales(
        sim, [r.u for r in data.recordings], [r.y[g] for r, g in zip(data.recordings, data.good, strict=True)]
    )
    fits_in = x0 is not None and x0[0].shape[1] == sim.chain.order
    states = [x.copy() for x in x0] if x0 is not None and fits_in else start_states(sim, data)
    may = np.ones(point.size, dtype=bool) if free is None else free
    spot = problem.spot(point, states)
    if not _bounded(spot.e):
        raise IdentificationError("the simulation runs away at the starting point", where="fit")
    derivatives = None
    near = inherit is not None and float(spot.e @ spot.e) < 2.0 * inherit.chi2
    if inherit is not None and near and inherit.jacobian[1].shape[1] == sim.chain.order:
        derivatives = problem.inherited(point, states, spot.e, inherit)
    for _ in range(rounds):
        spot, derivatives = _descend(problem, spot, derivatives, may, iterations, tolerance)
        before = spot.e @ spot.e
        spot = _continued(problem, spot)
        if before - spot.e @ spot.e < 2.0 + 1e-4 * before:
            break
        derivatives = None
    if derivatives is None:
        derivatives = problem.jacobian(spot, may)
    return _finish(problem, spot, derivatives, may)


@dataclass(frozen=True, eq=False)
class _Spot:
    """A point of the search with everything that was simulated there."""

    theta: FloatArray
    x0: list[FloatArray]
    sim: Simulator
    signals: list[FloatArray]
    ends: list[FloatArray]
    e: FloatArray


_Derivatives: TypeAlias = tuple[FloatArray, FloatArray]


def _descend(
    problem: _Problem, spot: _Spot, derivatives: _Derivatives | None, may: BoolArray, iterations: int, tolerance: float
) -> tuple[_Spot, _Derivatives | None]:
    """Damped Gauss-Newton steps; derivatives are kept as long as they predict the decrease (chord method)."""
    windows = problem.windows()
    damping, fresh = 1e-4, False
    for _ in range(iterations):
        prior = problem.prior(spot.e, may)
        cost = problem.cost(spot.e, spot.theta, prior)
        if derivatives is None:
            derivatives, fresh = problem.jacobian(spot, may), True
        e_left, J_left, back = _eliminate(*derivatives, spot.e, windows)
        if not (np.all(np.isfinite(J_left)) and np.all(np.isfinite(e_left))):
            return spot, None  # a derivative ran out of the model's range: the last good point stands
        step, promised = _step(problem, spot, e_left, J_left, prior, damping, may)
        trial = [x.copy() for x in spot.x0]
        for (i, w, _, _), (gain_e, gain_J) in zip(windows, back, strict=True):
            trial[i][w] -= problem.scales * (gain_e + gain_J @ step)
        new = _attempted(problem, spot.theta + step, trial)
        decrease = -np.inf if new is None else cost - problem.cost(new.e, new.theta, prior)
        if new is not None and decrease > 0.0:
            spot = new
            damping = max(damping / 10.0, 1e-9)
            if decrease < tolerance + 1e-5 * cost and (fresh or decrease > 0.5 * promised):
                break
            if decrease < 0.6 * promised:
                derivatives = None
            fresh = False
        elif fresh:
            if promised < tolerance or damping > 1e4:
                break
            damping *= 30.0
        else:
            derivatives = None
    return spot, derivatives


def _step(
    problem: _Problem,
    spot: _Spot,
    e_left: FloatArray,
    J_left: FloatArray,
    prior: FloatArray,
    damping: float,
    may: BoolArray,
) -> tuple[FloatArray, float]:
    """Return the step in theta and the decrease of the cost that it promises."""
    H = J_left.T @ J_left + np.diag(prior**2)
    g = J_left.T @ e_left + prior**2 * (spot.theta - problem.parametrisation.centre)
    step = np.linalg.lstsq(H + damping * np.diag(np.maximum(np.diag(H), 1e-12)), -g, rcond=1e-15)[0]
    step[~may] = 0.0
    step /= max(1.0, float(np.max(np.abs(step) / problem.reach, initial=0.0)))
    promised = -2.0 * float(g @ step) - float(step @ H @ step) + float(spot.e @ spot.e - e_left @ e_left)
    return np.asarray(step), promised


def _continued(problem: _Problem, spot: _Spot) -> _Spot:
    """Start every window where the one before ended, where that fits better: a way out of stuck start states."""
    if all(len(x) == 1 for x in spot.x0):
        return spot
    trial = [x.copy() for x in spot.x0]
    for i, (x, ends) in enumerate(zip(trial, spot.ends, strict=True)):
        follows = problem.data.stops[i][:-1] == problem.data.starts[i][1:]
        x[1:][follows] = ends[:-1][follows]
    new = _attempted(problem, spot.theta, trial)
    if new is None:
        return spot
    for i, w, a, b in problem.windows():
        if not new.e[a:b] @ new.e[a:b] < 0.9 * (spot.e[a:b] @ spot.e[a:b]) - 2.0:
            trial[i][w] = spot.x0[i][w]
    mixed = _attempted(problem, spot.theta, trial)
    return spot if mixed is None or mixed.e @ mixed.e >= spot.e @ spot.e else mixed


def residual_at(
    parametrisation: Parametrisation, data: Data, theta: FloatArray, x0: tuple[FloatArray, ...]
) -> FloatArray:
    """Return the whitened residual at a point, all recordings one after the other."""
    return _Problem(parametrisation, data).spot(theta, list(x0)).e


def _bounded(values: FloatArray) -> bool:
    """Whether a simulation stayed within bounds: one that runs away is finite for a while."""
    return bool(np.max(np.abs(values), initial=0.0) < 1e15)  # NaN compares false


def _attempted(problem: _Problem, theta: FloatArray, x0: list[FloatArray]) -> _Spot | None:
    """Return a trial point, None where the model there is refused or the simulation diverges."""
    try:
        spot = problem.spot(theta, x0)
    except (AutotuneError, OverflowError):
        return None
    return spot if _bounded(spot.e) else None


def _finish(problem: _Problem, spot: _Spot, derivatives: _Derivatives, may: BoolArray) -> Fit:
    windows = problem.windows()
    _, J_left, _ = _eliminate(*derivatives, spot.e, windows)
    chi2 = float(spot.e @ spot.e)
    prior = problem.prior(spot.e, may)
    believed = np.where(may, 1.0 / problem.parametrisation.spreads, 0.0)
    excess = max(1.0, chi2 / max(problem.data.rows - spot.theta.size, 1))
    with np.errstate(over="ignore", invalid="ignore"):
        H = J_left.T @ J_left / excess + np.diag(believed**2)
    if not np.all(np.isfinite(H)):
        raise IdentificationError("derivatives leave the range of numbers", where="fit")
    edges = np.cumsum([len(r) for r in problem.data.recordings])[:-1]
    return Fit(
        parametrisation=problem.parametrisation,
        theta=spot.theta,
        x0=tuple(spot.x0),
        chi2=chi2,
        penalty=float(np.sum((prior * (spot.theta - problem.parametrisation.centre)) ** 2)),
        covariance=np.asarray(np.linalg.pinv(H, rcond=1e-14, hermitian=True)),
        residuals=tuple(_whiten(spot.signals, problem.data)[0]),
        whitened=tuple(np.split(spot.e, edges)),
        signals=tuple(spot.signals),
        explained=_basis(J_left),
        jacobian=derivatives,
        states_explain=tuple(_basis(derivatives[1][a:b]) for _, _, a, b in windows),
        windows=tuple((a, b) for _, _, a, b in windows),
        starts=problem.data.starts,
        rows=problem.data.rows,
        sim=spot.sim,
    )


def _basis(J: FloatArray) -> FloatArray:
    """Return orthonormal columns that span the well-determined part of J's columns."""
    norms = np.linalg.norm(J, axis=0)
    scaled = J[:, norms > 1e-9] / norms[norms > 1e-9]
    if scaled.shape[1] == 0:
        return np.zeros((J.shape[0], 0))
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    keep = values > 1e-8 * values[-1]
    return np.asarray(scaled @ (vectors[:, keep] / np.sqrt(values[keep])))
