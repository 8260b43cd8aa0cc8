"""A transfer function through frequency points: what the predictions are simulated with.

The reduced models of the design are conservative on purpose and predict no response; here the same points are fitted
by b exp(-L s) / (s^p (tau_1 s + 1) ... (tau_k s + 1)), weighted with their covariance, and the simplest structure
that the points do not contradict is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement, product
from typing import Literal

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from autotune.arrays import ComplexArray, FloatArray, principal_axes
from autotune.distributions import chi2_tail
from autotune.errors import IdentificationError
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint

#: lags in the structures that are tried, beside the integrator and the dead time
_MAX_LAGS = 2
#: points that a fit of the plant takes at least
LEAST_POINTS = 3
#: a structure whose Bayesian criterion is higher than the best one's by more is excluded by the data: odds of 20 to 1
EXCLUDED = 2.0 * math.log(20.0)
#: what a standard deviation may raise the sum of squares by where 1 is its rise to first order, and how often the
#: factor that shortens it to that is halved
_MOST_RISE, _HALVINGS = 2.0, 30
#: share of the largest singular value below which another is rounding
_TOLD = 1e-10
#: directions besides the principal ones in which the border of a parameter region is visited
_DIRECTIONS = 48


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
        log|b|, log(tau_1), ..., log(tau_k), L [s]; of a fit in time a_0, ..., a_(n-1), b, L of a differential equation.
    covariance : (P, P) array
        Covariance of ``parameters``, multiplied by chi^2 per degree of freedom where that exceeds 1.
    sign : int
        Sign of b.
    chi_square : float
        Weighted sum of squared residuals.
    degrees_of_freedom : int
        Number of real residuals less the number of parameters.
    bounds : (2, P) array
        Between which the parameters were searched; the region ends there.
    build : callable
        From (P,) parameters to the plant.
    criterion : float
        Bayesian information criterion, comparable between fits of the same data.
    others : tuple of PlantFit
        Structures that the same data do not exclude.
    source : {"points", "recording"}
        What was fitted.
    largest_residual : float
        Largest distance of a point from the plant, relative to its gain; 0 of a fit in time.
    shared_errors : float
        What the covariances of points that this plant gave are multiplied by where their errors count as independent.
    """

    plant: TransferFunction
    integrating: bool
    parameters: FloatArray
    covariance: FloatArray
    sign: int
    chi_square: float
    degrees_of_freedom: int
    bounds: FloatArray
    build: Callable[[FloatArray], TransferFunction] = field(repr=False)
    criterion: float = 0.0
    others: tuple[PlantFit, ...] = ()
    source: Literal["points", "recording"] = "points"
    largest_residual: float = 0.0
    shared_errors: float = 1.0

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square if the structure is right; 1 without degrees of freedom."""
        return chi2_tail(self.chi_square, self.degrees_of_freedom) if self.degrees_of_freedom else 1.0

    def draws(self, count: int, rng: np.random.Generator) -> tuple[TransferFunction, ...]:
        """Return plants drawn from the parameters' normal distribution, cut at the bounds of the search.

        Parameters
        ----------
        count : int
            How many.
        rng : numpy.random.Generator
            Source of the draws.
        """
        steps = rng.standard_normal((count, self.parameters.size)) @ principal_axes(self.covariance).T
        samples = self.parameters + steps
        return tuple(self.build(self._within(sample)) for sample in samples)

    def _within(self, sample: FloatArray) -> FloatArray:
        """Return a sample of the parameters, cut at the bounds of the search.

        Above them the whole way from the estimate is shortened, as what the data leave open (a gain and the slowest
        lag) moves together; below, where a lag or a dead time vanishes, each parameter ends by itself.
        """
        lower, upper = self.bounds
        step = sample - self.parameters
        share = min(
            (room / way for room, way in zip(upper - self.parameters, step, strict=True) if way > 0.0), default=1.0
        )
        return np.asarray(np.maximum(self.parameters + min(max(share, 0.0), 1.0) * step, lower), dtype=np.float64)

    def border(self, distance: float) -> tuple[TransferFunction, ...]:
        """Return plants so far from the estimate, and from that of the other structures likewise.

        Parameters
        ----------
        distance : float
            In standard deviations (Mahalanobis), which is that of the nearest plant at which something happens that is
            linear in the parameters.

        Notes
        -----
        Both ends of every principal axis, and directions between them; what depends linearly on the parameters has its
        extremes within a few per cent of the region's among them.
        """
        if not self.covariance.any():
            return (self.plant,)
        axes = principal_axes(self.covariance)
        between = np.random.default_rng(0).standard_normal((_DIRECTIONS, self.parameters.size))
        between /= np.linalg.norm(between, axis=1, keepdims=True)
        directions = np.vstack((np.eye(self.parameters.size), -np.eye(self.parameters.size), between, -between))
        samples = self.parameters + distance * directions @ axes.T
        members = [self.build(self._within(sample)) for sample in samples]
        return (*members, *(plant for fit in self.others for plant in (fit.plant, *fit.border(distance))))


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
    if len(points) < LEAST_POINTS:
        there_is = {0: "there is none", 1: "there is one"}.get(len(points), "there are two")
        raise IdentificationError(
            f"a plant takes at least three frequency points, and {there_is}",
            where="fit of the plant",
            remedy="move the command up and down, slowly and fast, while it is recorded; or let a relay measure points"
            " (autotune run)",
        )
    return not_excluded(fit_structures(points))


def fit_structures(points: Sequence[FrequencyPoint]) -> list[PlantFit]:
    """Return every structure that so many points can determine, fitted to them; parameters as of :func:`fit_plant`."""
    ordered = sorted(points, key=lambda point: point.omega_rad_s)
    omega = np.array([point.omega_rad_s for point in ordered])
    measured = np.array([point.response for point in ordered])
    whitener = np.array([_whitener(point) for point in ordered])
    return [
        _fit_structure(omega, measured, whitener, integrating, lags)
        for integrating, lags in product((False, True), range(_MAX_LAGS + 1))
        if (integrating or lags) and 2 * len(points) >= lags + 2
    ]


def not_excluded(fits: Sequence[PlantFit]) -> PlantFit:
    """Return the fit with the smallest criterion, with the others that the data do not exclude beside it."""
    best = min(fits, key=lambda fit: fit.criterion)
    return replace(
        best, others=tuple(fit for fit in fits if fit is not best and fit.criterion - best.criterion < EXCLUDED)
    )


def _whitener(point: FrequencyPoint) -> FloatArray:
    """Return W with W cov W^T = I; a floor of 1e-6 of the gain keeps noise-free points finite."""
    covariance = np.array(point.covariance) + np.eye(2) * (1e-6 * point.gain) ** 2
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)


#: of a plant drawn from data that leave the gain open: the arithmetic that follows holds its square
_LARGEST_LOG_GAIN = math.log(1e100)


def _plant(parameters: FloatArray, sign: int, integrating: bool) -> TransferFunction:
    den = np.array([1.0, 0.0]) if integrating else np.array([1.0])
    for log_tau in parameters[1:-1]:
        den = np.polymul(den, [math.exp(log_tau), 1.0])
    return TransferFunction(
        num=(sign * math.exp(min(parameters[0], _LARGEST_LOG_GAIN)),),
        den=tuple(den),
        delay_s=max(0.0, float(parameters[-1])),
    )


def _fit_structure(
    omega: FloatArray, measured: ComplexArray, whitener: FloatArray, integrating: bool, lags: int
) -> PlantFit:
    """Weighted least squares from several starts, with the exact derivatives of the response."""
    lower = np.array([-np.inf, *[math.log(1e-3 / omega[-1])] * lags, 0.0])
    upper = np.array([np.inf, *[math.log(1e3 / omega[0])] * lags, 2 * np.pi / omega[0]])
    starts = [(sign, ratios) for sign in (1, -1) for ratios in combinations_with_replacement((0.3, 3.0), lags)]
    fits = ((s, _fit_from(r, s, omega, measured, whitener, integrating, (lower, upper))) for s, r in starts)
    sign, found = min(fits, key=lambda pair: float(pair[1].cost))
    chi_square, freedom = 2 * float(found.cost), 2 * omega.size - found.x.size
    excess = max(1.0, chi_square / freedom) if freedom > 0 else 1.0

    def rise(step: FloatArray) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            error = _whiten(_response(omega, found.x + step, sign, integrating) - measured, whitener)
            return float(error @ error) - chi_square

    axes = _as_far_as_it_rises(found.jac, rise)
    covariance = excess * axes @ axes.T

    def build(x: FloatArray) -> TransferFunction:
        return _plant(x, sign, integrating)

    return PlantFit(
        plant=build(found.x),
        integrating=integrating,
        parameters=np.asarray(found.x, dtype=np.float64),
        covariance=np.asarray(covariance, dtype=np.float64),
        sign=sign,
        chi_square=chi_square,
        degrees_of_freedom=max(freedom, 0),
        bounds=np.stack((lower, upper)),
        build=build,
        criterion=chi_square + found.x.size * math.log(2 * omega.size),
        largest_residual=float(np.max(np.abs(_response(omega, found.x, sign, integrating) / measured - 1.0))),
    )


def _fit_from(
    ratios: Sequence[float],
    sign: int,
    omega: FloatArray,
    measured: ComplexArray,
    whitener: FloatArray,
    integrating: bool,
    bounds: tuple[FloatArray, FloatArray],
) -> OptimizeResult:
    """Fit one structure from lags that are these ratios of the middle period."""
    middle, s = float(np.exp(np.mean(np.log(omega)))), 1j * omega
    start = np.array([0.0, *(math.log(ratio / middle) for ratio in ratios), 0.1 / middle])
    start[0] = float(np.mean(np.log(np.abs(measured / _response(omega, start, sign, integrating)))))

    def residuals(x: FloatArray) -> FloatArray:
        return _whiten(_response(omega, x, sign, integrating) - measured, whitener)

    def jacobian(x: FloatArray) -> FloatArray:
        tau = np.exp(x[1:-1])[:, np.newaxis]
        derivatives = np.vstack([np.ones((1, omega.size)), -s * tau / (1 + s * tau), -s[np.newaxis]])
        return _whiten(derivatives * _response(omega, x, sign, integrating), whitener).T

    start = np.clip(start, bounds[0] + 1e-9, bounds[1] - 1e-9)
    return least_squares(residuals, start, jac=jacobian, bounds=bounds, x_scale="jac", max_nfev=60)


def _whiten(values: ComplexArray, whitener: FloatArray) -> FloatArray:
    parts = np.stack([values.real, values.imag], axis=-1)
    return np.asarray(np.einsum("nij,...nj->...ni", whitener, parts)).reshape(*values.shape[:-1], -1)


def _as_far_as_it_rises(jacobian: FloatArray, rise: Callable[[FloatArray], float]) -> FloatArray:
    """Return the principal axes of the covariance, (P, P), no longer than the sum of squares says.

    Two equal lags have one derivative: to first order nothing is known of their difference, and the sum of squares,
    which rises by 1 over a standard deviation, rises by far more. Where it does so to one side only, the axis stays.
    What rounding makes of such an axis's length does not count, as it ends where the sum has risen by so much.
    """
    sizes = np.linalg.norm(jacobian, axis=0)
    felt = sizes > 0.0
    _, values, vectors = np.linalg.svd(jacobian[:, felt] / sizes[felt], full_matrices=False)
    axes = np.zeros((sizes.size, values.size))
    axes[felt] = vectors.T / np.maximum(values, _TOLD * values[0]) / sizes[felt, None]

    def rises_too_far(axis: FloatArray) -> bool:
        return not min(rise(axis), rise(-axis)) <= _MOST_RISE

    for axis in axes.T:
        if not rises_too_far(axis):
            continue
        low = 0.0  # logarithm of what the axis is shortened by, between bounds of which one is short enough
        while rises_too_far(axis * math.exp(low)):
            low -= 2.0
        high = low + 2.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if rises_too_far(axis * math.exp(middle)) else (middle, high)
        axis *= math.exp(low)
    return axes


def _response(omega: FloatArray, parameters: FloatArray, sign: int, integrating: bool) -> ComplexArray:
    s = 1j * omega
    lags = np.prod(1 + s * np.exp(parameters[1:-1])[:, np.newaxis], axis=0)
    poles = lags * s if integrating else lags
    return np.asarray(sign * np.exp(parameters[0] - s * parameters[-1]) / poles, dtype=np.complex128)
