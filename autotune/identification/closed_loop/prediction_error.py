"""Prediction-error polish of an innovation model: the estimate that reaches the Cramer-Rao bound.

From a consistent start (a subspace estimate) the determinant of the innovations' covariance is minimised over A, B, C,
D, K, the initial state and a constant, by Levenberg-Marquardt steps with the exact gradient. The initial state must be
free: with a controller of high gain at low frequency, residuals wrongly set to zero before the first row ruin the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.predictor_directions import Predictor, behaviour_directions
from autotune.identification.closed_loop.predictor_sweep import innovations, normal_equations, scatter
from autotune.identification.closed_loop.state_space import InnovationModel, balancing, spectral_radius

#: A step that promises less than this in -2 log likelihood moves no parameter by 3 % of its standard deviation.
_TOLERANCE = 1e-3
#: Rows that initial state and constant of the start are fitted on.
_LINEAR_ROWS = 2000
#: A search that cannot move any more has converged if it could have gained less than this.
_IMMATERIAL = 0.1
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
        Estimate a constant, so that means and an integrator's bias need not be known.
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
    predictor = _initial_predictor(start, u_past, y_now, feedthrough=feedthrough, offset=offset)
    search = _search(predictor, u_past, y_now, feedthrough=feedthrough, offset=offset, max_iterations=max_iterations)
    return _estimate(start, search, y_now)


def _initial_predictor(
    start: InnovationModel, u: FloatArray, y: FloatArray, *, feedthrough: bool, offset: bool
) -> Predictor:
    n, n_y = start.order, y.shape[1]
    D = start.D if feedthrough else np.zeros_like(start.D)
    F = np.hstack([start.A, start.B, start.K, np.zeros((n, 1))])
    predictor = Predictor(F=F, H=np.hstack([start.C, D, np.zeros((n_y, 1))]), x0=np.zeros(n))
    return _with_linear_part(predictor, u, y, offset=offset)


def _with_linear_part(predictor: Predictor, u: FloatArray, y: FloatArray, *, offset: bool) -> Predictor:
    """Return the predictor with initial state and output constant fitted: the errors are linear in these."""
    n, n_u, n_y = predictor.sizes
    rows = min(len(y), _LINEAR_ROWS)
    F, H = predictor.F.copy(), predictor.H.copy()
    F[:, -1] = H[:, -1] = 0.0
    none, no_u, no_y = np.zeros(n), np.zeros((rows, n_u)), np.zeros((rows, n_y))
    columns = [innovations(F, H, unit, no_u, no_y).ravel() for unit in np.eye(n)]
    for unit in np.eye(n_y) if offset else ():  # a constant y_0 acts as its negative, measured, does
        columns.append(innovations(F, H, none, no_u, no_y + unit).ravel())
    base = innovations(F, H, none, u[:rows], y[:rows]).ravel()
    solution = np.linalg.lstsq(np.stack(columns, axis=1), -base, rcond=1e-10)[0]
    if offset:
        H[:, -1] = -solution[n:]
    return Predictor(F=F, H=H, x0=solution[:n])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    predictor: Predictor
    directions: FloatArray
    information: FloatArray
    scatter: FloatArray
    iterations: int
    converged: bool


def _search(
    predictor: Predictor, u: FloatArray, y: FloatArray, *, feedthrough: bool, offset: bool, max_iterations: int
) -> _Search:
    damping, iterations, converged = 0.0, 0, False
    errors = scatter(predictor.F, predictor.H, predictor.x0, u, y)
    floor = len(y) * (_NOISE_FREE * np.std(y, axis=0)) ** 2
    while True:
        if iterations in (0, 2) or iterations % 5 == 4:
            predictor = _balanced(predictor)
        directions = behaviour_directions(predictor, feedthrough=feedthrough, offset=offset)
        if len(y) * y.shape[1] <= directions.shape[1]:
            raise IdentificationError(
                f"the record is too short: {len(y)} rows for {directions.shape[1]} parameters",
                mend="record longer, or ask for a lower order",
            )
        total = _normal_equations(predictor, directions, u, y, errors)
        information, gradient = total[:-1, :-1], total[:-1, -1]
        converged = bool(np.all(np.diag(errors) <= floor))
        if converged or iterations == max_iterations:
            break
        accepted = False
        while not accepted:
            step, promise, damping = _step(information, gradient, damping)
            trial = predictor.moved(step, directions)
            if _radius(trial) > _RADIUS_LIMIT:
                step = _onto_boundary(predictor, directions, information, step)
                promise = -float(step @ (2.0 * gradient + information @ step))
                trial = predictor.moved(step, directions)
            if promise < _TOLERANCE:
                converged = True
                break
            trial_errors = _stable_scatter(trial, u, y)
            accepted = _log_det(trial_errors) < _log_det(errors)
            damping = damping / 10.0 if accepted else 10.0 * damping
            if damping > 1e3:  # no step helps: the promise is below what rounding or the boundary lets through
                converged = promise < _IMMATERIAL
                break
        if not accepted:
            break
        predictor, errors, iterations = trial, trial_errors, iterations + 1
    return _Search(
        predictor=predictor,
        directions=directions,
        information=information,
        scatter=errors,
        iterations=iterations,
        converged=converged,
    )


def _balanced(predictor: Predictor) -> Predictor:
    """Return the predictor in balanced coordinates, in which no direction is badly scaled."""
    n, n_u, n_y = predictor.sizes
    F, H = predictor.F, predictor.H
    A, B, K, C, D = F[:, :n], F[:, n : n + n_u], F[:, n + n_u : n + n_u + n_y], H[:, :n], H[:, n : n + n_u]
    T = balancing(InnovationModel(A=A, B=B, C=C, D=D, K=K, innovation_covariance=np.eye(n_y)))
    inverse = np.linalg.inv(T)
    moved = T @ F
    moved[:, :n] = moved[:, :n] @ inverse
    return Predictor(F=moved, H=np.hstack([C @ inverse, H[:, n:]]), x0=T @ predictor.x0)


def _normal_equations(
    predictor: Predictor, directions: FloatArray, u: FloatArray, y: FloatArray, errors: FloatArray
) -> FloatArray:
    P = directions.shape[1]
    at = np.cumsum([predictor.F.size, predictor.H.size])
    dF, dH, dx0 = np.split(directions, at)
    covariance = errors / len(y) + np.finfo(np.float64).tiny * np.eye(len(errors))
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    total: FloatArray = normal_equations(
        predictor.F,
        predictor.H,
        predictor.x0,
        u,
        y,
        np.ascontiguousarray(dF).reshape(*predictor.F.shape, P),
        np.ascontiguousarray(dH).reshape(*predictor.H.shape, P),
        np.ascontiguousarray(dx0),
        whitening,
    )
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
    n, n_u, n_y = predictor.sizes
    if not np.all(np.isfinite(predictor.F)):
        return float("inf")
    return spectral_radius(predictor.F[:, :n] - predictor.F[:, n + n_u : n + n_u + n_y] @ predictor.H[:, :n])


def _radius_gradient(predictor: Predictor, directions: FloatArray) -> FloatArray:
    """Return the derivative of the predictor's spectral radius along the directions."""
    n, n_u, n_y = predictor.sizes
    K, C = predictor.F[:, n + n_u : n + n_u + n_y], predictor.H[:, :n]
    values, vectors = np.linalg.eig(predictor.F[:, :n] - K @ C)
    at = int(np.argmax(np.abs(values)))
    dF, dH, _ = np.split(directions, np.cumsum([predictor.F.size, predictor.H.size]))
    dF, dH = dF.reshape(*predictor.F.shape, -1), dH.reshape(*predictor.H.shape, -1)
    change = (
        dF[:, :n] - np.einsum("iop,ok->ikp", dF[:, n + n_u : n + n_u + n_y], C) - np.einsum("io,okp->ikp", K, dH[:, :n])
    )
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


def _stable_scatter(trial: Predictor, u: FloatArray, y: FloatArray) -> FloatArray:
    n_y = trial.sizes[2]
    if _radius(trial) > _RADIUS_LIMIT:
        return np.full((n_y, n_y), np.inf)
    result: FloatArray = scatter(trial.F, trial.H, trial.x0, u, y)
    return result


def _log_det(errors: FloatArray) -> float:
    if not np.all(np.isfinite(errors)):
        return float("inf")
    return float(np.linalg.slogdet(errors)[1])


def _estimate(start: InnovationModel, search: _Search, y: FloatArray) -> PredictionErrorEstimate:
    predictor, rows = search.predictor, len(y)
    n, n_u, n_y = predictor.sizes
    P = search.directions.shape[1]
    dF, dH, _ = np.split(search.directions, np.cumsum([predictor.F.size, predictor.H.size]))
    dF, dH = dF.reshape(*predictor.F.shape, P), dH.reshape(*predictor.H.shape, P)
    freedom = rows - P / n_y
    noise_free = bool(np.all(np.diag(search.scatter) <= rows * (_ROUNDING * np.std(y, axis=0)) ** 2))
    scale = np.sqrt(np.maximum(np.diag(search.information), np.finfo(np.float64).tiny))
    values, vectors = np.linalg.eigh(search.information / np.outer(scale, scale))
    kept = values > 1e-14 * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    model = replace(
        start,
        A=predictor.F[:, :n],
        B=predictor.F[:, n : n + n_u],
        K=predictor.F[:, n + n_u : n + n_u + n_y],
        C=predictor.H[:, :n],
        D=predictor.H[:, n : n + n_u],
        innovation_covariance=search.scatter / freedom,
    )
    return PredictionErrorEstimate(
        model=model,
        d_a=dF[:, :n],
        d_b=dF[:, n : n + n_u],
        d_k=dF[:, n + n_u : n + n_u + n_y],
        d_c=dH[:, :n],
        d_d=dH[:, n : n + n_u],
        covariance=inverse * rows / freedom,
        offset_x=predictor.F[:, -1],
        offset_y=predictor.H[:, -1],
        initial_state=predictor.x0,
        rows=rows,
        parameters=P,
        log_det=_log_det(search.scatter / rows),
        iterations=search.iterations,
        converged=search.converged,
        condition=1.0 if noise_free else float(values[-1] / max(values[0], 1e-300 * values[-1])),
        noise_free=noise_free,
    )
