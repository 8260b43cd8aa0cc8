"""An independent look for a better controller: random search all over the gains, on a loop evaluated by other code.

Nothing of the synthesis is used: the loop is sampled here, stability is counted here (Mikhailov, by accumulated
argument), and differential evolution knows nothing of basins. What it finds is a controller that keeps the constraints
with a little to spare, so that a refusal beside it is contradicted, and a larger norm is a missed optimum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import differential_evolution

from autotune.arrays import ComplexArray, FloatArray
from autotune.models import TransferFunction

_PER_DECADE = 120


@dataclass(frozen=True, kw_only=True)
class Found:
    """The best controller of the search: (K, T_I, T_d, T_f), K with the plant's sign, and its norm (11)."""

    gains: tuple[float, float, float, float]
    h2: float


def frequencies(plant: TransferFunction) -> FloatArray:
    """Return frequencies that resolve poles, zeros and dead time."""
    roots = np.concatenate((plant.poles, plant.zeros))
    corners = np.abs(roots)[np.abs(roots) > 0.0]
    if plant.delay_s > 0.0:
        corners = np.append(corners, 1.0 / plant.delay_s)
    omega = np.geomspace(
        1e-4 * corners.min(), 1e3 * corners.max(), int(_PER_DECADE * math.log10(1e7 * corners.max() / corners.min()))
    )
    parts = [omega]
    for root in roots:
        if abs(root.imag) > abs(root.real):
            offsets = np.geomspace(0.05 * max(abs(root.real), 1e-5 * abs(root)), 0.5 * abs(root), 60)
            parts += [abs(root) + offsets, abs(root) - offsets]
    if plant.delay_s > 0.0:
        parts.append(np.arange(1.0, 60.0, 0.08) / plant.delay_s)
    return np.unique(np.concatenate(parts))


@njit(cache=True)
def _judge(
    omega: FloatArray, num: ComplexArray, den: ComplexArray, K: float, Ti: float, Td: float, Tf: float, order: int
) -> tuple[float, float, float, float]:
    """Return squared norm, modulus margin (negative where unstable), phase margin [rad] and noise gain."""
    turn, norm, least = 0.0, 0.0, 1e300
    phase, noise = math.pi, 0.0
    before = 1.0 + 0.0j
    f_before = w_before = size_before = 0.0
    crossed = -1.0
    for i in range(len(omega)):
        w = omega[i]
        s = complex(0.0, w)
        filtered = 1.0 + Tf * s
        top, bottom = K * (1.0 + Ti * s + Td * Ti * s * s), Ti * s * filtered
        D = bottom * den[i] + top * num[i]
        if i == 0:
            turn = math.atan2(D.imag, D.real)
            if abs(turn) > 0.5 * math.pi:
                turn -= math.copysign(math.pi, turn)
        else:
            step = D / before
            turn += math.atan2(step.imag, step.real)
        before = D
        L = top * num[i] / (bottom * den[i])
        closed = abs(1.0 + L)
        least = min(least, closed)
        f = (abs(num[i] / den[i]) / closed / w) ** 2
        if i > 0:
            norm += 0.5 * (f + f_before) * (w - w_before)
        else:
            norm += f * w
        size = abs(L)
        if i > 0 and (size - 1.0) * (size_before - 1.0) < 0.0:
            angle = math.atan2(-L.imag, -L.real)
            phase = angle if abs(angle) < abs(phase) else phase
            crossed = omega[i - 1]  # the noise gain is looked for from before the crossover on
        f_before, w_before, size_before = f, w, size
    if crossed > 0.0:
        for i in range(len(omega)):
            if omega[i] >= crossed:
                s = complex(0.0, omega[i])
                C = K * (1.0 + 1.0 / (Ti * s) + Td * s) / (1.0 + Tf * s)
                noise = max(noise, abs(C / (1.0 + C * num[i] / den[i])))
    stable = round((0.5 * math.pi * order - turn) / math.pi) == 0
    return norm / math.pi, least if stable else -least, phase, noise


def figures(plant: TransferFunction, controller: TransferFunction) -> tuple[bool, float, float, float, float]:
    """Return whether the loop is stable, and its modulus, phase [rad], delay [s] and gain margin, on a plain grid.

    Stability is counted by the argument of the characteristic polynomial, which turns by 90 degrees times its order.
    """
    top, bottom = np.polymul(plant.num, controller.num), np.polymul(plant.den, controller.den)
    omega = frequencies(TransferFunction(num=tuple(top), den=tuple(bottom), delay_s=plant.delay_s))
    s = 1j * omega
    open_, closed = np.polyval(top, s) * np.exp(-s * plant.delay_s), np.polyval(bottom, s)
    D = open_ + closed
    begin = math.atan2(D[0].imag, D[0].real)
    begin -= math.pi * round(begin / math.pi)
    turn = begin + float(np.sum(np.angle(D[1:] / D[:-1])))
    stable = round((0.5 * math.pi * (len(bottom) - 1) - turn) / math.pi) == 0
    L = open_ / closed
    size, angle = np.log(np.abs(L)), np.angle(-L)
    phase, delay, gain = math.pi, math.inf, math.inf
    for k in np.flatnonzero(size[1:] * size[:-1] < 0.0):
        share = size[k] / (size[k] - size[k + 1])
        at = float(np.angle(-L[k] * np.exp(1j * share * np.angle(L[k + 1] / L[k]))))
        phase = min(phase, abs(at), key=abs)
        delay = min(delay, (at % (2.0 * math.pi)) / float(omega[k] + share * (omega[k + 1] - omega[k])))
    for k in np.flatnonzero((angle[1:] * angle[:-1] < 0.0) & (np.abs(angle[1:] - angle[:-1]) < math.pi)):
        share = angle[k] / (angle[k] - angle[k + 1])
        at = math.exp(-float(size[k] + share * (size[k + 1] - size[k])))
        gain = min(gain, at if at > 1.0 else math.inf)
    return stable, float(np.min(np.abs(1.0 + L))), phase, delay, gain


def search(
    plant: TransferFunction, kind: str, modulus: float, phase_rad: float, noise_gain: float, seed: int = 0
) -> Found | None:
    """Return the best controller that keeps the constraints with 0.2 % to spare; None where the search finds none."""
    omega = frequencies(plant)
    s = 1j * omega
    sign = math.copysign(1.0, plant.num[-1] * plant.den[0])
    scale = plant.den[0]
    num = sign * np.polyval(plant.num, s) / scale * np.exp(-s * plant.delay_s)
    den = np.polyval(plant.den, s) / scale
    order = len(plant.den) + (1 if kind == "pid" else 0)
    low, high = math.log(omega[0] * 30.0), math.log(omega[-1] / 30.0)
    bounds = [(math.log(noise_gain) - 16.0, math.log(noise_gain)), (-high, -low)]
    if kind == "pid":
        bounds += [(math.log(0.01), math.log(4.0)), (math.log(0.005), math.log(3.0))]

    def gains(x: FloatArray) -> tuple[float, float, float, float]:
        K, Ti = math.exp(x[0]), math.exp(x[1])
        if kind != "pid":
            return K, Ti, 0.0, 0.0
        Td = Ti * math.exp(x[2])
        return K, Ti, Td, Td * math.exp(x[3])

    def cost(x: FloatArray) -> float:
        norm, m, phase, noise = _judge(omega, num, den, *gains(x), order)
        if m <= 0.0 or not math.isfinite(norm):
            return 1e6
        missed = max(1.002 * modulus / m - 1.0, 1.002 * phase_rad / max(phase, 1e-9) - 1.0 if phase > 0.0 else 1e3)
        missed = max(missed, 1.002 * noise / noise_gain - 1.0)
        return 0.5 * math.log(norm) if missed <= 0.0 else 1e3 + min(missed, 1e3)

    result = differential_evolution(
        cost, bounds, seed=seed, popsize=25, maxiter=60 if kind == "pi" else 150, tol=1e-7, polish=False
    )
    if result.fun >= 1e3:
        return None
    K, *rest = gains(result.x)
    return Found(gains=(sign * K, *rest), h2=math.exp(float(result.fun)))
