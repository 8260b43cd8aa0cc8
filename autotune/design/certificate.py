"""Lower bound on the H2 norm (11) of every PI that meets the specification: branch and bound over (K, k), k = K/T_I.

At one frequency 1/H + C runs through a rectangle of the complex plane as (K, k) runs through a box, so its largest and
smallest distance from 0 are known exactly. Hence, for all controllers of a box at once:

- ||.||_2^2 >= sum of weights/max abs(1/H + C)^2;
- the modulus margin is violated where max abs(1/H + C) < M_m/abs(H) at any one frequency;
- the phase or delay margin is violated where abs(L) passes 1 inside the forbidden sector for every member;
- the noise gain is violated where min abs(C) abs(1/H)/max abs(1/H + C), or min abs(C), is too large beyond the
  crossover of every member, or from omega_n on;
- nobody is stable where 0 stays outside the rectangles at all frequencies and the centre is unstable.
"""

from __future__ import annotations

import heapq
import math

import numpy as np
from numba import njit

from autotune.arrays import ComplexArray, FloatArray
from autotune.controller import PIDController
from autotune.design.kernels import SampledPlant, on_grid
from autotune.design.margins import Margins
from autotune.design.specification import Specification
from autotune.models import TransferFunction

_GAP = 0.005
_ROUNDED = 1.01
_MOST_EVALUATIONS = 60_000_000  # boxes times frequencies
_INTEGRAL_SPAN = 30.0
#: proportional part over the integral part at the crossover below which a box is not halved in K any more than in k
_SMALL_SHARE = 0.1


def lower_bound(
    H: TransferFunction,
    sampled: SampledPlant,
    specification: Specification,
    controller: PIDController,
    m: Margins,
) -> tuple[float | None, str]:
    """Return a lower bound on the norm over all PI that meet the specification, and what it covers; None without one.

    Parameters
    ----------
    H : TransferFunction
        The plant.
    sampled : SampledPlant
        The same on its grid.
    specification : Specification
        Constraints (18).
    controller : PIDController
        The design; sets the size of the searched domain.
    m : Margins
        Its margins and norm.

    Returns
    -------
    bound : float or None
        At most the design's norm, and below it by no more than half a per cent; None where the search ended before.
    statement : str
        Domain and gap, in a sentence.

    Notes
    -----
    Rigorous in the gains. In frequency it rests on the grid of 50 points per decade: quadrature of the norm (relative
    error of the order of 1e-4 on plants whose resonances the grid resolves), a phase between its values at neighbouring
    points (refined around the crossover), and no point of 1/H between two of them further from the nearer one
    than three quarters of their distance.
    """
    K_max = specification.largest_gain
    h2 = m.h2
    omega = sampled.omega[::2]
    if math.isfinite(m.crossover_rad_s):
        for span, count in ((1.6, 160), (1.1, 100)):
            omega = np.union1d(omega, np.geomspace(m.crossover_rad_s / span, m.crossover_rad_s * span, count))
    if H.delay_s > 0.0:  # where dead time still turns a gain that has not fallen
        audible = sampled.omega[np.abs(sampled.h) * K_max > 1.0]
        end = min(float(audible[-1]) if len(audible) else 0.0, 1000.0 / H.delay_s)
        omega = np.union1d(omega, np.arange(60.0 / H.delay_s, end, 0.15 / H.delay_s))
    plant = on_grid(H, omega, sampled.sign)
    L = np.abs(plant.h * controller.response(omega))
    crossover = float(omega[int(np.argmin(np.abs(np.log(np.maximum(L, 1e-300)))))])
    k_max = _INTEGRAL_SPAN * abs(controller.K) / controller.Ti_s
    omega_n = specification.noise_frequency_rad_s
    allowed, by_bound = specification.noise_gain, specification.noise == "bound"
    bound, boxes = _branch_and_bound(
        plant.omega,
        1.0 / plant.h,
        plant.weights,
        plant.phase,
        plant.turn,
        np.array([0.0, K_max, 0.0, k_max]),
        np.array(
            [
                specification.modulus_margin * (1.0 - 1e-6),
                specification.phase_margin_rad * (1.0 - 1e-6),
                specification.delay_margin_s * (1.0 - 1e-6),
                math.inf if by_bound else allowed * (1.0 + 1e-6),
                specification.modulus_margin * allowed * (1.0 + 1e-6) if by_bound else math.inf,
                -1.0 if omega_n is None else omega_n,
            ]
        ),
        h2 * h2,
        _GAP,
        _MOST_EVALUATIONS // len(plant.omega),
        _SMALL_SHARE / crossover,
    )
    lowest = min(math.sqrt(bound), h2)
    gap = h2 / lowest - 1.0
    if gap > _GAP * _ROUNDED:
        return None, f"no certificate: after {boxes} boxes the lower bound was still {100.0 * gap:.2g} % below the norm"
    return lowest, (
        f"no PI with abs(K) up to {K_max:.4g} and abs(K)/T_I up to {k_max:.4g} per second that meets the "
        f"specification has a norm below {lowest:.5g} (gap {100.0 * gap:.2g} %, {boxes} boxes examined)"
    )


@njit(cache=True, error_model="numpy")
def _bound(
    omega: FloatArray,
    q: ComplexArray,
    weights: FloatArray,
    phase: FloatArray,
    turn: float,
    box: tuple[float, float, float, float],
    limits: FloatArray,
) -> float:
    """Return a lower bound on the squared norm over the box, infinite where no member meets the specification."""
    K1, K2, k1, k2 = box
    modulus, phase_margin, delay_margin, noise, loudest, omega_n = limits
    total = 0.0
    above = below = False
    homogeneous = True
    K, k = 0.5 * (K1 + K2), 0.5 * (k1 + k2)
    crossings = 0
    size_before = 0.0
    first = before = 1.0 + 0.0j
    if omega_n < 0.0:  # the noise begins at the crossover: every member's lies at or below the first such frequency
        i = len(omega) - 1
        while i >= 0 and K2 * K2 + (k2 / omega[i]) ** 2 < q[i].real ** 2 + q[i].imag ** 2:
            omega_n = omega[i]
            i -= 1
        if omega_n < 0.0:
            omega_n = math.inf
    for i in range(len(omega)):
        w = omega[i]
        qr, qi = q[i].real, q[i].imag
        size = qr * qr + qi * qi
        a, b = qr + K1, qr + K2
        c, d = qi - k2 / w, qi - k1 / w
        far = max(a * a, b * b) + max(c * c, d * d)
        if far < modulus * modulus * size:
            return math.inf
        total += weights[i] / far
        smallest = K1 * K1 + (k1 / w) ** 2
        if w >= omega_n and (smallest * size > noise * noise * far or smallest > loudest * loudest):
            return math.inf
        # forbidden sector around -180 degrees: all members in it, and abs(L) = 1 passed by all of them
        late = phase[i] + math.pi - (math.atan2(k2 / w, K1) if k2 > 0.0 or K1 > 0.0 else 0.5 * math.pi)
        early = phase[i] + math.pi - (math.atan2(k1 / w, K2) if k1 > 0.0 or K2 > 0.0 else 0.0)
        if late > -phase_margin and early < max(phase_margin, min(delay_margin * w, math.pi)):
            above = above or smallest > size
            below = below or K2 * K2 + (k2 / w) ** 2 < size
            if above and below:
                return math.inf
        else:
            above = below = False
        near = 0.0
        if a > 0.0 or b < 0.0:
            near += min(a * a, b * b)
        if c > 0.0 or d < 0.0:
            near += min(c * c, d * d)
        if i > 0 and homogeneous:
            moved = abs(q[i] - q[i - 1]) + k2 * (1.0 / omega[i - 1] - 1.0 / w)
            small = min(size, size_before) > K2 * K2 + (k2 / omega[i - 1]) ** 2  # abs(L) < 1 from point to point
            homogeneous = small or near > 0.5625 * moved * moved
        size_before = size
        F = 1.0 + complex(K, -k / w) / q[i]
        if i == 0:
            first = F
        elif (before.imag < 0.0) != (F.imag < 0.0):
            real = before.real - before.imag * (F.real - before.real) / (F.imag - before.imag)
            if real < 0.0:
                crossings += 1 if before.imag >= 0.0 else -1
        before = F
    if homogeneous:
        end = math.atan2(before.imag, before.real) - math.atan2(first.imag, first.real)
        if round((end + 2.0 * math.pi * crossings + turn) / math.pi) != 0:
            return math.inf
    return total


@njit(cache=True, error_model="numpy")
def _branch_and_bound(
    omega: FloatArray,
    q: ComplexArray,
    weights: FloatArray,
    phase: FloatArray,
    turn: float,
    domain: FloatArray,
    limits: FloatArray,
    best: float,
    gap: float,
    most: int,
    of_integral: float,
) -> tuple[float, int]:
    """Best-first search; returns the lower bound on the squared norm and the number of boxes examined.

    ``of_integral`` is the K per k below which the proportional part does nothing [s].
    """
    box = (domain[0], domain[1], domain[2], domain[3])
    heap = [(_bound(omega, q, weights, phase, turn, box, limits), box)]
    count = 1
    enough = best / (1.0 + gap) ** 2
    while len(heap) > 0 and count < most:
        bound, box = heap[0]
        if bound >= enough:
            return min(bound, best), count
        heapq.heappop(heap)
        K1, K2, k1, k2 = box
        # relative widths; of a K beside whose integral part it does nothing at the crossover none is worth halving
        if (K2 - K1) * k2 > (k2 - k1) * max(K2, k2 * of_integral):
            K = 0.5 * (K1 + K2)
            halves = ((K1, K, k1, k2), (K, K2, k1, k2))
        else:
            k = 0.5 * (k1 + k2)
            halves = ((K1, K2, k1, k), (K1, K2, k, k2))
        for half in halves:
            value = max(bound, _bound(omega, q, weights, phase, turn, half, limits))
            count += 1
            if value < best:
                heapq.heappush(heap, (value, half))
    return (min(heap[0][0], best) if len(heap) > 0 else best), count
