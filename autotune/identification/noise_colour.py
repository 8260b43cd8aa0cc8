"""Colour of the noise behind a fit's residual, by restricted likelihood: a load's and an autoregression's.

A fit takes noise along, most of it where its own sensitivities lie, which for a plant is near frequency zero. A colour
that is read off the residual alone lacks that noise, and intervals that rest on it are too narrow. The restricted
likelihood is that of what the fit leaves, whatever the parameters are: the residual's products plus what the fit took.
What an estimated colour leaves open beyond that is counted in degrees of freedom.

References
----------
Patterson, Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58, 1971.
Cheang, Reinsel, Bias reduction of autoregressive estimates in time series regression model through restricted maximum
likelihood, JASA 95, 2000.
Giesbrecht, Burns, Two-stage analysis based on a mixed model, Biometrics 41, 1985 (degrees of freedom).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from scipy.optimize import minimize
from scipy.special import fdtri, ndtri, stdtrit

from autotune.arrays import FloatArray
from autotune.distributions import chi2_quantile
from autotune.identification.noise_filter import WHITE, Whitening

MAX_AR = 12
#: Step of a difference quotient in a parameter, which is known to some 1/sqrt(rows).
_DIFFERENCE = 1e-3
#: Share of products below which they are rounding, as those of exact data are.
_EXACT = 1e-12
#: Columns of a fit less independent than this repeat others.
_INDEPENDENT = 1e-10
#: Least degrees of freedom: a logarithm of a variance that is known to no factor of e is not to be linearised.
_LEAST_FREEDOM = 2.0
#: Partial correlation beyond which the recursion back to them would divide by rounding.
_STATIONARY = 0.9999


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseColour:
    """Noise that a filter makes white.

    Attributes
    ----------
    whitening : Whitening
        The filter.
    variance : float
        Of the innovation.
    freedom : (P,) array
        Degrees of freedom of the variance of each parameter of the fit.
    """

    whitening: Whitening
    variance: float
    freedom: FloatArray

    def variance_at(self, omega: FloatArray) -> FloatArray:
        """Return the variance of white noise with the same spectral density at frequencies (F,) [rad/row]."""
        back = np.exp(-1j * omega)
        ar, ma = (np.polyval([*one[::-1], 1.0], back) for one in (self.whitening.ar, self.whitening.ma))
        return np.asarray(self.variance * np.abs(ma / ar) ** 2, dtype=np.float64)

    def widening(self) -> FloatArray:
        """Return, for each parameter, by how much 1.96 standard deviations fall short of Student's 95 % interval."""
        return np.asarray(stdtrit(self.freedom, 0.975) / ndtri(0.975), dtype=np.float64)


@lru_cache
def region_widening(freedom: float) -> float:
    """Return the factor on a plane's covariance with which its 95 % region of known variance is that of Hotelling."""
    return 2.0 * float(fdtri(2, freedom, 0.95)) / chi2_quantile(0.95, 2)


def whitening_filter(residual: FloatArray, max_order: int = MAX_AR) -> FloatArray:
    """Return the autoregressive filter that makes a residual white, its order by the Bayes information criterion.

    Parameters
    ----------
    residual : (N,) array
        Residual, row by row.
    max_order : int
        Largest order tried.

    Returns
    -------
    (p,) array
        c_1..c_p of 1 + c_1 q^-1 + ..; empty where the residual is white.

    Notes
    -----
    Rows are taken as equidistant; with jittered stamps the noise model is an approximation, the plant's is not.
    """
    N = residual.size
    max_order = min(max_order, N // 20)
    r = _autocovariances(residual, max_order)
    best, filter_best = N * np.log(r[0]), np.empty(0)
    c, variance = np.empty(0), float(r[0])
    for order, product in enumerate(np.asarray_chkfinite(r[1:]), 1):  # each order from the last (Levinson, Durbin)
        partial = -(product + c @ r[order - 1 : 0 : -1]) / variance
        c = np.append(c + partial * c[::-1], partial)
        variance *= 1.0 - partial * partial
        if variance <= 0:
            break
        criterion = N * math.log(variance) + order * math.log(N)
        if criterion < best:
            best, filter_best = criterion, c
    return np.asarray(filter_best, dtype=np.float64)


@njit(cache=True)
def _autocovariances(values: FloatArray, lags: int) -> FloatArray:
    """Return the sums of products at lags 0..lags, divided by the number of rows, shape (lags + 1,)."""
    result = np.zeros(lags + 1)
    for lag in range(lags + 1):
        total = 0.0
        for k in range(lag, values.size):
            total += values[k] * values[k - lag]
        result[lag] = total / values.size
    return result


def _likeliest(
    columns: FloatArray, residual: FloatArray, loads: Sequence[Whitening], max_order: int
) -> tuple[Whitening, FloatArray]:
    """Return the load's filter of the largest restricted likelihood, and the autoregression of what it leaves.

    A load has no threshold to pass: its variance is estimated, as that of any noise is, and may be none.
    """
    signals = np.column_stack([columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), residual])
    order = min(max_order, residual.size // 20)
    best: tuple[float, Whitening, FloatArray] = (math.inf, WHITE, np.empty(0))
    for load in loads:
        of_load = load.filtered(signals)
        if not np.all(np.isfinite(of_load)):
            continue
        ar = whitening_filter(of_load[:, -1].copy(), max_order)
        white = Whitening(ar=ar).filtered(of_load)[order:]
        gram = white.T @ white
        of_columns, across = gram[:-1, :-1], gram[:-1, -1]
        of_columns[np.diag_indices_from(of_columns)] += _EXACT * np.trace(of_columns)
        left = max(float(gram[-1, -1] - across @ np.linalg.solve(of_columns, across)), _EXACT * float(gram[-1, -1]))
        rows = len(white)
        cost = (rows - len(of_columns)) * math.log(max(left, 1e-300)) + float(np.linalg.slogdet(of_columns)[1])
        cost += ar.size * math.log(rows)
        if cost < best[0]:
            best = cost, load, ar
    return best[1], best[2]


def noise_colour(
    columns: FloatArray, residual: FloatArray, max_order: int = MAX_AR, loads: Sequence[Whitening] = (WHITE,)
) -> NoiseColour:
    """Return the colour of the noise behind a least-squares fit.

    Parameters
    ----------
    columns : (N, P) array
        The fit's sensitivities, row by row.
    residual : (N,) array
        What it left.
    max_order : int
        Largest order of the autoregression that is tried; 0 where there is none.
    loads : sequence of Whitening
        Filters for loads, of which one is taken, and the autoregression is that of what it leaves.

    Returns
    -------
    NoiseColour
        Of the order that the residual asks for.
    """
    if len(loads) > 1:
        load, start = _likeliest(columns, residual, loads, max_order)
        columns, residual = load.filtered(columns), load.filtered(residual[:, None])[:, 0]
    else:
        load, start = loads[0], whitening_filter(residual, max_order)
    likelihood = _Restricted.of(columns, residual, start.size)
    partial = likelihood.parameters(_partial_correlations(start))
    if start.size:
        scale = np.diag(likelihood.variances(partial))
        partial = minimize(likelihood.cost_and_slope, partial, jac=True, method="BFGS", options={"hess_inv0": scale}).x
    ar = _filter_and_slopes(likelihood.correlations(partial))[0]
    return NoiseColour(
        whitening=Whitening(ar=np.convolve(ar, [1.0, *load.ar])[1:], ma=load.ma),
        variance=likelihood.variance(partial) * float(residual @ residual),
        freedom=likelihood.freedom(partial),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Restricted:
    """Restricted likelihood of stationary autoregressive noise, as a function of its partial correlations.

    Each is the hyperbolic tangent of a parameter, times the largest: all that the search tries is stationary.

    Attributes
    ----------
    rows : int
        Number N of rows.
    products : (p + 1, p + 1, R + 1, R + 1) array
        Sums over t of x(t + i) x(t + j)^T for t = 0..N-1-i-j, x the orthonormal columns and the residual: the exact sum
        of squares of stationary noise is quadratic in c with these (Box & Jenkins, Time Series Analysis, A7.4).
    to_parameters : (P, R) array
        From coordinates of the orthonormal columns.
    """

    rows: int
    products: FloatArray
    to_parameters: FloatArray

    @classmethod
    def of(cls, columns: FloatArray, residual: FloatArray, order: int) -> _Restricted:
        size = np.linalg.norm(columns, axis=0)
        size[size == 0.0] = 1.0
        U, sizes, Vh = np.linalg.svd(columns / size, full_matrices=False)
        kept = sizes > _INDEPENDENT * sizes[0]
        signals = np.column_stack([U[:, kept], residual / max(float(np.linalg.norm(residual)), 1e-300)])
        return cls(
            rows=residual.size,
            products=_products(signals, order),
            to_parameters=(Vh[kept].T / sizes[kept]) / size[:, None],
        )

    @property
    def _most(self) -> float:
        """Largest partial correlation: what lasts longer than the rows is told from a constant by none of them."""
        return 1.0 - 1.0 / self.rows

    def correlations(self, free: FloatArray) -> FloatArray:
        """Return partial correlations (p,) from parameters of any size."""
        return self._most * np.tanh(free)

    def parameters(self, correlations: FloatArray) -> FloatArray:
        """Return the parameters (p,) of partial correlations; the largest have no finite ones, and come near."""
        return np.arctanh(np.clip(correlations / self._most, -self._most, self._most))

    def slopes(self, correlations: FloatArray) -> FloatArray:
        """Return the derivative of each partial correlation with respect to its parameter, (p,)."""
        return (self._most**2 - correlations**2) / self._most

    def variances(self, partial: FloatArray) -> FloatArray:
        """Return roughly the variances of the parameters: that of a partial correlation k is (1 - k^2) / rows."""
        kappa = self.correlations(partial)
        return (1.0 - kappa**2) / (self.rows * self.slopes(kappa) ** 2)

    def gram(self, partial: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return products of whitened signals (R+1, R+1), their slopes along c (p, R+1, R+1), and dc/dkappa (p, p)."""
        colour, along = _filter_and_slopes(self.correlations(partial))
        lag, width = colour.size, self.products.shape[2]
        half = (colour @ self.products.reshape(lag, -1)).reshape(lag, width, width)
        gram = (colour @ half.reshape(lag, -1)).reshape(width, width)
        slopes = half[1:] + half[1:].transpose(0, 2, 1)
        # a part in 1e12 of white noise: columns that a filter removes stay regular
        of_columns = np.arange(width - 1)
        gram[of_columns, of_columns] += _EXACT * float(np.trace(gram[:-1, :-1]))
        return gram, slopes, along

    def solved(self, partial: FloatArray) -> tuple[FloatArray, float]:
        """Return the whitened columns' products and the sum of squares that they leave."""
        gram = self.gram(partial)[0]
        step = np.linalg.solve(gram[:-1, :-1], gram[:-1, -1])
        return gram[:-1, :-1], max(float(gram[-1, -1] - gram[:-1, -1] @ step), _EXACT)

    def cost_and_slope(self, partial: FloatArray) -> tuple[float, FloatArray]:
        """Return minus the logarithm of the restricted likelihood, innovations' variance at its best, and its slope."""
        kappa = self.correlations(partial)
        gram, slopes, along = self.gram(partial)
        of_columns, across = gram[:-1, :-1], gram[:-1, -1]
        inverse = np.linalg.inv(of_columns)
        step = np.append(-inverse @ across, 1.0)
        left = float(gram[-1] @ step)
        rest, order = self.rows - len(of_columns), np.arange(1, kappa.size + 1)
        size = float(np.linalg.slogdet(of_columns)[1])
        cost = 0.5 * (rest * math.log(max(left, _EXACT)) - float(order @ np.log1p(-(kappa**2))) + size)
        of_left = step @ slopes @ step if left > _EXACT else np.zeros(kappa.size)
        of_size = np.einsum("ab,kab->k", inverse, slopes[:, :-1, :-1])
        of_colour = rest * of_left / max(left, _EXACT) + of_size
        of_kappa = 0.5 * (of_colour @ along) + order * kappa / (1.0 - kappa**2)
        return cost, of_kappa * self.slopes(kappa)

    def variance(self, partial: FloatArray) -> float:
        """Return the innovations' variance over the residual's sum of squares."""
        of_columns, left = self.solved(partial)
        return left / max(self.rows - len(of_columns), 1)

    def freedom(self, partial: FloatArray) -> FloatArray:
        """Return 2 over the variance of the logarithm of each parameter's variance (Satterthwaite), 2 at least."""
        rank = self.to_parameters.shape[1]
        scatter = np.full(len(self.to_parameters), 2.0 / max(self.rows - rank, 1))

        def logarithm(at: FloatArray) -> FloatArray:
            gram, left = self.solved(at)
            inverse = np.linalg.inv(gram)
            sizes = np.einsum("pa,ab,pb->p", self.to_parameters, inverse, self.to_parameters)
            return np.asarray(np.log(np.maximum(sizes, np.finfo(np.float64).tiny) * left))

        for direction in self._standard_directions(partial):
            scatter += (0.5 * (logarithm(partial + direction) - logarithm(partial - direction))) ** 2
        return np.asarray(np.maximum(2.0 / scatter, _LEAST_FREEDOM))

    def _standard_directions(self, at: FloatArray) -> FloatArray:
        """Return directions one standard deviation long in which the minimum is known, (p, p)."""
        steps = _DIFFERENCE * np.eye(at.size)
        slopes = [self.cost_and_slope(at + step)[1] - self.cost_and_slope(at - step)[1] for step in steps]
        hessian = np.reshape(slopes, (at.size, at.size)) / (2.0 * _DIFFERENCE)
        curvatures, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        return np.asarray((vectors / np.sqrt(np.maximum(curvatures, 1.0))).T)


def _products(signals: FloatArray, order: int) -> FloatArray:
    n, width = signals.shape
    products = np.empty((order + 1, order + 1, width, width))
    for j in range(order + 1):
        products[0, j] = signals[: n - j].T @ signals[j:]
        for i in range(1, j + 1):  # one row less at either end
            first = np.outer(signals[i - 1], signals[j - 1])
            products[i, j] = products[i - 1, j - 1] - first - np.outer(signals[n - j], signals[n - i])
        for i in range(j):
            products[j, i] = products[i, j].T
    return products


def _filter_and_slopes(partial: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return 1, c_1..c_p of a stationary filter from its partial correlations (Levinson), and dc/dkappa (p, p)."""
    p = partial.size
    colour, slopes = np.zeros(p + 1), np.zeros((p, p + 1))  # a row for each partial correlation
    colour[0] = 1.0
    for k, kappa in enumerate(partial, 1):
        reverse = colour[k::-1].copy()
        slopes[:k, : k + 1] -= kappa * slopes[:k, k::-1]
        slopes[k - 1, : k + 1] = -reverse
        colour[: k + 1] -= kappa * reverse
    return colour, slopes[:, 1:].T


def _partial_correlations(whitening: FloatArray) -> FloatArray:
    colour, partial = np.append(1.0, whitening), np.zeros(whitening.size)
    for k in range(whitening.size, 0, -1):
        kappa = float(np.clip(-colour[k], -_STATIONARY, _STATIONARY))
        partial[k - 1] = kappa
        colour = ((colour + kappa * colour[::-1]) / (1.0 - kappa**2))[:k]
    return partial
