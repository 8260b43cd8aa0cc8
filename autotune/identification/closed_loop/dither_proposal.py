"""Which dither would show the plant well enough, from a first, poorer model of it: amplitude, dwell times, length."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.controller import DiscreteController
from autotune.identification.closed_loop.confidence import response_gradient
from autotune.identification.closed_loop.loop_excitation import PRECISION_WANTED
from autotune.identification.closed_loop.prediction_error import PredictionErrorEstimate

#: Singular values of the sensitivities below this, relative, belong to directions that the response does not feel.
_RANK = 1e-9
#: Departure of y is counted to this many standard deviations.
_PEAK = 3.0
#: Shortest length, in periods of the band's lowest frequency.
_PERIODS = 10.0


@dataclass(frozen=True, kw_only=True)
class DitherLimits:
    """What the rig allows around its operating point.

    Attributes
    ----------
    amplitude : float
        Largest half-amplitude of the dither [u unit].
    departure : float
        Largest departure of y because of it [y unit].
    source : str
        Whose limits these are, for the sentence.
    """

    amplitude: float
    departure: float
    source: str


@dataclass(frozen=True, kw_only=True)
class DitherProposal:
    """A random binary dither, added to the controller's output, that would reach the wanted precision.

    Attributes
    ----------
    amplitude : float
        Half-amplitude [u unit].
    dwell_s : (float, float)
        Shortest and longest dwell, log-uniform between them [s].
    band_rad_s : (float, float)
        Band in which the plant is then known [rad/s].
    length_s : float
        Time under dither [s].
    departure : float
        Three standard deviations of y's motion because of it [y unit].
    source : str
        Whose limits it keeps.
    """

    amplitude: float
    dwell_s: tuple[float, float]
    band_rad_s: tuple[float, float]
    length_s: float
    departure: float
    source: str

    @property
    def sentence(self) -> str:
        """The proposal for a reader."""
        return (
            f"enough within {self.source}: a random binary dither of half-amplitude {self.amplitude:.3g}, dwell times "
            f"{self.dwell_s[0]:.3g} to {self.dwell_s[1]:.3g} s, for {self.length_s:.4g} s; y would depart by "
            f"{self.departure:.3g} (three standard deviations)"
        )


def propose_dither(
    estimate: PredictionErrorEstimate,
    band_rad_s: tuple[float, float],
    limits: DitherLimits,
    *,
    controller: DiscreteController | None = None,
) -> DitherProposal:
    """Return the shortest dither within the limits that makes the response known to 5 % in the band.

    Parameters
    ----------
    estimate : PredictionErrorEstimate
        Model as far as it is known, one input and one output, in the recording's units.
    band_rad_s : (float, float)
        Where the plant must be known [rad/s].
    limits : DitherLimits
        Of the rig.
    controller : DiscreteController, optional
        The present law; without it the loop is taken to pass the dither on unchanged (S = 1), which holds above its
        crossover.

    Returns
    -------
    DitherProposal

    Notes
    -----
    The information that the dither alone carries, T/(pi Ts) int Re(dG dG*) |S|^2 Phi / (|H|^2 sigma^2) domega, is a
    lower bound of the whole (what the noise's own way round the loop adds is left out), so the length is an upper
    bound, as far as the first model and its order are right. Ljung, System Identification, 2nd ed., (9.55), (13.40).
    """
    model, dt_s = estimate.model, estimate.model.sample_time_s
    dwell_s = (max(dt_s, 0.5 * math.pi / band_rad_s[1]), max(2.0 * dt_s, math.pi / band_rad_s[0]))
    omega = np.geomspace(0.25 * band_rad_s[0], 0.99 * math.pi / dt_s, 400)
    G = model.response(omega)[:, 0, 0]
    S = np.ones_like(G) if controller is None else 1.0 / (1.0 + G * controller.response(omega))
    power = np.abs(S) ** 2 * dwell_spectrum(omega, *dwell_s)  # of u, per unit amplitude
    H = model.noise_response(omega)[:, 0, 0]
    step = np.gradient(omega)
    weight = power * step / (math.pi * dt_s * np.abs(H) ** 2 * float(model.innovation_covariance[0, 0]))
    inside = (omega >= band_rad_s[0]) & (omega <= band_rad_s[1])
    variance = _variance(response_gradient(estimate, omega)[:, 0, 0], weight)
    needed = float(np.max(variance[inside] / np.abs(G[inside]) ** 2)) / PRECISION_WANTED**2  # amplitude^2 length
    y_sd = math.sqrt(float(np.sum(np.abs(G) ** 2 * power * step)) / math.pi)
    amplitude = min(limits.amplitude, limits.departure / (_PEAK * y_sd))
    length_s = max(needed / amplitude**2, _PERIODS * 2.0 * math.pi / band_rad_s[0])
    amplitude = min(amplitude, math.sqrt(needed / length_s))
    return DitherProposal(
        amplitude=amplitude,
        dwell_s=dwell_s,
        band_rad_s=band_rad_s,
        length_s=length_s,
        departure=_PEAK * y_sd * amplitude,
        source=limits.source,
    )


def dwell_spectrum(omega_rad_s: FloatArray, shortest_s: float, longest_s: float) -> FloatArray:
    """Return the two-sided power density of a binary signal of +-1 with log-uniform dwell times.

    An alternating renewal process with mean dwell mu and characteristic function phi of the dwell has
    4/(mu omega^2) Re((1 - phi)/(1 + phi)); its integral over omega/(2 pi) is 1.

    Parameters
    ----------
    omega_rad_s : (W,) array
        Angular frequencies [rad/s], positive.
    shortest_s, longest_s : float
        The dwells' range [s].

    Returns
    -------
    (W,) array
        Density [s].
    """
    dwell = np.geomspace(shortest_s, longest_s, 513)
    dwell = np.sqrt(dwell[1:] * dwell[:-1])
    phi = np.mean(np.exp(1j * omega_rad_s[:, None] * dwell), axis=1)
    return np.asarray(4.0 / (np.mean(dwell) * omega_rad_s**2) * np.real((1.0 - phi) / (1.0 + phi)), dtype=np.float64)


def _variance(gradient: ComplexArray, weight: FloatArray) -> FloatArray:
    """Return the mean variance of the real and imaginary part, (W,), for sensitivities (W, P) and weights (W,)."""
    parts = np.concatenate([gradient.real, gradient.imag])
    root = np.sqrt(np.concatenate([weight, weight]))[:, None]
    scale = np.linalg.norm(root * parts, axis=0)
    felt = scale > 1e-12 * scale.max()
    _, s, Vt = np.linalg.svd(root * parts[:, felt] / scale[felt], full_matrices=False)
    kept = s > _RANK * s[0]
    spread = (parts[:, felt] / scale[felt]) @ Vt[kept].T / s[kept]
    both = np.sum(spread**2, axis=1).reshape(2, -1)
    return np.asarray(both.mean(axis=0), dtype=np.float64)
