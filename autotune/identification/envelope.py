"""What is known of a plant on a frequency grid: gain from above, phase from below; and whether it is in class (1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, ComplexArray, FloatArray
from autotune.errors import IdentificationError
from autotune.identification.parametric import PlantFit
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint

_DRAWS = 400
#: Standard deviations of a difference that make a contradiction.
_SIGMAS = 4.0
_WHERE = "reduced model"


@dataclass(frozen=True, kw_only=True, eq=False)
class Envelope:
    """Bounds on the positive-gain plant over frequency.

    Attributes
    ----------
    omega_rad_s : (N,) array
        Frequencies [rad/s], ascending.
    gain : (N,) array
        Upper bound of |H|.
    phase_rad : (N,) array
        Lower bound of arg H [rad], unwrapped.
    phase_high_rad : (N,) array
        Upper bound of arg H [rad]: where it passes -180 degrees, omega_-180 is passed for certain.
    """

    omega_rad_s: FloatArray
    gain: FloatArray
    phase_rad: FloatArray
    phase_high_rad: FloatArray

    def until_phase(self, phase_rad: float) -> BoolArray:
        """Return the mask of the frequencies until the phase has surely fallen to this value, that one included."""
        beyond = np.flatnonzero(self.phase_high_rad <= phase_rad)
        last = int(beyond[0]) if beyond.size else self.omega_rad_s.size - 1
        return np.asarray(np.arange(self.omega_rad_s.size) <= last)

    def join_with(self, other: Envelope) -> Envelope:
        """Return both sets of bounds on the union of the frequencies."""
        order = np.argsort(np.concatenate([self.omega_rad_s, other.omega_rad_s]), kind="stable")
        return Envelope(
            omega_rad_s=np.concatenate([self.omega_rad_s, other.omega_rad_s])[order],
            gain=np.concatenate([self.gain, other.gain])[order],
            phase_rad=np.concatenate([self.phase_rad, other.phase_rad])[order],
            phase_high_rad=np.concatenate([self.phase_high_rad, other.phase_high_rad])[order],
        )


def _positive_phase(response: ComplexArray, sign: int) -> FloatArray:
    """Return the phase of the positive-gain plant in (-3 pi/2, pi/2] [rad]."""
    phase = np.angle(sign * response)
    return np.asarray(np.where(phase > 0.5 * math.pi, phase - 2.0 * math.pi, phase), dtype=np.float64)


def envelope_of_points(points: Sequence[FrequencyPoint], sign: int, probability: float) -> Envelope:
    """Return the extremes of gain and phase over each point's region of the given probability.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        Measured points in ascending frequency.
    sign : {-1, 1}
        Sign of the plant's gain.
    probability : float
        Of each region; 0 takes the estimates themselves.
    """
    omega = np.array([point.omega_rad_s for point in points])
    H = np.array([point.response for point in points])
    phase = _positive_phase(H, sign)
    gain_radius, phase_radius = np.zeros(omega.size), np.zeros(omega.size)
    if probability > 0.0:
        quantile = math.sqrt(-2.0 * math.log(1.0 - probability))
        sd = np.array([polar_sd(point) for point in points])
        gain_radius, phase_radius = quantile * sd[:, 0] * np.abs(H), quantile * sd[:, 1]
    return Envelope(
        omega_rad_s=omega,
        gain=np.abs(H) + gain_radius,
        phase_rad=phase - phase_radius,
        phase_high_rad=phase + phase_radius,
    )


def polar_sd(point: FrequencyPoint) -> tuple[float, float]:
    """Return the standard deviations of the relative gain and of the phase [rad], to first order."""
    along = np.array([point.response.real, point.response.imag]) / point.gain
    covariance = np.array(point.covariance)
    across = np.array([-along[1], along[0]])
    return (
        math.sqrt(max(float(along @ covariance @ along), 0.0)) / point.gain,
        math.sqrt(max(float(across @ covariance @ across), 0.0)) / point.gain,
    )


def envelope_of_fit(fit: PlantFit, omega_rad_s: FloatArray, probability: float) -> Envelope:
    """Return the pointwise bounds of the plants that a fit through the points allows.

    Parameters
    ----------
    fit : PlantFit
        Structure with its parameters' covariance.
    omega_rad_s : (N,) array
        Frequencies [rad/s], ascending from where the phase is within half a turn of its limit at zero.
    probability : float
        Two-sided probability of the band at each frequency; 0 takes the estimate itself.
    """
    plants = fit.draws(_DRAWS, np.random.default_rng(0)) if probability > 0.0 else (fit.plant,)
    H = np.array([plant.response(omega_rad_s) for plant in plants]) * fit.sign
    phase = np.unwrap(np.angle(H), axis=1)
    low, high = 0.5 * (1.0 - probability), 0.5 * (1.0 + probability)
    if probability <= 0.0:
        return Envelope(omega_rad_s=omega_rad_s, gain=np.abs(H[0]), phase_rad=phase[0], phase_high_rad=phase[0])
    return Envelope(
        omega_rad_s=omega_rad_s,
        gain=np.quantile(np.abs(H), high, axis=0),
        phase_rad=np.quantile(phase, low, axis=0),
        phase_high_rad=np.quantile(phase, high, axis=0),
    )


def envelope_of_transfer_function(plant: TransferFunction, sign: int, omega_rad_s: FloatArray) -> Envelope:
    """Return the plant itself as its own bounds, phase unwrapped from low frequency.

    Parameters
    ----------
    plant : TransferFunction
        Exact.
    sign : int
        1 or -1, of the plant's gain at low frequency.
    omega_rad_s : (N,) array
        Angular frequencies [rad/s], ascending.
    """
    H = sign * plant.response(omega_rad_s)
    phase = np.unwrap(np.angle(H))
    return Envelope(omega_rad_s=omega_rad_s, gain=np.abs(H), phase_rad=phase, phase_high_rad=phase)


def require_class_one(points: Sequence[FrequencyPoint], sign: int) -> None:
    """Refuse points that cannot come from a plant of class (1), with the reason.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        Measured points in ascending frequency.
    sign : {-1, 1}
        Sign of the plant's gain.

    Raises
    ------
    IdentificationError
        Gain or phase rises with frequency, or the phase starts below -135 degrees.
    """
    H = np.array([point.response for point in points])
    gain, phase = np.log(np.abs(H)), _positive_phase(H, sign)
    sd = np.array([polar_sd(point) for point in points])
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            between = f"from {points[i].omega_rad_s:.4g} to {points[j].omega_rad_s:.4g} rad/s"
            if gain[j] - gain[i] > _SIGMAS * math.hypot(sd[i, 0], sd[j, 0]) + 1e-9:
                raise IdentificationError(
                    f"the gain rises {between} (a resonance): outside class (1) of the reduced models",
                    where=_WHERE,
                    remedy="design on the points themselves",
                )
            if phase[j] - phase[i] > _SIGMAS * math.hypot(sd[i, 1], sd[j, 1]) + 1e-9:
                raise IdentificationError(
                    f"the phase rises {between} (lead, or a wrong sign): outside class (1) of the reduced models",
                    where=_WHERE,
                    remedy="design on the points themselves, or check for harmonics of another experiment",
                )
    if phase[0] + _SIGMAS * sd[0, 1] < -0.75 * math.pi:
        raise IdentificationError(
            f"the phase at the lowest point ({points[0].omega_rad_s:.4g} rad/s) is {math.degrees(phase[0]):.1f} deg",
            where=_WHERE,
            remedy="measure where the phase is above -135 deg: a PI cannot reach 45 deg of margin otherwise",
        )
