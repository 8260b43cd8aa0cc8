"""Fourier coefficients of a periodic record: exact for a held command, least squares for a sampled measurement."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import ComplexArray, FloatArray


def held_coefficients(
    t: FloatArray, u: FloatArray, omega_rad_s: FloatArray, start_s: float, end_s: float
) -> ComplexArray:
    """Return (1/T) int u(t) exp(-j omega t) dt of the held command over the window, without approximation.

    Parameters
    ----------
    t, u : (N,) array
        Time stamps [s] and the command held from each to the next (from the last one to ``end_s``).
    omega_rad_s : (H,) array
        Angular frequencies [rad/s], whole multiples of 2 pi over the window's length.
    start_s, end_s : float
        Window [s] of length T, within the stamps.

    Returns
    -------
    (H,) complex array
        Coefficients c with u = sum of 2 Re(c exp(j omega t)) + mean; the phase is that of t = 0.
    """
    knots = np.concatenate([[start_s], t[(t > start_s) & (t < end_s)], [end_s]])
    levels = u[np.clip(np.searchsorted(t, knots[:-1], side="right") - 1, 0, None)]
    levels = levels - np.sum(levels * np.diff(knots)) / (end_s - start_s)
    s = -1j * np.asarray(omega_rad_s)[:, None]
    phasors = np.exp(s * knots[None, :])
    return np.asarray((np.diff(phasors, axis=1) @ levels) / (s[:, 0] * (end_s - start_s)), dtype=np.complex128)


@dataclass(frozen=True, kw_only=True, eq=False)
class HarmonicFit:
    """Least-squares fit of harmonics and a slow drift to samples.

    Attributes
    ----------
    coefficients : (H,) complex array
        c_n of 2 Re(c_n exp(j n omega t)); the phase is that of t = 0.
    covariance_unit : (H, 2, 2) array
        Covariance of (Re c_n, Im c_n) for white noise of unit variance.
    residual : (N,) array
        What the fit leaves.
    columns : (N, P) array
        What was fitted: real parts of the harmonics, imaginary parts, drift, transients, each of unit size.
    slope : float
        Drift per second at the middle of the window.
    """

    coefficients: ComplexArray
    covariance_unit: FloatArray
    residual: FloatArray
    columns: FloatArray
    slope: float

    @property
    def noise_sd(self) -> float:
        """Standard deviation of the noise."""
        freedom = max(self.residual.size - self.columns.shape[1], 1)
        return math.sqrt(float(self.residual @ self.residual) / freedom)


def fit_harmonics(
    t: FloatArray,
    y: FloatArray,
    omega_rad_s: float,
    harmonics: Sequence[int],
    *,
    transients: Sequence[FloatArray] = (),
) -> HarmonicFit:
    """Fit harmonics of ``omega_rad_s`` together with a linear drift and decaying transients by least squares.

    Parameters
    ----------
    t, y : (N,) array
        Stamps [s], not necessarily uniform, and samples.
    omega_rad_s : float
        Fundamental [rad/s].
    harmonics : sequence of int
        Orders n to fit.
    transients : sequence of (N,) array
        Further columns.

    Notes
    -----
    For white noise and a strictly periodic signal this is the maximum-likelihood estimate: its covariance is the
    Cramer-Rao bound with the drift unknown.
    """
    middle, half = 0.5 * (t[0] + t[-1]), max(0.5 * (t[-1] - t[0]), 1e-300)
    x = (t - middle) / half
    phasor = np.exp(1j * omega_rad_s * t)
    waves = [2.0 * phasor**n for n in harmonics]
    drift = list(np.polynomial.legendre.legvander(x, 1).T)
    design = np.array([wave.real for wave in waves] + [-wave.imag for wave in waves] + drift + list(transients))
    scale = 1.0 / np.linalg.norm(design, axis=1)
    design *= scale[:, None]
    factor = np.linalg.cholesky(design @ design.T + 1e-13 * np.eye(len(design)))
    inverse = scale[:, None] * np.linalg.inv(factor).T
    theta = inverse @ (np.linalg.inv(factor) @ (design @ y))
    residual = y - (theta / scale) @ design
    h = len(harmonics)
    unit = inverse @ inverse.T
    index = np.arange(h)
    covariance = np.empty((h, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = unit[index, index], unit[index + h, index + h]
    covariance[:, 0, 1] = covariance[:, 1, 0] = unit[index, index + h]
    return HarmonicFit(
        coefficients=theta[:h] + 1j * theta[h : 2 * h],
        covariance_unit=covariance,
        residual=residual,
        columns=design.T,
        slope=float(theta[2 * h + 1] / half),
    )
