"""One damped Gauss-Newton (Levenberg-Marquardt) step of a predictor, kept inside the stability boundary."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.identification.closed_loop.predictor_directions import Predictor
from autotune.identification.closed_loop.series import Series
from autotune.identification.closed_loop.state_space import spectral_radius

#: A step predicted to lower -2 log likelihood by less than this moves no parameter by 3 % of its standard deviation.
_TOLERANCE = 1e-3
#: A search that cannot move any more has converged if it could have gained less than this.
_IMMATERIAL = 0.1
#: Zeros of the noise model nearer to the unit circle than this have no finite memory worth the name.
_RADIUS_LIMIT = 0.9999


@dataclass(frozen=True, kw_only=True, eq=False)
class Ahead:
    """Where one step leads: a better predictor, or None with the decrease of -2 log likelihood that was predicted."""

    predictor: Predictor | None
    errors: FloatArray
    predicted: float
    damping: float
    converged: bool


def improve(
    predictor: Predictor,
    directions: FloatArray,
    information: FloatArray,
    gradient: FloatArray,
    errors: FloatArray,
    series: Series,
    damping: float,
) -> Ahead:
    """Return the outcome of one Levenberg-Marquardt step, the damping raised until the step helps.

    A search has converged where an undamped step is predicted to gain less than the tolerance, or where the boundary
    is in the way and no step gains more.

    Parameters
    ----------
    predictor : Predictor
        Where the search stands.
    directions : (entries, P) array
        What the parameters change.
    information : (P, P) array
        Half of the second derivative of -2 log likelihood, by Gauss and Newton.
    gradient : (P,) array
        Half of the derivative of -2 log likelihood.
    errors : (n_y, n_y) array
        Sum of e e^T there.
    series : Series
        The data.
    damping : float
        To begin with, on a unit diagonal.
    """
    bounded = False
    while True:
        step, predicted, damping = damped_step(information, gradient, damping)
        trial = predictor.move_along(step, directions)
        beyond = _radius(trial) > _RADIUS_LIMIT
        bounded = bounded or beyond
        if beyond:
            step = _onto_boundary(predictor, directions, information, step)
            predicted = -float(step @ (2.0 * gradient + information @ step))
            trial = predictor.move_along(step, directions)
        if predicted < _TOLERANCE and not beyond:
            return Ahead(predictor=None, errors=errors, predicted=predicted, damping=damping, converged=True)
        if predicted >= _TOLERANCE and _radius(trial) <= _RADIUS_LIMIT:
            trial_errors = series.scatter(trial)
            gain = len(series) * (log_determinant(errors) - log_determinant(trial_errors))
            if gain > _TOLERANCE:
                return Ahead(
                    predictor=trial, errors=trial_errors, predicted=predicted, damping=damping / 10.0, converged=False
                )
        damping *= 10.0
        if damping > 1e3:  # no step helps: rounding, or the best model on the boundary
            converged = bounded or predicted < _IMMATERIAL
            return Ahead(predictor=None, errors=errors, predicted=predicted, damping=damping, converged=converged)


def whitened_equations(
    predictor: Predictor, directions: FloatArray, series: Series, errors: FloatArray, phi: FloatArray
) -> FloatArray:
    """Return the whitened normal equations.

    Parameters
    ----------
    predictor : Predictor
        Where the search stands.
    directions : (entries, P) array
        What the parameters change.
    series : Series
        The data.
    errors : (n_y, n_y) array
        Sum of e e^T there.
    phi : (K, columns of F) array
        Orthogonal rows of which the directions change F by multiples.
    """
    n, of_f, P = len(predictor.x0), predictor.F.size, directions.shape[1]
    change = (phi / np.maximum(np.sum(phi**2, axis=1, keepdims=True), np.finfo(np.float64).tiny)) @ directions[
        :of_f
    ].reshape(n, -1, P)
    inner = np.concatenate([change.reshape(-1, P), directions[of_f:]])
    covariance = errors / len(series) + np.finfo(np.float64).tiny * np.eye(len(errors))
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    return series.normal_equations(predictor, phi, inner, directions, whitening)


def damped_step(information: FloatArray, gradient: FloatArray, damping: float) -> tuple[FloatArray, float, float]:
    """Return the damped Gauss-Newton step, the decrease of -2 log likelihood of an undamped one, the damping.

    A damping below the smallest eigenvalue (unit diagonal) does nothing: it is replaced by that eigenvalue for the
    next attempt.

    Parameters
    ----------
    information : (P, P) array
        Normal matrix.
    gradient : (P,) array
        The step without damping is -information^-1 gradient.
    damping : float
        Added to the unit diagonal.

    Returns
    -------
    tuple
        The (P,) step, the decrease, and the damping.
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
    """Return the step brought back onto the stability boundary, the nearest way in the metric of the information.

    Zeros of the noise model do lie there: a trend taken out, or an integrating plant with white noise on its sensor.
    """
    for _ in range(3):
        trial = predictor.move_along(step, directions)
        excess = _radius(trial) - (_RADIUS_LIMIT - 1e-7)
        if not 0.0 < excess < 1.0:
            break
        outward = _radius_gradient(trial, directions)
        across = np.linalg.lstsq(information, outward, rcond=1e-13)[0]
        step = step - across * excess / max(float(outward @ across), np.finfo(np.float64).tiny)
    return step


def log_determinant(errors: FloatArray) -> float:
    """Return the log determinant of a scatter matrix, infinite where it is not finite."""
    if not np.all(np.isfinite(errors)):
        return float("inf")
    return float(np.linalg.slogdet(errors)[1])
