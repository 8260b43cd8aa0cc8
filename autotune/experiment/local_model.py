"""What is expected of the plant between and beyond the points that were measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.points import FrequencyPoint

#: difference of two points' logarithms (frequency, tangent of the lag) from which on they tell a slope
APART = 0.1
#: largest lag of which the tangent is taken, and how near 90 degrees the lag of one lag counts as that [rad]
STEEPEST, NEARLY = 1.55, 0.02


@dataclass(frozen=True, kw_only=True)
class LocalModel:
    """k / ((j omega + a) (1 + j omega tau)) through one known point: enough to choose the next setting, no estimate.

    An integrator and a lag (a = 0) where the plant lags by more than 90 degrees, one lag (tau = 0) where by less.
    """

    k: float
    tau_s: float
    a_rad_s: float = 0.0

    @classmethod
    def through(cls, omega_rad_s: float, gain: float, lag_rad: float) -> LocalModel:
        """Return the model with this gain and phase at a frequency.

        Parameters
        ----------
        omega_rad_s : float
            Where [rad/s].
        gain : float
            Of the plant there [y unit/u unit].
        lag_rad : float
            Phase lag there beyond -90 deg [rad].
        """
        tau = math.tan(max(lag_rad, 0.0)) / omega_rad_s
        a = math.tan(max(-lag_rad, 0.0)) * omega_rad_s
        return cls(k=gain * math.hypot(omega_rad_s, a) * math.hypot(1.0, tau * omega_rad_s), tau_s=tau, a_rad_s=a)

    def gain(self, omega_rad_s: float) -> float:
        """Return the magnitude at ``omega_rad_s``."""
        return self.k / (math.hypot(omega_rad_s, self.a_rad_s) * math.hypot(1.0, self.tau_s * omega_rad_s))

    def turning_time_s(self, omega_rad_s: float) -> float:
        """Return the time from a switch of the relay to the extremum of y [s].

        There the speed is zero and y is at its peak, in every limit cycle of the same peak: where one amplitude gives
        way to another without a transient of position and speed.
        """
        if self.tau_s == 0.0:  # one lag turns at once
            return 0.0
        quarter = 0.5 * math.pi / omega_rad_s
        return self.tau_s * math.log(1.0 + math.tanh(quarter / self.tau_s))

    def crest(self, omega_rad_s: float) -> float:
        """Return the ratio of peak to fundamental amplitude of its response to a relay's square wave."""
        wave, fundamental = self._relay_response(omega_rad_s, 1.0, np.linspace(0.0, 2.0 * np.pi, 96))
        return float(np.max(wave) / fundamental)

    def crossing_s(self, omega_rad_s: float, amplitude: float, hysteresis: float, smoothing_s: float) -> float:
        """Return how long before a switch the smoothed y crossed the hysteresis [s]: the lag the relay must have.

        Parameters
        ----------
        omega_rad_s : float
            Frequency of the limit cycle [rad/s].
        amplitude, hysteresis : float
            The relay's [u unit, y unit].
        smoothing_s : float
            Length of the moving average, whose own delay is not counted here [s].
        """
        # u rises at phase 0; before that y has fallen through minus the hysteresis
        phase = np.linspace(-1.25 * np.pi, 0.0, 300)
        wave, _ = self._relay_response(omega_rad_s, amplitude, phase, smoothing_s)
        below = wave < -hysteresis
        first = int(np.argmax(below[1:] & ~below[:-1]))
        return float(-phase[first + 1] / omega_rad_s) if below.any() else 0.0

    def _relay_response(
        self, omega_rad_s: float, amplitude: float, phase_rad: FloatArray, smoothing_s: float = 0.0
    ) -> tuple[FloatArray, float]:
        """Return y over the phase and the amplitude of its fundamental, u a square wave that rises at phase 0."""
        orders = np.arange(1, 20, 2)
        s = 1j * orders * omega_rad_s
        average = np.sinc(orders * omega_rad_s * smoothing_s / (2.0 * np.pi))
        waves = 4.0 * amplitude / np.pi * self.k * average / ((s + self.a_rad_s) * (1.0 + s * self.tau_s) * orders)
        wave = np.imag(np.exp(1j * np.multiply.outer(phase_rad, orders)) @ waves)
        return np.asarray(wave, dtype=np.float64), float(abs(waves[0]))


def lag_beyond_integrator(point: FrequencyPoint, plant_sign: int) -> float:
    """Return by how much the positive-gain plant's phase lies below -90 deg, in (-pi/2, 3 pi/2) [rad].

    Parameters
    ----------
    point : FrequencyPoint
        Of the plant.
    plant_sign : int
        1 or -1, sign of the plant's gain.
    """
    phase = float(np.angle(point.response * plant_sign))
    return -phase % (2.0 * math.pi) - math.pi / 2.0


def predict_crossing(points: Sequence[FrequencyPoint], plant_sign: int, phase_rad: float) -> tuple[float, LocalModel]:
    """Return the frequency [rad/s] at which the plant is expected to have the phase, and a model of it there.

    The tangent of the lag beyond -90 deg is close to a power of omega for everything that lags by more, the tangent of
    the lag itself for what lags by less: it is interpolated, and beyond the known points extrapolated, on logarithmic
    axes.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        Those that are known.
    plant_sign : int
        1 or -1, sign of the plant's gain.
    phase_rad : float
        Phase of the positive-gain plant [rad].

    Raises
    ------
    IdentificationError
        No known point lags by more than -90 and less than -180 deg, or less than -90 deg where that is asked for.
    """
    lag_rad = -phase_rad - math.pi / 2.0
    less = 0.5 * math.pi if lag_rad < 0.0 else 0.0
    lags = [(point, lag_beyond_integrator(point, plant_sign) + less) for point in points]
    # one lag far above its corner lags by 90 degrees but for what noise hides
    lags = [(point, STEEPEST if less and abs(lag - less) < NEARLY else lag) for point, lag in lags]
    usable = sorted(
        ((math.log(p.omega_rad_s), math.log(math.tan(lag)), p) for p, lag in lags if 0.02 < lag <= STEEPEST),
        key=lambda entry: entry[1],
    )
    if not usable:
        raise IdentificationError(
            "the plant's phase at the first oscillation is not between -90 and -180 degrees",
            where="relay experiment",
            remedy="the relay with delay suits plants lagging by more than an integrator; check plant_sign and filters",
        )
    wanted = math.log(math.tan(lag_rad + less))
    nearest = sorted(usable, key=lambda entry: abs(entry[1] - wanted))[:2]
    # one lag has slope 1; the more the phase lags, the more further lags and dead time take part
    slope = 1.0 if less else 1.0 / (1.0 + 0.15 * math.exp(0.5 * (wanted + nearest[0][1])))
    if len(nearest) == 2 and abs(nearest[1][1] - nearest[0][1]) > APART:
        slope = (nearest[1][0] - nearest[0][0]) / (nearest[1][1] - nearest[0][1])
        slope = min(max(slope, 0.05), 1.2)
    omega = math.exp(nearest[0][0] + slope * (wanted - nearest[0][1]))
    return omega, LocalModel.through(omega, _gain([entry[2] for entry in nearest], plant_sign, omega), lag_rad)


def _gain(nearest: Sequence[FrequencyPoint], plant_sign: int, omega_rad_s: float) -> float:
    """Return the gain expected at a frequency: rather too large, where one point is all that is known, than too small.

    Two points say how it falls, between no faster than two integrators and not at all; of one point it is not known
    whether lags or a dead time, under which it stays, have made its phase.
    """
    first = nearest[0]
    if len(nearest) == 2 and abs(apart := math.log(nearest[1].omega_rad_s / first.omega_rad_s)) > APART:
        slope = math.log(nearest[1].gain / first.gain) / apart
        return first.gain * math.pow(omega_rad_s / first.omega_rad_s, min(max(slope, -2.0), 0.0))
    model = LocalModel.through(first.omega_rad_s, first.gain, lag_beyond_integrator(first, plant_sign))
    return max(model.gain(omega_rad_s), first.gain)
