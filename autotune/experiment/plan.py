"""Which relay setting comes next, and when a point is known well enough: pure functions of what is known so far."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.experiment.local_model import lag_beyond_integrator, predict_crossing
from autotune.experiment.relay import RelaySettings
from autotune.points import FrequencyPoint

#: part of limits.swing that a limit cycle is planned for: the rest is for a mid-point that is not quite right
PEAK_SHARE = 0.87
#: part of the half-range of phases that targets keep away from its ends: the reached phase is near its target only
PHASE_MARGIN = 0.13
#: part of a period that the relay may look back over; a longer average would blunt the crossing it looks for
SMOOTHING_SHARE = 0.12
#: hysteresis in standard deviations of the smoothed noise
HYSTERESIS_SD = 2.5
#: phase of the first oscillation [deg] above which the plant counts as one lag, and the highest phase of a point then
LEAST_LAG_DEG, LEAST_PHASE_DEG = -91.0, -35.0
#: what it costs a point, as a factor of its standard deviation, that drift and transient are estimated beside it
ESTIMATED_TOO = 1.08


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What the sweep works under.

    Attributes
    ----------
    peak : float
        Largest departure of y from its centre that a limit cycle is planned for [y unit].
    noise_sd : float
        Standard deviation of the measurement noise [y unit].
    sample_time_s : float
        Control period [s].
    u_step : float
        Resolution of the command [u unit]; 0 for any.
    u_room : float
        Largest relay amplitude that the command's range leaves around the mid-point [u unit].
    amplitude : float or None
        Relay amplitude that was asked for [u unit]; chosen from ``peak`` where None.
    """

    peak: float
    noise_sd: float
    sample_time_s: float
    u_step: float
    u_room: float
    amplitude: float | None = None


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A relay setting and what it is expected to do.

    Attributes
    ----------
    settings : RelaySettings
        The relay.
    phase_rad : float
        Phase of the plant (positive gain) that it aims at.
    omega_rad_s, y_amplitude : float
        Expected frequency [rad/s] and amplitude of y's fundamental [y unit].
    turning_s : float
        Expected time from a switch to the extremum of y [s].
    """

    settings: RelaySettings
    phase_rad: float
    omega_rad_s: float
    y_amplitude: float
    turning_s: float


def phase_targets(first_deg: float, last_deg: float, count: int) -> tuple[float, ...]:
    """Return the phases to aim at [rad], the most lagging first: short periods find the mid-point for the long ones.

    Parameters
    ----------
    first_deg, last_deg : float
        Ends of the wanted range, phase of the positive-gain plant [deg].
    count : int
        Number of points.
    """
    high, low = max(first_deg, last_deg), min(first_deg, last_deg)
    margin = PHASE_MARGIN * (high - low)
    return tuple(math.radians(phase) for phase in np.linspace(low + margin, high - margin, count))


def within_reach(ends_deg: tuple[float, float], first: FrequencyPoint, plant_sign: int) -> tuple[float, float]:
    """Return the phases between which points are measured [deg]: those wanted, or as far below as the plant lags.

    One lag without dead time never lags by 90 degrees, whatever the relay: the range is moved to where the plant is.

    Parameters
    ----------
    ends_deg : (float, float)
        Ends of the range that is wanted, phase of the positive-gain plant [deg].
    first : FrequencyPoint
        Of the first oscillation, whose relay has no inserted delay: what the plant lags by at most, nearly.
    plant_sign : {-1, 1}
        Sign of the plant's gain.
    """
    most = -90.0 - math.degrees(lag_beyond_integrator(first, plant_sign))
    high, low = max(ends_deg), min(ends_deg)
    if most < LEAST_LAG_DEG:
        return high, low
    low = max(low, most)
    return min(low + max(ends_deg) - min(ends_deg), LEAST_PHASE_DEG), low


def choose(
    points: Sequence[FrequencyPoint], phase_rad: float, goal: Goal, *, midpoint: float, y_centre: float, plant_sign: int
) -> Choice:
    """Return the relay setting whose limit cycle is expected at the phase, as large as the swing allows.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        Everything known so far, at least one point.
    phase_rad : float
        Phase of the positive-gain plant to aim at [rad].
    goal : Goal
        Swing, noise, resolution.
    midpoint, y_centre : float
        Mean command [u unit] and centre of the oscillation [y unit].
    plant_sign : {-1, 1}
        Sign of the plant's gain.
    """
    omega, model = predict_crossing(points, plant_sign, phase_rad)
    period = 2.0 * math.pi / omega / goal.sample_time_s
    largest = goal.peak / (model.crest(omega) * model.gain(omega) * 4.0 / math.pi)
    amplitude = goal.amplitude if goal.amplitude is not None else min(largest, goal.u_room)
    if goal.u_step > 0.0:
        amplitude = max(1.0, math.floor(amplitude / goal.u_step + 0.25)) * goal.u_step
    y_amplitude = model.gain(omega) * 4.0 / math.pi * amplitude
    lag_s = (math.pi + phase_rad) / omega
    smoothing = max(1, min(int(SMOOTHING_SHARE * period), int(lag_s / goal.sample_time_s)))
    hysteresis = min(HYSTERESIS_SD * goal.noise_sd / math.sqrt(smoothing), 0.5 * y_amplitude)
    lag_s = model.crossing_s(omega, amplitude, hysteresis, smoothing * goal.sample_time_s)
    # a crossing is seen half a sample late on average, and an average of M readings is (M - 1)/2 samples old
    delay = max(0.0, lag_s / goal.sample_time_s - 0.5 * (smoothing - 1) - 0.5)
    relay = RelaySettings(
        y_centre=y_centre,
        midpoint=midpoint,
        amplitude=amplitude,
        hysteresis=hysteresis,
        delay_samples=delay,
        smoothing=smoothing,
        plant_sign=1 if plant_sign > 0 else -1,
    )
    return Choice(
        settings=relay,
        phase_rad=phase_rad,
        omega_rad_s=omega,
        y_amplitude=y_amplitude,
        turning_s=model.turning_time_s(omega),
    )


def expected_sd(noise_sd: float, y_amplitude: float, samples: float) -> float:
    """Return the relative standard deviation of a gain (and of its phase [rad]) under white noise.

    It is the Cramer-Rao bound of the fundamental of a periodic signal of this amplitude, the drift known, times what it
    costs that drift and transient are estimated with it.

    Parameters
    ----------
    noise_sd : float
        Standard deviation of a sample's noise [y unit].
    y_amplitude : float
        Of the fundamental [y unit].
    samples : float
        In the window.
    """
    return ESTIMATED_TOO * noise_sd / y_amplitude * math.sqrt(2.0 / max(samples, 1.0))


def time_s(choice: Choice, periods: int) -> float:
    """Return the rig time that a limit cycle of so many whole periods is expected to take [s].

    Parameters
    ----------
    choice : Choice
        States the frequency.
    periods : int
        Whole periods.
    """
    return (periods + 0.1) * 2.0 * math.pi / choice.omega_rad_s


def allot(
    choices: Sequence[Choice], goal: Goal, gain_sd: float, least_periods: int, left_s: float, sure: float = 1.0
) -> tuple[int, ...]:
    """Share the remaining rig time among the points to come, in whole periods.

    Every point gets the least; then the point that would be known worst gets one more, until all are good enough or no
    further period fits.

    Parameters
    ----------
    choices : sequence of Choice
        The settings to come.
    goal : Goal
        Noise and sample time.
    gain_sd : float
        Relative standard deviation at which a point is good enough.
    least_periods : int
        Whole periods that an estimate needs.
    left_s : float
        Rig time that is left [s].
    sure : float
        Part of the foreseen amplitude that the first setting reaches for sure.
    """
    periods = [least_periods] * len(choices)
    left_s -= sum(time_s(choice, least_periods) for choice in choices)

    def sd(i: int) -> float:
        length_s = periods[i] * 2.0 * math.pi / choices[i].omega_rad_s
        amplitude = choices[i].y_amplitude * (sure if i == 0 else 1.0)
        return expected_sd(goal.noise_sd, amplitude, length_s / goal.sample_time_s)

    while True:
        fits = [
            i for i, choice in enumerate(choices) if sd(i) > gain_sd and 2.0 * math.pi / choice.omega_rad_s <= left_s
        ]
        if not fits:
            return tuple(periods)
        worst = max(fits, key=sd)
        periods[worst] += 1
        left_s -= 2.0 * math.pi / choices[worst].omega_rad_s
