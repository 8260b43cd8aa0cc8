"""A transfer function through frequency points: what the predictions are simulated with.

The reduced models of the design are conservative on purpose and predict no response; here the same points are fitted
by b exp(-L s) / (s^p (tau_1 s + 1) ... (tau_k s + 1)), weighted with their covariance, and the simplest structure
that the points do not contradict is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, product

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import chi2

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import IdentificationError
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint

#: lags in the structures that are tried, beside the integrator and the dead time
_MAX_LAGS = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class PlantFit:
    """A fitted structure with the uncertainty of its parameters.

    Attributes
    ----------
    plant : TransferFunction
        The estimate.
    integrating : bool
        Whether it has a pole at s = 0.
    parameters : (P,) array
        log|b|, log(tau_1), ..., log(tau_k), L [s].
    covariance : (P, P) array
        Covariance of ``parameters``, multiplied by chi^2 per degree of freedom where that exceeds 1.
    sign : int
        Sign of b.
    chi_square : float
        Weighted sum of squared residuals.
    degrees_of_freedom : int
        Number of real residuals less the number of parameters.
    """

    plant: TransferFunction
    integrating: bool
    parameters: FloatArray
    covariance: FloatArray
    sign: int
    chi_square: float
    degrees_of_freedom: int

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square if the structure is right; 1 without degrees of freedom."""
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom)) if self.degrees_of_freedom else 1.0

    def draws(self, count: int, rng: np.random.Generator) -> tuple[TransferFunction, ...]:
        """Return plants drawn from the parameters' normal distribution."""
        samples = rng.multivariate_normal(self.parameters, self.covariance, count, method="eigh")
        return tuple(_plant(sample, self.sign, self.integrating) for sample in samples)


def fit_plant(points: Sequence[FrequencyPoint]) -> PlantFit:
    """Fit the simplest structure that the points do not contradict.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least three, at different frequencies.

    Returns
    -------
    PlantFit
        The structure with the smallest Bayesian information criterion.

    Raises
    ------
    IdentificationError
        Fewer than three points.

    Notes
    -----
    The structure holds between and near the points; far outside them it is an extrapolation. It has no resonance and
    no zeros.
    """
    if len(points) < 3:
        raise IdentificationError(
            f"{len(points)} frequency point(s)", where="fit of the plant", remedy="measure at least three frequencies"
        )
    ordered = sorted(points, key=lambda point: point.omega_rad_s)
    omega = np.array([point.omega_rad_s for point in ordered])
    measured = np.array([point.response for point in ordered])
    whitener = np.array([_whitener(point) for point in ordered])
    fits = [
        fit
        for integrating, lags in product((False, True), range(_MAX_LAGS + 1))
        if (integrating or lags) and 2 * len(points) >= lags + 2
        for fit in [_fit_structure(omega, measured, whitener, integrating, lags)]
    ]
    return min(fits, key=lambda fit: fit.chi_square + fit.parameters.size * math.log(2 * len(points)))


def _whitener(point: FrequencyPoint) -> FloatArray:
    """Return W with W cov W^T = I; a floor of 1e-6 of the gain keeps noise-free points finite."""
    covariance = np.array(point.covariance) + np.eye(2) * (1e-6 * point.gain) ** 2
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)


def _plant(parameters: FloatArray, sign: int, integrating: bool) -> TransferFunction:
    den = np.array([1.0, 0.0]) if integrating else np.array([1.0])
    for log_tau in parameters[1:-1]:
        den = np.polymul(den, [math.exp(log_tau), 1.0])
    return TransferFunction(
        num=(sign * math.exp(parameters[0]),), den=tuple(den), delay_s=max(0.0, float(parameters[-1]))
    )


def _fit_structure(
    omega: FloatArray, measured: ComplexArray, whitener: FloatArray, integrating: bool, lags: int
) -> PlantFit:
    """Weighted least squares from several starts, with the exact derivatives of the response."""
    middle = float(np.exp(np.mean(np.log(omega))))

    def whitened(values: ComplexArray) -> FloatArray:
        parts = np.stack([values.real, values.imag], axis=-1)
        return np.asarray(np.einsum("nij,...nj->...ni", whitener, parts)).reshape(*values.shape[:-1], -1)

    def jacobian(parameters: FloatArray, sign: int) -> FloatArray:
        s = 1j * omega
        tau = np.exp(parameters[1:-1])[:, np.newaxis]
        derivatives = np.vstack([np.ones((1, omega.size)), -s * tau / (1 + s * tau), -s[np.newaxis]])
        return whitened(derivatives * _response(omega, parameters, sign, integrating)).T

    def fit(sign: int, ratios: Sequence[float]) -> OptimizeResult:
        start = np.array([0.0, *(math.log(ratio / middle) for ratio in ratios), 0.1 / middle])
        start[0] = float(np.mean(np.log(np.abs(measured / _response(omega, start, sign, integrating)))))
        lower = np.array([-np.inf, *[math.log(1e-3 / omega[-1])] * lags, 0.0])
        upper = np.array([np.inf, *[math.log(1e3 / omega[0])] * lags, 2 * np.pi / omega[0]])

        def residuals(x: FloatArray) -> FloatArray:
            return whitened(_response(omega, x, sign, integrating) - measured)

        def derivatives(x: FloatArray) -> FloatArray:
            return jacobian(x, sign)

        return least_squares(
            residuals,
            np.clip(start, lower + 1e-9, upper - 1e-9),
            jac=derivatives,
            bounds=(lower, upper),
            x_scale="jac",
            max_nfev=60,
        )

    starts = [(sign, ratios) for sign in (1, -1) for ratios in combinations_with_replacement((0.3, 3.0), lags)]
    sign, found = min(((sign, fit(sign, ratios)) for sign, ratios in starts), key=lambda pair: float(pair[1].cost))
    chi_square = 2 * float(found.cost)
    freedom = 2 * omega.size - found.x.size
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * (max(1.0, chi_square / freedom) if freedom > 0 else 1.0)
    return PlantFit(
        plant=_plant(found.x, sign, integrating),
        integrating=integrating,
        parameters=np.asarray(found.x, dtype=np.float64),
        covariance=np.asarray(covariance, dtype=np.float64),
        sign=sign,
        chi_square=chi_square,
        degrees_of_freedom=max(freedom, 0),
    )


def _response(omega: FloatArray, parameters: FloatArray, sign: int, integrating: bool) -> ComplexArray:
    s = 1j * omega
    lags = np.prod(1 + s * np.exp(parameters[1:-1])[:, np.newaxis], axis=0)
    poles = lags * s if integrating else lags
    return np.asarray(sign * np.exp(parameters[0] - s * parameters[-1]) / poles, dtype=np.complex128)
