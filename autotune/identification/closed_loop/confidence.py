"""From the covariance of a polished model to what people ask for: regions of the frequency response and of the poles.

At the estimate, in coordinates of the behaviour, so that the choice of states drops out: the response to second order,
the poles to first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.distributions import chi2_tail
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.prediction_error import PredictionErrorEstimate
from autotune.identification.closed_loop.predictor_directions import Predictor
from autotune.identification.closed_loop.series import Series
from autotune.points import FrequencyPoint, as_pairs

#: Information matrices worse than this hold directions that the data say nothing about.
_CONDITION_LIMIT = 1e13


def response_covariance(estimate: PredictionErrorEstimate, omega_rad_s: FloatArray) -> FloatArray:
    """Return the covariance of (re, im) of every entry of G(exp(j omega Ts)).

    Parameters
    ----------
    estimate : PredictionErrorEstimate
        Polished model.
    omega_rad_s : (W,) array
        Angular frequencies [rad/s].

    Returns
    -------
    (W, n_y, n_u, 2, 2) array
        Covariances, (output unit per input unit)^2.

    Raises
    ------
    IdentificationError
        The data leave some direction of the model undetermined.

    Notes
    -----
    With G = B(z)/A(z) and alpha the relative error of A(z), the error is dG - alpha dG to second order. The second
    term matters near a pole that is itself uncertain (an integrator seen at low frequency); its mean square, for
    Gaussian parameters, is added alike to both directions.
    """
    _require_information(estimate)
    change = response_gradient(estimate, omega_rad_s)
    resolvent = estimate.model.resolvent(omega_rad_s)
    alpha = -np.einsum("wki,ikp->wp", resolvent, estimate.d_a)[:, None, None]
    P = estimate.covariance
    second = _mean(alpha, alpha, P).real * _mean(change, change, P).real
    second = second + np.abs(_mean(alpha, change, P)) ** 2 + np.abs(_mean(alpha, change.conj(), P)) ** 2
    return np.asarray(_real_covariance(change, P) + 0.5 * second[..., None, None] * np.eye(2), dtype=np.float64)


def response_gradient(estimate: PredictionErrorEstimate, omega_rad_s: FloatArray) -> ComplexArray:
    """Return the sensitivity of every entry of G(exp(j omega Ts)) to the parameters.

    Parameters
    ----------
    estimate : PredictionErrorEstimate
        Polished model, with the derivatives of its matrices by P parameters.
    omega_rad_s : (W,) array
        Angular frequencies [rad/s].

    Returns
    -------
    (W, n_y, n_u, P) complex array
        Derivatives, in output unit per input unit and unit of the parameter.
    """
    model = estimate.model
    resolvent = model.resolvent(omega_rad_s)
    right, left = resolvent @ model.B, model.C @ resolvent
    change = (
        np.einsum("oip,wiu->woup", estimate.d_c, right)
        + np.einsum("woi,ikp,wku->woup", left, estimate.d_a, right, optimize=True)
        + np.einsum("woi,iup->woup", left, estimate.d_b)
    )
    late = np.exp(-1j * np.asarray(omega_rad_s, dtype=np.float64) * model.sample_time_s * model.input_delay)
    return np.asarray(change * late[:, None, None, None], dtype=np.complex128)


def _mean(a: ComplexArray, b: ComplexArray, covariance: FloatArray) -> ComplexArray:
    """Return the mean of a times the conjugate of b, both linear (..., P) in the parameters."""
    return np.asarray(np.einsum("...p,...p->...", a @ covariance, b.conj()), dtype=np.complex128)


def pole_covariance(estimate: PredictionErrorEstimate) -> FloatArray:
    """Return the covariance of (re, im) of each of the model's poles, in their order, shape (n, 2, 2).

    Notes
    -----
    A real pole's imaginary part has zero variance: its region is an interval. First-order: no good where two poles
    nearly coincide.

    Raises
    ------
    IdentificationError
        The data leave some direction of the model undetermined.
    """
    _require_information(estimate)
    values, vectors = np.linalg.eig(estimate.model.A)
    rows = np.linalg.inv(vectors)
    change = np.einsum("ni,ikp,kn->np", rows, estimate.d_a, vectors, optimize=True)
    at = [int(np.argmin(np.abs(values - pole))) for pole in estimate.model.poles]
    return _real_covariance(change[at], estimate.covariance)


def _require_information(estimate: PredictionErrorEstimate) -> None:
    if not estimate.condition < _CONDITION_LIMIT:
        raise IdentificationError(
            f"the data do not determine a model of order {estimate.model.order} "
            f"(condition of the information {estimate.condition:.1e})",
            remedy="ask for a lower --order, or excite the loop with a richer set-point or dither",
        )


def _real_covariance(change: ComplexArray, covariance: FloatArray) -> FloatArray:
    parts = np.stack([change.real, change.imag], axis=-2)
    return np.asarray(parts @ covariance @ np.swapaxes(parts, -1, -2), dtype=np.float64)


def frequency_points(estimate: PredictionErrorEstimate, omega_rad_s: FloatArray) -> tuple[FrequencyPoint, ...]:
    """Return the response of a single-input, single-output estimate as frequency points with their regions.

    Parameters
    ----------
    estimate : PredictionErrorEstimate
        Polished model.
    omega_rad_s : (W,) array
        Angular frequencies [rad/s].
    """
    response = estimate.model.response(omega_rad_s)[:, 0, 0]
    covariance = response_covariance(estimate, omega_rad_s)[:, 0, 0]
    return tuple(
        FrequencyPoint(
            omega_rad_s=float(omega),
            response=complex(value),
            covariance=as_pairs(c),
            source="closed loop",
        )
        for omega, value, c in zip(omega_rad_s, response, covariance, strict=True)
    )


@dataclass(frozen=True, kw_only=True)
class Whiteness:
    """Portmanteau test of the residuals.

    Attributes
    ----------
    probability : float
        Probability of residuals at least as correlated, were the model right.
    lags : int
        Number of lags looked at.
    """

    probability: float
    lags: int


def residuals(
    estimate: PredictionErrorEstimate, u: FloatArray, y: FloatArray, starts: tuple[int, ...] = (0,)
) -> FloatArray:
    """Return the one-step prediction errors of the polished model on the data it came from.

    Parameters
    ----------
    estimate : PredictionErrorEstimate
        Polished model, with its initial states.
    u, y : (N, n_u), (N, n_y) arrays
        The data it came from, in its units.
    starts : tuple of int
        First row of each stretch.

    Returns
    -------
    (rows, n_y) array
        Errors [output unit]; rows that a dead time takes are missing.
    """
    model, states = estimate.model, estimate.initial_states
    predictor = Predictor.of(model, estimate.offset_x, estimate.offset_y, states[0])
    series = Series(u=np.ascontiguousarray(u), y=np.ascontiguousarray(y), starts=starts).delayed(model.input_delay)
    return series.errors(predictor, states)


def whiteness(estimate: PredictionErrorEstimate, errors: FloatArray) -> Whiteness:
    """Return the Ljung-Box test of the residuals' autocorrelation, each output for itself, the worst one counted.

    Parameters
    ----------
    estimate : PredictionErrorEstimate
        Its order is taken off the degrees of freedom.
    errors : (rows, n_y) array
        Its one-step prediction errors.
    """
    rows, n_y = errors.shape
    n = estimate.model.order
    lags = min(max(30, 4 * n), rows // 4)
    worst = 1.0
    for column in range(n_y):
        e = errors[:, column] - errors[:, column].mean()
        power = float(e @ e)
        correlation = np.array([float(e[k:] @ e[:-k]) / power for k in range(1, lags + 1)])
        statistic = rows * (rows + 2) * float(np.sum(correlation**2 / (rows - np.arange(1, lags + 1))))
        worst = min(worst, chi2_tail(statistic, max(lags - n, 1)))
    return Whiteness(probability=min(1.0, n_y * worst) if math.isfinite(worst) else 0.0, lags=lags)
