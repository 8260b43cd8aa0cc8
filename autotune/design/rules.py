"""Tuning rules that engineers compare with: SIMC and AMIGO.

Both give PI controllers from a plant that is fully known here, so that the rules are seen at their best: first-order
models with dead time come from the exact step response or from the half rule.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from autotune.arrays import FloatArray
from autotune.controller import PIDController
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
