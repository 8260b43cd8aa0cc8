"""Local polynomial estimate: G and the leakage are smooth over neighbouring lines, noise and excitation are not.

On the lines around omega: E(k) = G(omega_k) X(k) + T(omega_k) + V(k), G and T in the span of 1, omega and 1/omega.
Least squares removes the leakage T (transient, drift, ends of the record) and gives the noise level from what is left;
lines come weighted so that noise is about as large on each, since one level is all that a window's residual tells.
1/omega in place of the usual omega^2 is as good in a narrow window, and exact for integrators and ramps in a wide one.

A wide window, as one at the lowest lines is, holds more of G than three terms follow; what they miss goes with X and is
no noise, so that the residual shows too little of it. How far omega^2 as a fourth term moves the gain estimates that
bias; its square is added to the variance. The noise's own share of it stays in: a rough model that was fitted to points
follows their noise, and what three terms miss of that is in no residual. Where nothing is missed, 95 % regions hold the
truth in 96 of 100 for it.

References
----------
Pintelon, Schoukens, Vandersteen, Barbe, Estimation of nonparametric noise and FRF models for multivariable systems,
Mechanical Systems and Signal Processing 24, 2010.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, ComplexArray, FloatArray
from autotune.identification.noise_colour import region_widening


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalEstimate:
    """Response of q outputs at one frequency.

    Attributes
    ----------
    omega_rad_s : float
        Frequency [rad/s].
    gain : (q,) complex array
        Complex gains from the regressor to each output.
    covariance : (q, q) complex array
        Covariance E{g g^H} of the errors, squared bias included, for circular noise.
    degrees_of_freedom : int
        Complex ones of the noise estimate.
    """

    omega_rad_s: float
    gain: ComplexArray
    covariance: ComplexArray
    degrees_of_freedom: int

    @property
    def inflation(self) -> float:
        """Factor on the covariance with which the chi-square region holds 95 % although the noise is estimated."""
        return region_widening(2.0 * self.degrees_of_freedom)


def local_estimate(
    omega_rad_s: FloatArray,
    X: ComplexArray,
    Z: ComplexArray,
    centre_rad_s: float,
    *,
    excited: BoolArray | None = None,
    common: float = 0.0,
) -> LocalEstimate | None:
    """Fit the local polynomials to one window of lines.

    Parameters
    ----------
    omega_rad_s : (n,) array
        Lines of the window [rad/s].
    X : (n,) complex array
        Regressor, weighted: held command in open loop, set-point in closed loop.
    Z : (n, q) complex array
        Outputs, weighted alike.
    centre_rad_s : float
        Where the gain is wanted [rad/s], within the window.
    excited : (n,) array, optional
        Lines that carry excitation; all when absent. Fewer than three carry fewer terms of G.
    common : float
        Power on each line of the first output, weighted, that goes with the regressor and is in no residual: rounding.

    Returns
    -------
    LocalEstimate or None
        None where the window does not determine the gain.

    Notes
    -----
    Bias: what of G the three terms cannot follow within the window; taking a rough model's response off first leaves
    little of it, and the covariance holds the square of what a fourth term shows of it. A command that is itself smooth
    over the lines (one step) cannot be told from leakage: the covariance says so.
    """
    n = omega_rad_s.size
    lines = n if excited is None else int(excited.sum())
    if lines < 1 or n < 9:
        return None
    regressor = X if excited is None else np.where(excited, X, 0.0)
    if not np.any(regressor):
        return None
    found = _fit(omega_rad_s, regressor, Z, centre_rad_s, min(lines, 3))
    finer = _fit(omega_rad_s, regressor, Z, centre_rad_s, 4) if lines >= 4 else None
    if found is None:
        return None
    bias = found.gain - finer.gain if finer is not None else np.zeros_like(found.gain)
    covariance = found.covariance + np.outer(bias, bias.conj())
    covariance[0, 0] += common / float(np.mean(np.abs(regressor) ** 2))
    return replace(found, covariance=covariance)


def _fit(
    omega_rad_s: FloatArray, regressor: ComplexArray, Z: ComplexArray, centre_rad_s: float, terms_of_gain: int
) -> LocalEstimate | None:
    """Return the estimate with so many terms of G and three of T, its variance that of the residual."""
    n = omega_rad_s.size
    x = omega_rad_s / centre_rad_s - 1.0
    # the terms other than 1 are zero at the centre: the first coefficient is the gain there
    terms = (np.ones(n), x, centre_rad_s / omega_rad_s - 1.0, x**2)
    size = float(np.sqrt(np.mean(np.abs(regressor) ** 2)))
    design = np.column_stack(
        [regressor / size * term for term in terms[:terms_of_gain]] + [term + 0j for term in terms[:3]]
    )
    scale = np.linalg.norm(design, axis=0)
    design = design / scale
    normal = design.conj().T @ design
    if np.linalg.cond(normal) > 1e12:
        return None
    inverse = np.linalg.inv(normal)
    theta = inverse @ (design.conj().T @ Z)
    left = Z - design @ theta
    freedom = n - design.shape[1]
    # row noise v with E{v v^H}: left is (lines, q), one row per line
    noise = left.T @ left.conj() / freedom
    return LocalEstimate(
        omega_rad_s=centre_rad_s,
        gain=theta[0] / (size * scale[0]),
        covariance=noise * float(inverse[0, 0].real) / (size * scale[0]) ** 2,
        degrees_of_freedom=freedom,
    )
