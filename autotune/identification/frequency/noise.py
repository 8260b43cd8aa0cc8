"""Spectrum of the noise behind a fit: autoregressive, its order chosen by the data, white when they do not object."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.identification.noise_colour import noise_colour


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
    freedom : tuple of float
        Degrees of freedom of the variance of each coefficient of the fit.
    sample_time_s : float
        Mean sample time [s].
    """

    sd: float
    innovation_variance: float
    coefficients: tuple[float, ...]
    freedom: tuple[float, ...]
    sample_time_s: float

    def variance_at(self, omega_rad_s: FloatArray) -> FloatArray:
        """Return the variance of white noise that has the same spectral density at these frequencies."""
        z = np.exp(-1j * np.asarray(omega_rad_s) * self.sample_time_s)
        transfer = np.polyval([*self.coefficients[::-1], 1.0], z)
        return np.asarray(self.innovation_variance / np.abs(transfer) ** 2, dtype=np.float64)


def noise_spectrum(columns: FloatArray, residual: FloatArray, sample_time_s: float) -> NoiseSpectrum:
    """Return the spectrum of the noise behind a least-squares fit.

    Parameters
    ----------
    columns : (N, P) array
        The fit's columns.
    residual : (N,) array
        What it left.
    sample_time_s : float
        Mean sample time [s].

    Notes
    -----
    Harmonics of a few periods take most of the noise at low frequencies: the likelihood is the restricted one. Time
    stamps that jitter are treated as uniform: right for the frequencies far below the sampling rate that a limit cycle
    has.
    """
    colour = noise_colour(columns, residual)
    return NoiseSpectrum(
        sd=math.sqrt(float(residual @ residual) / max(residual.size - columns.shape[1], 1)),
        innovation_variance=colour.variance,
        coefficients=tuple(float(c) for c in colour.whitening),
        freedom=tuple(float(f) for f in colour.freedom),
        sample_time_s=sample_time_s,
    )
