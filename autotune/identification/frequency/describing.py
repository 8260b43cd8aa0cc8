"""Describing-function formulas (20)-(22) of Le & Mendes 2010, beside the Fourier ratio that does not need them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from autotune.identification.frequency.limit_cycle_points import LimitCycle


@dataclass(frozen=True, kw_only=True)
class DescribingFunctionEstimate:
    """What the first-harmonic formulas make of a limit cycle.

    Attributes
    ----------
    omega_rad_s : float
        omega_u = 2 pi / T_u, (22) [rad/s].
    gain : float
        pi a / (4 d), (21), with a and d the peak-to-peak values of y and u as read off the recording.
    phase_rad : float
        -180 deg + T omega_u, (20), of the positive-gain plant [rad].
    """

    omega_rad_s: float
    gain: float
    phase_rad: float


def describing_function(cycle: LimitCycle, delay_s: float) -> DescribingFunctionEstimate:
    """Evaluate (20)-(22) for a limit cycle under a relay with inserted delay.

    Parameters
    ----------
    cycle : LimitCycle
        The settled cycle with its Fourier-ratio points.
    delay_s : float
        Inserted delay T that was asked for [s].

    Notes
    -----
    The formulas are first-harmonic, and (20) counts the inserted delay only: hysteresis, hold and latency turn the
    phase as well and are not in it. On the plant (23) their errors are +14 to +54 % and -5 to -24 degrees.

    References
    ----------
    Le & Mendes, CIFA 2010, (20)-(22).
    """
    omega = cycle.points[0].omega_rad_s
    gain = math.pi * cycle.y_peak_to_peak / (4.0 * 2.0 * cycle.u_amplitude)
    return DescribingFunctionEstimate(omega_rad_s=omega, gain=gain, phase_rad=-math.pi + delay_s * omega)
