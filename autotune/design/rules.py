"""Tuning rules that engineers compare with: Ziegler-Nichols, Tyreus-Luyben, SIMC, AMIGO, lambda, relay experiment.

All give PI controllers from a plant that is fully known here, so that the rules are seen at their best: the ultimate
point is exact, and first-order models with dead time come from the exact step response or from the half rule.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.kernels import sampled_plant
from autotune.errors import DesignError
from autotune.models import TransferFunction


@dataclass(frozen=True, kw_only=True)
class FirstOrderModel:
    """K_p exp(-L s)/(1 + T s), or K_v exp(-L s)/s where T is infinite.

    Attributes
    ----------
    gain : float
        K_p [output per input unit], or K_v [output per input unit and second].
    T_s, L_s : float
        Lag and apparent dead time [s].
    """

    gain: float
    T_s: float
    L_s: float


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


def simc(plant: TransferFunction) -> PIDController:
    """Return Skogestad's PI with tau_c = theta on the half-rule model (2003): K = T/(K_p 2 theta), min(T, 8 theta)."""
    m = half_rule(plant)
    if m.L_s <= 0.0:
        raise DesignError("SIMC needs a dead time or a second lag", where="SIMC")
    slope = m.gain if math.isinf(m.T_s) else m.gain / m.T_s
    return PIDController(K=1.0 / (slope * 2.0 * m.L_s), Ti_s=min(m.T_s, 8.0 * m.L_s))


def amigo(plant: TransferFunction) -> PIDController:
    """Return AMIGO's PI (Astrom & Hagglund 2004) on the model of the step response."""
    m = step_response_model(plant)
    L, T = m.L_s, m.T_s
    if math.isinf(T):
        return PIDController(K=0.35 / (m.gain * L), Ti_s=13.4 * L)
    K = (0.15 + (0.35 - L * T / (L + T) ** 2) * T / L) / m.gain
    return PIDController(K=K, Ti_s=0.35 * L + 13.0 * L * T**2 / (T**2 + 12.0 * L * T + 7.0 * L**2))


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


def half_rule(plant: TransferFunction) -> FirstOrderModel:
    """Return Skogestad's half-rule model: half the largest neglected lag goes to the lag, the rest to the dead time."""
    lags = sorted((1.0 / -p.real for p in _stable_poles(plant)), reverse=True)
    inverse = sum(1.0 / z.real for z in plant.zeros if z.real > 0.0)
    if any(z.real < 0.0 for z in plant.zeros):
        raise DesignError("the half rule here knows no zeros in the left half plane", where="SIMC")
    gain = _low_frequency_gain(plant)
    if plant.integrators:
        rest = lags
        return FirstOrderModel(
            gain=gain, T_s=math.inf, L_s=plant.delay_s + inverse + (0.5 * rest[0] + sum(rest[1:]) if rest else 0.0)
        )
    half = 0.5 * lags[1] if len(lags) > 1 else 0.0
    return FirstOrderModel(gain=gain, T_s=lags[0] + half, L_s=plant.delay_s + inverse + half + sum(lags[2:]))


def step_response_model(plant: TransferFunction) -> FirstOrderModel:
    """Return the model of the step response: tangent of steepest slope for L, 63 % for T; asymptote if integrating."""
    gain = _low_frequency_gain(plant)
    lags = [1.0 / -p.real for p in _stable_poles(plant)]
    total = plant.delay_s + sum(1.0 / abs(p) ** 2 * 2 * -p.real if p.imag else 1.0 / -p.real for p in plant.poles if p)
    total = total + sum(1.0 / z.real for z in plant.zeros)
    if plant.integrators:  # the ramp's asymptote meets zero after the sum of lags and dead time
        return FirstOrderModel(gain=gain, T_s=math.inf, L_s=float(np.real(total)))
    t = np.linspace(0.0, 12.0 * (max(lags) + sum(lags)), 20_001)
    y = _step_response(plant, t) / gain
    slope = np.gradient(y, t)
    i = int(np.argmax(slope))
    L = plant.delay_s + max(float(t[i] - y[i] / slope[i]), 0.0)
    T = plant.delay_s + float(np.interp(1.0 - math.exp(-1.0), np.maximum.accumulate(y), t)) - L
    if L <= 0.0:
        raise DesignError("the step response shows no dead time", where="step response model")
    return FirstOrderModel(gain=gain, T_s=T, L_s=L)


def _stable_poles(plant: TransferFunction) -> list[complex]:
    if plant.integrators > 1 or any(p.real > 0.0 for p in plant.poles):
        raise DesignError("the rule is for stable plants with at most one integrator", where="tuning rule")
    return [complex(p) for p in plant.poles if p.real < 0.0]


def _low_frequency_gain(plant: TransferFunction) -> float:
    """Gain at s = 0, or of s H(s) where the plant integrates."""
    return plant.num[-1] / plant.den[-1 - plant.integrators]


def _step_response(plant: TransferFunction, t: FloatArray) -> FloatArray:
    """Step response of the rational part at uniform times, (N,)."""
    order = len(plant.den) - 1
    den = np.array(plant.den) / plant.den[0]
    num = np.concatenate((np.zeros(order + 1 - len(plant.num)), plant.num)) / plant.den[0]
    A = np.eye(order, k=-1)
    A[0] = -den[1:]
    C = num[1:] - num[0] * den[1:]
    block = np.zeros((order + 1, order + 1))
    block[:order, :order], block[0, order] = A, 1.0
    transition = expm(block * float(t[1] - t[0]))
    state = np.zeros(order + 1)
    state[order] = 1.0
    y = np.empty(len(t))
    for k in range(len(t)):
        y[k] = C @ state[:order] + num[0]
        state = transition @ state
    return y
