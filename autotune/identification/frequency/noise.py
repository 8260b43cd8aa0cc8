"""Spectrum of the residual noise: autoregressive, its order chosen by the data, white when they do not object."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray


@dataclass(frozen=True, kw_only=True)
class NoiseSpectrum:
    """Autoregressive noise e_k + a_1 e_{k-1} + ... = w_k.

    Attributes
    ----------
    sd : float
        Standard deviation of the noise itself [unit of the signal].
    innovation_variance : float
        Variance of w.
    coefficients : tuple of float
        a_1, a_2, ...; empty for white noise.
    sample_time_s : float
        Mean sample time [s].
    """

    sd: float
    innovation_variance: float
    coefficients: tuple[float, ...]
    sample_time_s: float

    @property
    def is_white(self) -> bool:
        """Whether order 0 was chosen."""
        return not self.coefficients

    def variance_at(self, omega_rad_s: FloatArray) -> FloatArray:
        """Return the variance of white noise that has the same spectral density at these frequencies."""
        z = np.exp(-1j * np.asarray(omega_rad_s) * self.sample_time_s)
        transfer = np.polyval([*self.coefficients[::-1], 1.0], z)
        return np.asarray(self.innovation_variance / np.abs(transfer) ** 2, dtype=np.float64)


def noise_spectrum(
    residual: FloatArray, sample_time_s: float, fitted_parameters: int, *, largest_order: int = 12
) -> NoiseSpectrum:
    """Estimate the spectrum of a fit's residual by Burg's recursion, the order by Akaike's criterion, corrected.

    Parameters
    ----------
    residual : (N,) array
        What a fit of ``fitted_parameters`` coefficients left.
    sample_time_s : float
        Mean sample time [s].
    fitted_parameters : int
        Taken off the degrees of freedom of the variance.
    largest_order : int
        Highest order considered; at most a tenth of the samples.

    Notes
    -----
    Time stamps that jitter are treated as uniform: right for the frequencies far below the sampling rate that a
    limit cycle has. The criterion asks for 4 (not 2) per coefficient, so that white noise is mostly called white.
    """
    n = residual.size
    freedom = n / max(n - fitted_parameters, 1)
    variance = float(np.mean(residual**2))
    forward, backward = residual.copy(), residual.copy()
    polynomial, power = np.array([1.0]), variance
    best_score, best_power, best = n * math.log(max(power, 1e-300)), power, polynomial
    for order in range(1, min(largest_order, n // 10) + 1):
        f, b = forward[order:], backward[order - 1 : -1]
        energy = float(f @ f + b @ b)
        if energy <= 0.0:
            break
        reflection = -2.0 * float(f @ b) / energy
        forward[order:], backward[order:] = f + reflection * b, b + reflection * f
        polynomial = np.append(polynomial, 0.0) + reflection * np.append(polynomial, 0.0)[::-1]
        power *= 1.0 - reflection**2
        score = n * math.log(max(power, 1e-300)) + 4.0 * order
        if score < best_score:
            best_score, best_power, best = score, power, polynomial
    return NoiseSpectrum(
        sd=math.sqrt(variance * freedom),
        innovation_variance=best_power * freedom,
        coefficients=tuple(float(a) for a in best[1:]),
        sample_time_s=sample_time_s,
    )
