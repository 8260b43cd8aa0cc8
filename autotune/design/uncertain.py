"""The plants that measured points leave possible, sampled in frequency, and the margins that all of them have."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit

from autotune.arrays import FloatArray
from autotune.design.figures import Figures
from autotune.design.kernels import SampledPlant
from autotune.design.process_class import DIRECTIONS, ConsistentProcesses, consistent_processes
from autotune.points import FrequencyPoint

_SUBNODES = 12
_BELOW, _ABOVE = 8.0, 5.0  # how far the guarantee is checked beyond the points; bounds on gain take over from there


@dataclass(frozen=True, kw_only=True, eq=False)
class UncertainPlant:
    """All plants that agree with the points, frequency by frequency, and the nominal one.

    Attributes
    ----------
    omega : (M,) array
        Frequencies at which the set is known [rad/s], ascending.
    supports : (M, DIRECTIONS) array
        Support values of the set in (log gain, phase), slack for the way to the neighbouring frequencies included.
    nominal : SampledPlant
        The member without a zero that is closest to the points, for the norm.
    processes : ConsistentProcesses
        Where it comes from.
    members : tuple of SampledPlant
        Plants beside the set, resonant ones among them, that a controller must suit as well.
    """

    omega: FloatArray
    supports: FloatArray
    nominal: SampledPlant
    processes: ConsistentProcesses
    members: tuple[SampledPlant, ...] = ()

    def thinned(self, step: int) -> UncertainPlant:
        """Return the set at every ``step``-th frequency and the last, for a coarse look."""
        kept = np.append(np.arange(0, len(self.omega) - 1, step), len(self.omega) - 1)
        return UncertainPlant(
            omega=self.omega[kept],
            supports=self.supports[kept],
            nominal=self.nominal.thinned(step),
            processes=self.processes,
            members=self.members,
        )


@lru_cache(maxsize=4)  # PI and PID, or two specifications, are often designed on the same points
def uncertain_plant(points: tuple[FrequencyPoint, ...]) -> UncertainPlant:
    """Return what the points, at least three with covariance, say about the plant, between and beyond them.

    Raises
    ------
    DesignError
        See :func:`autotune.design.process_class.consistent_processes`.
    """
    processes = consistent_processes(points)
    first, last = processes.omega_points[0], processes.omega_points[-1]
    inner = np.geomspace(0.7 * first, 1.5 * last, int(math.log(1.5 * last / (0.7 * first)) / 0.12) + 2)
    below = np.geomspace(first / _BELOW, 0.7 * first, 7)[:-1]
    above = np.geomspace(1.5 * last, _ABOVE * last, 6)[1:]
    nodes = np.concatenate((below, inner, above))
    supports, curvature = processes.supports(nodes), processes.curvatures(nodes)
    share = np.arange(_SUBNODES) / _SUBNODES
    steps = np.diff(np.log(nodes))
    omega = np.append((nodes[:-1, None] * np.exp(share * steps[:, None])).ravel(), nodes[-1])
    # a curve in (log gain, phase) leaves its chord by at most t (1 - t) step^2/2 times its second derivative
    bend = np.maximum(curvature[:-1], curvature[1:])[:, None] * 0.5 * share * (1.0 - share) * steps[:, None] ** 2
    between = supports[:-1, None, :] + share[:, None] * (supports[1:, None, :] - supports[:-1, None, :])
    slack = bend + 0.125 * np.maximum(curvature[:-1], curvature[1:])[:, None] * (steps[:, None] / _SUBNODES) ** 2
    values = (between + slack[:, :, None]).reshape(-1, DIRECTIONS)
    return UncertainPlant(
        omega=omega,
        supports=np.vstack((values, supports[-1])),
        nominal=_nominal(processes),
        processes=processes,
    )


def _nominal(processes: ConsistentProcesses) -> SampledPlant:
    omega = np.geomspace(processes.omega_points[0] * 1e-4, processes.omega_points[-1] * 1e2, 1200)
    log_gain, phase = processes.nominal_log(omega)
    steps = np.diff(np.log(omega))
    weights = np.zeros(len(omega))
    weights[:-1] += 0.5 * steps
    weights[1:] += 0.5 * steps
    weights[0] += 1.0
    # open loop in the left half plane but for integrators: the curve starts at arg L and must end at 0 with no turn
    turn = float(phase[0]) - 0.5 * np.pi
    return SampledPlant(
        omega=omega,
        h=np.exp(log_gain + 1j * phase),
        weights=weights / (np.pi * omega),
        turn=turn,
        sign=processes.sign,
    )


@njit(cache=True, error_model="numpy")
def _margins_at_unit_gain(
    b: FloatArray, h: FloatArray, h_next: FloatArray, w: float, w_next: float
) -> tuple[float, float]:
    """Return the least phase and delay margins at log gain 0 between two frequencies; 1e300 where none is there.

    On that way the supports are h + s (h_next - h), s from 0 to 1. The hull of both sets holds it too, but makes steps
    as wide as the grid while the gain grows, in whose corners a search ends.
    """
    first, last = 0.0, 1.0
    n = len(b)
    for d in range(n):  # b_d p <= h_d(s) leaves a phase p where each bound from below is below each from above
        for e in range(n):
            if b[d] < -1e-9 and b[e] > 1e-9:
                at_0, at_1 = h[d] * b[e] - h[e] * b[d], h_next[d] * b[e] - h_next[e] * b[d]
            elif d == e and abs(b[d]) <= 1e-9:
                at_0, at_1 = h[d], h_next[d]
            else:
                continue
            if at_0 < 0.0 and at_1 < 0.0:
                return 1e300, 1e300
            if at_0 < 0.0:
                first = max(first, at_0 / (at_0 - at_1))
            elif at_1 < 0.0:
                last = min(last, at_0 / (at_0 - at_1))
    phase = delay = 1e300
    if first > last:
        return phase, delay
    for d in range(n):  # the bound from below is convex in s: least at an end, or where two of its lines meet
        for e in range(d, n):
            if b[d] >= -1e-9 or b[e] >= -1e-9:
                continue
            level, slope = h[d] / b[d] - h[e] / b[e], (h_next[d] - h[d]) / b[d] - (h_next[e] - h[e]) / b[e]
            meets = -level / slope if slope != 0.0 else first
            for s in (first, last, min(max(meets, first), last)):
                lowest = -1e300
                for k in range(n):
                    if b[k] < -1e-9:
                        lowest = max(lowest, (h[k] + s * (h_next[k] - h[k])) / b[k])
                phase = min(phase, lowest + math.pi)
                delay = min(delay, (lowest + math.pi) / (w + s * (w_next - w)))
    return phase, delay


@njit(cache=True, error_model="numpy")
def _nearest_to_critical(a: FloatArray, b: FloatArray, h: FloatArray) -> float:
    """Return min abs(1 + L)^2 on the border of a set of L given by its supports."""
    n = len(a)
    sine = b[1]
    nearest = 1e300
    for d in range(n):
        # vertex between the tangents d and d + 1, the next vertex, and two points on the edge between them
        e, f = (d + 1) % n, (d + 2) % n
        g0, p0 = (h[d] * b[e] - h[e] * b[d]) / sine, (h[e] * a[d] - h[d] * a[e]) / sine
        g1, p1 = (h[e] * b[f] - h[f] * b[e]) / sine, (h[f] * a[e] - h[e] * a[f]) / sine
        for k in range(3):
            g, p = g0 + (g1 - g0) * k / 3.0, p0 + (p1 - p0) * k / 3.0
            size = math.exp(g)
            nearest = min(nearest, 1.0 + 2.0 * size * math.cos(p) + size * size)
    return nearest


@njit(cache=True, error_model="numpy")
def guaranteed_figures(
    omega: FloatArray, supports: FloatArray, K: float, Ti: float, Td: float, Tf: float, omega_n: float
) -> tuple[Figures, float]:
    """Return the figures that every plant of the set keeps (no norm among them), and its gain margin.

    The modulus margin is negative where the set does not decide: abs(L) is not surely above 1 + itself at the lowest
    frequency and below 1 - itself at the highest. The noise begins at ``omega_n``, or where ``omega_n`` is below 0 at
    the lowest crossover that a plant of the set can have.

    Parameters
    ----------
    omega : (N,) array
        Angular frequencies [rad/s], ascending.
    supports : (N, D) array
        Support values of each set of plants, in log gain and phase [rad], over D directions.
    K : float
        Gain, sign taken out [u unit/y unit].
    Ti, Td, Tf : float
        Times of integral, derivative and filter [s].
    omega_n : float
        Lowest frequency of the noise [rad/s]; below 0 the lowest crossover that a plant of the set can have.
    """
    directions = supports.shape[1]
    step = 2.0 * math.pi / directions
    a, b = np.cos(step * np.arange(directions)), np.sin(step * np.arange(directions))
    least = 1.0  # of abs(1 + L)^2: L ends at 0
    phase = math.pi
    delay = 1e300
    growth = -1e300
    noise = loudest = 0.0
    crossed = False
    h = np.empty(directions)  # support values of L at this frequency, and at the one before
    h_before = np.empty(directions)
    for i in range(len(omega)):
        w = omega[i]
        C = complex(K, K * (Td * w - 1.0 / (Ti * w))) / complex(1.0, Tf * w)
        h, h_before = h_before, h
        gain_C, phase_C = math.log(abs(C)), math.atan2(C.imag, C.real)
        for d in range(directions):  # entry by entry: an assigned slice is compiled with the text of its error
            h[d] = supports[i, d] + a[d] * gain_C + b[d] * phase_C
        near_unit = max(h[0], h_before[0]) >= 0.0 and max(h[directions // 2], h_before[directions // 2]) >= 0.0
        if i > 0 and near_unit:
            angle, least_s = _margins_at_unit_gain(b, h_before, h, omega[i - 1], w)
            if angle < 1e299:
                phase, delay, crossed = min(phase, angle), min(delay, least_s), True
        # what is surely above 1, as below the crossover of an integrating plant, no larger gain brings to -1
        if -h[3 * directions // 4] <= -math.pi and h[directions // 2] > 0.0:
            growth = max(growth, h[0])
        smallest, largest = math.exp(-h[directions // 2]), math.exp(h[0])
        # no point of the set is nearer than its gains and its phases say: most sets need no closer look
        nearest = max(smallest - 1.0, 1.0 - largest, 0.0) ** 2
        turn = min(math.pi - h[directions // 4], math.pi - h[3 * directions // 4])
        nearest = max(nearest, 1.0 if turn >= 0.5 * math.pi else math.sin(max(turn, 0.0)) ** 2)
        audible = w >= omega_n if omega_n >= 0.0 else crossed
        size = abs(C)
        if nearest < least or (audible and size * size > noise * noise * nearest):
            nearest = _nearest_to_critical(a, b, h)
            least = min(least, nearest)
        if audible:
            loudest, noise = max(loudest, size), max(noise, size / math.sqrt(max(nearest, 1e-300)))
    modulus = math.sqrt(least)
    C_low = complex(K, K * (Td * omega[0] - 1.0 / (Ti * omega[0]))) / complex(1.0, Tf * omega[0])
    C_high = complex(K, K * (Td * omega[-1] - 1.0 / (Ti * omega[-1]))) / complex(1.0, Tf * omega[-1])
    at_least = math.exp(-supports[0, directions // 2]) * abs(C_low)
    at_most = math.exp(supports[-1, 0]) * max(abs(C_high), K * max(1.0, Td / Tf if Tf > 0.0 else 1.0))
    if at_least < 1.0 + modulus or at_most > 1.0 - modulus:
        modulus = min(modulus, at_least - 1.0, 1.0 - at_most)
    gain = math.exp(-max(growth, math.log(at_most)))
    if 0.0 < modulus < 1.0:
        gain = max(gain, 1.0 / (1.0 - modulus))  # 1 - abs(L) >= M_m where L crosses the negative axis above -1
    beyond = abs(K) * max(1.0, Td / Tf if Tf > 0.0 else 1.0)  # above the highest frequency abs(1 + L) is near 1
    loudest, noise = max(loudest, beyond), max(noise, beyond / max(1.0 - at_most, 1e-300))
    return Figures(math.nan, modulus, phase, delay, noise, loudest), gain
