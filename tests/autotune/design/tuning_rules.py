"""Tuning rules that the synthesis is compared with, those of the product among them.

All give PI controllers from a plant that is fully known here, so that the rules are seen at their best.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq

from autotune.controller import PIDController
from autotune.design.kernels import sampled_plant
from autotune.design.rules import amigo, simc, step_response_model
from autotune.errors import DesignError
from autotune.models import TransferFunction


def ultimate_point(plant: TransferFunction) -> tuple[float, float]:
    """Return ultimate gain and period [s]: the lowest frequency at which the phase is -180 degrees.

    Raises
    ------
    DesignError
        The phase never falls to -180 degrees.
    """
    sampled = sampled_plant(plant)
    below = np.flatnonzero(sampled.phase <= -np.pi)
    if not len(below) or below[0] == 0:
        raise DesignError("the plant's phase never crosses -180 degrees", where="ultimate point")
    i = int(below[0])

    def imaginary(omega: float) -> float:
        return float((sampled.sign * plant.response(np.array([omega])))[0].imag)

    omega = brentq(imaginary, float(sampled.omega[i - 1]), float(sampled.omega[i]), xtol=1e-14, rtol=1e-13)
    gain = abs(plant.response(np.array([omega]))[0])
    return sampled.sign / float(gain), 2.0 * math.pi / omega


def relay_ultimate_point(plant: TransferFunction, harmonics: int = 400) -> tuple[float, float]:
    """Return what the classical relay experiment takes for ultimate gain and period: 4 d/(pi a) of its limit cycle.

    The limit cycle of an ideal relay is exact (Tsypkin): y at the switching instants vanishes with all odd harmonics,
    and a is half the peak-to-peak output. The describing function's error is thus in the result, as on a rig.

    Parameters
    ----------
    plant : TransferFunction
        Continuous, time in s.
    harmonics : int
        Odd harmonics of the limit cycle that are counted.

    Returns
    -------
    tuple of float
        Ultimate gain [u unit/y unit], and ultimate period [s].

    Raises
    ------
    DesignError
        An ideal relay does not make it oscillate.
    """
    K_u, T_u = ultimate_point(plant)
    sign = math.copysign(1.0, K_u)
    k = np.arange(1.0, 2.0 * harmonics, 2.0)

    def at_switching(log_omega: float) -> float:
        response = sign * plant.response(math.exp(log_omega) * k)
        return float(np.sum(response.imag / k))

    centre = math.log(2.0 * math.pi / T_u)
    trials = centre + np.linspace(-1.5, 1.0, 251)
    values = np.array([at_switching(trial) for trial in trials])
    rising = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    if not len(rising):
        raise DesignError("an ideal relay does not make the plant oscillate", where="relay experiment")
    omega = math.exp(brentq(at_switching, trials[rising[0]], trials[rising[0] + 1]))
    phase = np.linspace(0.0, np.pi, 801)
    response = plant.response(omega * k)
    y = 4.0 / np.pi * np.imag(np.exp(1j * np.outer(phase, k)) @ (response / k))
    return sign * 4.0 / (math.pi * float(np.max(np.abs(y)))), 2.0 * math.pi / omega


def ziegler_nichols(plant: TransferFunction) -> PIDController:
    """Return 0.45 K_u and T_u/1.2 (Ziegler & Nichols 1942, ultimate sensitivity)."""
    K_u, T_u = ultimate_point(plant)
    return PIDController(K=0.45 * K_u, Ti_s=T_u / 1.2)


def tyreus_luyben(plant: TransferFunction) -> PIDController:
    """Return K_u/3.2 and 2.2 T_u (Tyreus & Luyben 1992)."""
    K_u, T_u = ultimate_point(plant)
    return PIDController(K=K_u / 3.2, Ti_s=2.2 * T_u)


def relay_describing_function(plant: TransferFunction) -> PIDController:
    """Return Ziegler-Nichols' PI at the point that the relay experiment takes for the ultimate one."""
    K_u, T_u = relay_ultimate_point(plant)
    return PIDController(K=0.45 * K_u, Ti_s=T_u / 1.2)


def lambda_tuning(plant: TransferFunction) -> PIDController:
    """Return lambda tuning on the step response's model: closed-loop time constant T of a lag, 3 L of an integrator."""
    m = step_response_model(plant)
    if math.isinf(m.T_s):
        closed = 3.0 * m.L_s
        return PIDController(K=(2.0 * closed + m.L_s) / (m.gain * (closed + m.L_s) ** 2), Ti_s=2.0 * closed + m.L_s)
    return PIDController(K=m.T_s / (m.gain * (m.L_s + m.T_s)), Ti_s=m.T_s)


RULES = {
    "Ziegler-Nichols": ziegler_nichols,
    "Tyreus-Luyben": tyreus_luyben,
    "relay + describing function": relay_describing_function,
    "SIMC": simc,
    "AMIGO": amigo,
    "lambda": lambda_tuning,
}
