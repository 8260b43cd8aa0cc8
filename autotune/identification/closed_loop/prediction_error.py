"""Prediction-error polish of an innovation model: the estimate that reaches the Cramer-Rao bound.

From a consistent start (a subspace estimate) the determinant of the innovations' covariance is minimised over A, B, C,
D, K, the initial state and a constant, by Levenberg-Marquardt steps with the exact gradient. The initial state must be
free: with a controller of high gain at low frequency, residuals wrongly set to zero before the first row ruin the fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.predictor_directions import (
    Predictor,
    behaviour_directions,
    regressors,
)
from autotune.identification.closed_loop.predictor_sweep import normal_equations, scatter
from autotune.identification.closed_loop.state_space import InnovationModel, balancing, spectral_radius

#: A step that promises less than this in -2 log likelihood moves no parameter by 3 % of its standard deviation.
_TOLERANCE = 1e-3
#: Rows that the initial state of the start is fitted on.
_LINEAR_ROWS = 2000
#: A search that cannot move any more has converged if it could have gained less than this.
_IMMATERIAL = 0.1
#: A search that could gain less than this is near enough to its end to tell whether a constant is missing.
_NEAR = 1.0
#: Means above this share of the motion are an operating point, about which everything is computed: far from it, the
#: constant and the dynamics hang together.
_OPERATING_POINT = 0.2
#: Zeros of the noise model nearer to the unit circle than this have no finite memory worth the name.
_RADIUS_LIMIT = 0.9999
#: Smaller innovations, relative to the output, are rounding.
_NOISE_FREE = 1e-11
#: Innovations this small say that the record has no noise in it.
_ROUNDING = 1e-8


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictionErrorEstimate:
    """A polished model with the covariance of its behaviour.

    Attributes
    ----------
    model : InnovationModel
        The estimate, with the innovations' covariance (degrees of freedom counted).
    d_a, d_b, d_c, d_d, d_k : arrays of shape (..., P)
        Directions of the parameters: the model moves by their sum weighted with the coordinates.
    covariance : (P, P) array
        Asymptotic covariance of these coordinates (inverse information); right for Gaussian white innovations and
        a sufficient order, too small where the residuals are not white.
    offset_x, offset_y : (n,), (n_y,) arrays
        Constants of the state and the output equation: operating point.
    initial_state : (n,) array
        Estimated state at the first row used.
    rows : int
        Rows used.
    parameters : int
        Free parameters, initial state and constants counted.
    log_det : float
        Log determinant of the innovations' covariance, not corrected for degrees of freedom.
    iterations : int
        Accepted steps.
    converged : bool
        Whether the last step promised less than the tolerance.
    condition : float
        Condition number of the information matrix with unit diagonal; 1 where there is no noise.
    noise_free : bool
        Whether the innovations are rounding: then K is arbitrary, and the covariance as good as zero.
    """

    model: InnovationModel
    d_a: FloatArray
    d_b: FloatArray
    d_c: FloatArray
    d_d: FloatArray
    d_k: FloatArray
    covariance: FloatArray
    offset_x: FloatArray
    offset_y: FloatArray
    initial_state: FloatArray
    rows: int
    parameters: int
    log_det: float
    iterations: int
    converged: bool
    condition: float
    noise_free: bool

    @property
    def bic(self) -> float:
        """Bayesian information criterion, rows log det + parameters log rows; the smaller the better.

        The initial state counts in full: a superfluous mode near the unit circle uses it throughout the record.
        """
        return self.rows * self.log_det + self.parameters * float(np.log(self.rows))


def prediction_error(
    start: InnovationModel,
    u: FloatArray,
    y: FloatArray,
    *,
    feedthrough: bool = False,
    offset: bool = True,
    max_iterations: int = 60,
) -> PredictionErrorEstimate:
    """Polish a start by minimising the determinant of the one-step prediction errors' covariance.

    Parameters
    ----------
    start : InnovationModel
        Consistent start; its order and dead time are kept. Its predictor must be stable, the plant need not be.
    u, y : (N, n_u), (N, n_y) arrays
        Command as applied and measurement, equidistant.
    feedthrough : bool
        Estimate D; otherwise D is zero (y is measured before its row's u acts).
    offset : bool
        Estimate a constant where the data ask for one (a gain in -2 log likelihood above log N), so that means and an
        integrator's bias need not be known; a constant that is not there costs precision at low frequency.
    max_iterations : int
        Accepted steps after which the search ends unconverged.

    Returns
    -------
    PredictionErrorEstimate

    Raises
    ------
    IdentificationError
        Fewer rows than parameters, or a start whose predictor is not stable.

    Notes
    -----
    The minimum found is the one in whose valley the start lies. Efficient for Gaussian innovations.
    """
    delay = start.input_delay
    u_past, y_now = np.ascontiguousarray(u[: len(u) - delay]), np.ascontiguousarray(y[delay:])
    if start.predictor_radius >= 1.0:
        raise IdentificationError("the start's predictor is not stable", where="prediction error")
    u_level, y_level = (_level(signal) if offset else np.zeros(signal.shape[1]) for signal in (u_past, y_now))
    u_past, y_now = u_past - u_level, y_now - y_level
    predictor = _initial_predictor(start, feedthrough=feedthrough, n_y=y.shape[1])
    predictor = _with_initial_state(predictor, u_past, y_now)
    search = _search(predictor, u_past, y_now, feedthrough=feedthrough, offset=offset, max_iterations=max_iterations)
    return _estimate(start, search, y_now, u_level, y_level)


def _level(signal: FloatArray) -> FloatArray:
    """Return the operating point (channels,) that a signal moves about, zero where it moves about zero."""
    mean = signal.mean(axis=0)
    return np.where(np.abs(mean) > _OPERATING_POINT * signal.std(axis=0), mean, 0.0)


def _initial_predictor(start: InnovationModel, *, feedthrough: bool, n_y: int) -> Predictor:
    n = start.order
    model = start if feedthrough else replace(start, D=np.zeros_like(start.D))
    return Predictor.of(model, np.zeros(n), np.zeros(n_y), np.zeros(n))


def _with_initial_state(predictor: Predictor, u: FloatArray, y: FloatArray) -> Predictor:
    """Return the predictor with its initial state fitted: the errors are linear in it."""
    n = len(predictor.x0)
    u, y = u[:_LINEAR_ROWS], y[:_LINEAR_ROWS]
    entries = predictor.packed().size
    directions = np.eye(entries, n, n - entries)
    errors = scatter(predictor.F, predictor.H, predictor.x0, u, y)
    nothing = np.zeros((0, predictor.F.shape[1]))
    total = _normal_equations(predictor, directions, u, y, errors, nothing)
    return predictor.moved(_step(total[:-1, :-1], total[:-1, -1], 0.0)[0], directions)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    predictor: Predictor
    directions: FloatArray
    information: FloatArray
    scatter: FloatArray
    iterations: int
    converged: bool

    def noise_free(self, y: FloatArray) -> bool:
        """Return whether the innovations are rounding."""
        return bool(np.all(np.diag(self.scatter) <= len(y) * (_ROUNDING * np.std(y, axis=0)) ** 2))


def _search(
    predictor: Predictor, u: FloatArray, y: FloatArray, *, feedthrough: bool, offset: bool, max_iterations: int
) -> _Search:
    """Search from a predictor, without a constant until, near the end, the score test asks for one."""
    damping, iterations, converged, constant = 0.0, 0, False, False
    errors = scatter(predictor.F, predictor.H, predictor.x0, u, y)
    floor = len(y) * (_NOISE_FREE * np.std(y, axis=0)) ** 2
    n_y = y.shape[1]
    while True:
        renewed = iterations % 5 == 0
        if renewed:
            predictor = _balanced(predictor)
        if renewed or n_y > 1:  # with one output they hold as long as the coordinates do
            directions = behaviour_directions(predictor, feedthrough=feedthrough, offset=offset)
            phi = regressors(predictor)
        if len(y) * n_y <= directions.shape[1]:
            raise IdentificationError(
                f"the record is too short: {len(y)} rows for {directions.shape[1]} parameters",
                mend="record longer, or ask for a lower order",
            )
        total = _normal_equations(predictor, directions, u, y, errors, phi)
        used = directions.shape[1] - (n_y if offset and not constant else 0)
        information, gradient = total[:used, :used], total[:used, -1]
        converged = bool(np.all(np.diag(errors) <= floor))
        if converged or iterations == max_iterations:
            break
        ahead = _improved(predictor, directions[:, :used], information, gradient, errors, u, y, damping)
        if offset and not constant and ahead.promise < _NEAR:
            gain = _step(total[:-1, :-1], total[:-1, -1], 0.0)[1] - ahead.promise
            constant = gain > n_y * math.log(len(y))  # what the Bayesian criterion asks of n_y parameters
            if constant:
                damping = 0.0
                continue
        damping, converged = ahead.damping, ahead.converged
        if ahead.predictor is None:
            break
        predictor, errors, iterations = ahead.predictor, ahead.errors, iterations + 1
    return _Search(
        predictor=predictor,
        directions=directions[:, :used],
        information=information,
        scatter=errors,
        iterations=iterations,
        converged=converged,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Ahead:
    """Where one step leads: a better predictor, or None with the decrease of -2 log likelihood that was promised."""

    predictor: Predictor | None
    errors: FloatArray
    promise: float
    damping: float
    converged: bool


def _improved(
    predictor: Predictor,
    directions: FloatArray,
    information: FloatArray,
    gradient: FloatArray,
    errors: FloatArray,
    u: FloatArray,
    y: FloatArray,
    damping: float,
) -> _Ahead:
    """Return the outcome of one Levenberg-Marquardt step, the damping raised until the step helps."""
    while True:
        step, promise, damping = _step(information, gradient, damping)
        trial = predictor.moved(step, directions)
        radius = _radius(trial)
        if radius > _RADIUS_LIMIT:
            step = _onto_boundary(predictor, directions, information, step)
            promise = -float(step @ (2.0 * gradient + information @ step))
            trial = predictor.moved(step, directions)
            radius = _radius(trial)
        if promise < _TOLERANCE:
            return _Ahead(predictor=None, errors=errors, promise=promise, damping=damping, converged=True)
        if radius <= _RADIUS_LIMIT:
            trial_errors = scatter(trial.F, trial.H, trial.x0, u, y)
            if _log_det(trial_errors) < _log_det(errors):
                return _Ahead(
                    predictor=trial, errors=trial_errors, promise=promise, damping=damping / 10.0, converged=False
                )
        damping *= 10.0
        if damping > 1e3:  # no step helps: the promise is below what rounding or the boundary lets through
            converged = promise < _IMMATERIAL
            return _Ahead(predictor=None, errors=errors, promise=promise, damping=damping, converged=converged)


def _balanced(predictor: Predictor) -> Predictor:
    """Return the predictor in balanced coordinates, in which no direction is badly scaled."""
    n = len(predictor.x0)
    A, B, K, C, _ = predictor.matrices
    T = balancing(A, np.hstack([B, K]), C)
    inverse = np.linalg.inv(T)
    F, H = T @ predictor.F, predictor.H.copy()
    F[:, :n] = F[:, :n] @ inverse
    H[:, :n] = C @ inverse
    return Predictor(F=F, H=H, x0=T @ predictor.x0)


def _normal_equations(
    predictor: Predictor, directions: FloatArray, u: FloatArray, y: FloatArray, errors: FloatArray, phi: FloatArray
) -> FloatArray:
    """Return the whitened normal equations; the directions change F by multiples of the orthogonal rows of phi."""
    n, of_f, P = len(predictor.x0), predictor.F.size, directions.shape[1]
    change = (phi / np.maximum(np.sum(phi**2, axis=1, keepdims=True), np.finfo(np.float64).tiny)) @ directions[
        :of_f
    ].reshape(n, -1, P)
    inner = np.concatenate([change.reshape(-1, P), directions[of_f:]])
    covariance = errors / len(y) + np.finfo(np.float64).tiny * np.eye(len(errors))
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    total: FloatArray = normal_equations(predictor.F, predictor.H, predictor.x0, u, y, phi, inner, whitening)
    return total


def _step(information: FloatArray, gradient: FloatArray, damping: float) -> tuple[FloatArray, float, float]:
    """Return the damped Gauss-Newton step, the decrease of -2 log likelihood an undamped one promises, the damping.

    A damping below the smallest eigenvalue (unit diagonal) does nothing: it is replaced by that eigenvalue for the
    next attempt.
    """
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12 * np.max(np.diag(information))))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    turned = vectors.T @ (gradient / scale)
    kept = values > 1e-13 * values[-1]
    turned = np.where(kept, turned, 0.0)
    safe = np.where(kept, values, 1.0)
    least = float(np.min(safe))
    step = -(vectors @ (turned / (safe + (damping if damping > 0.1 * least else 0.0)))) / scale
    return step, float(np.sum(turned**2 / safe)), max(damping, 0.1 * least)


def _radius(predictor: Predictor) -> float:
    if not np.all(np.isfinite(predictor.F)):
        return float("inf")
    return spectral_radius(predictor.F[:, : len(predictor.x0)])


def _radius_gradient(predictor: Predictor, directions: FloatArray) -> FloatArray:
    """Return the derivative of the predictor's spectral radius along the directions."""
    n = len(predictor.x0)
    values, vectors = np.linalg.eig(predictor.F[:, :n])
    at = int(np.argmax(np.abs(values)))
    change = directions[: predictor.F.size].reshape(*predictor.F.shape, -1)[:, :n]
    left = np.linalg.inv(vectors)[at]
    moved = np.einsum("i,ikp,k->p", left, change, vectors[:, at])
    return np.asarray(np.real(np.conj(values[at]) / abs(values[at]) * moved), dtype=np.float64)


def _onto_boundary(
    predictor: Predictor, directions: FloatArray, information: FloatArray, step: FloatArray
) -> FloatArray:
    """Return the step bent back onto the stability boundary, the nearest way in the metric of the information.

    Zeros of the noise model do lie there: a trend taken out, or an integrating plant with white noise on its sensor.
    """
    for _ in range(3):
        trial = predictor.moved(step, directions)
        excess = _radius(trial) - (_RADIUS_LIMIT - 1e-7)
        if not 0.0 < excess < 1.0:
            break
        outward = _radius_gradient(trial, directions)
        across = np.linalg.lstsq(information, outward, rcond=1e-13)[0]
        step = step - across * excess / max(float(outward @ across), np.finfo(np.float64).tiny)
    return step


def _log_det(errors: FloatArray) -> float:
    if not np.all(np.isfinite(errors)):
        return float("inf")
    return float(np.linalg.slogdet(errors)[1])


def _estimate(
    start: InnovationModel, search: _Search, y: FloatArray, u_level: FloatArray, y_level: FloatArray
) -> PredictionErrorEstimate:
    predictor, rows = search.predictor, len(y)
    n, n_u, n_y = predictor.sizes
    P = search.directions.shape[1]
    d_f, d_h, _ = np.split(search.directions, np.cumsum([predictor.F.size, predictor.H.size]))
    d_f, d_h = d_f.reshape(*predictor.F.shape, P), d_h.reshape(*predictor.H.shape, P)
    A, B, K, C, D = predictor.matrices
    d_k = d_f[:, n + n_u : n + n_u + n_y]
    feedback = np.einsum("iop,or->irp", d_k, predictor.H) + np.einsum("io,orp->irp", K, d_h)  # of K H
    freedom = rows - P / n_y
    noise_free = search.noise_free(y)
    scale = np.sqrt(np.maximum(np.diag(search.information), np.finfo(np.float64).tiny))
    values, vectors = np.linalg.eigh(search.information / np.outer(scale, scale))
    kept = values > 1e-14 * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    model = replace(
        start,
        A=A + K @ C,
        B=B + K @ D,
        C=C,
        D=D,
        K=K,
        innovation_covariance=search.scatter / freedom,
    )
    return PredictionErrorEstimate(
        model=model,
        d_a=d_f[:, :n] + feedback[:, :n],
        d_b=d_f[:, n : n + n_u] + feedback[:, n : n + n_u],
        d_c=d_h[:, :n],
        d_d=d_h[:, n : n + n_u],
        d_k=d_k,
        covariance=inverse * rows / freedom,
        offset_x=predictor.F[:, -1] + K @ predictor.H[:, -1] - model.B @ u_level,
        offset_y=predictor.H[:, -1] + y_level - D @ u_level,
        initial_state=predictor.x0,
        rows=rows,
        parameters=P,
        log_det=_log_det(search.scatter / rows),
        iterations=search.iterations,
        converged=search.converged,
        condition=1.0 if noise_free else float(values[-1] / max(values[0], 1e-300 * values[-1])),
        noise_free=noise_free,
    )
