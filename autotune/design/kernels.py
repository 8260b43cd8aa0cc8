"""Inner loops of the synthesis, compiled: one controller on a sampled plant in some ten microseconds.

H/(1 + L) = 1/(1/H + C): at one frequency a constraint is a circle in the plane of C, an ellipse in that of (K, K/T_I).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from autotune.arrays import ComplexArray, FloatArray
from autotune.design.axis import characteristic_frequencies, corner_frequencies
from autotune.design.figures import Figures
from autotune.errors import DesignError
from autotune.models import TransferFunction

#: widest grid, highest over lowest frequency: further apart no two features of a plant are
_WIDEST = 1e40
_POINTS_PER_DECADE = 100


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledPlant:
    """A plant at the frequencies that a synthesis looks at.

    Attributes
    ----------
    omega : (N,) array
        Angular frequencies [rad/s], ascending.
    h : (N,) complex array
        H(j omega) with the plant's sign taken out.
    weights : (N,) array
        Quadrature weights of the squared norm (11): sum of weights abs(h/(1 + h C))^2.
    turn : float
        Argument change of the open loop's denominator along the grid, integrator of C included [rad].
    sign : float
        Sign that the gain of a stabilising PI has: the low-frequency gain's, reversed by every unstable pole.
    """

    omega: FloatArray
    h: ComplexArray
    weights: FloatArray
    turn: float
    sign: float

    def thinned(self, step: int) -> SampledPlant:
        """Return the plant at every ``step``-th frequency, for a coarse look."""
        weights = np.add.reduceat(self.weights * self.omega**2, np.arange(0, len(self.omega), step))
        omega, h = self.omega[::step].copy(), self.h[::step].copy()  # strided arrays would have their own kernels
        return SampledPlant(omega=omega, h=h, weights=weights / omega**2, turn=self.turn, sign=self.sign)

    @property
    def phase(self) -> FloatArray:
        """Unwrapped arg H [rad], sign taken out."""
        return np.asarray(np.unwrap(np.angle(self.h)))


def sampled_plant(plant: TransferFunction, largest_gain: float = 1.0) -> SampledPlant:
    """Return the plant on a logarithmic grid, refined where dead time asks for it.

    The grid covers the plant's features and the crossovers that gains up to ``largest_gain`` give it.

    Parameters
    ----------
    plant : TransferFunction
        H, time in s.
    largest_gain : float
        Largest abs(C) that a design may use [u unit/y unit].

    Raises
    ------
    DesignError
        A plant that is zero, that differentiates, whose dead time the grid cannot resolve, or whose features are more
        than 34 decades apart.
    """
    num, den = np.array(plant.num), np.array(plant.den)
    if not np.any(num):
        raise DesignError("the plant is zero", where="plant", remedy="check the model's numerators")
    if num[-1] == 0.0:
        raise DesignError(
            "the plant has no gain at low frequency (a zero at s = 0)",
            where="plant",
            remedy="integral action cannot remove a disturbance there; design another structure",
        )
    # s den + num K/T_I needs its last coefficient of its first one's sign: necessary with integral action
    sign = math.copysign(1.0, num[-1] * den[0])
    most = sign * largest_gain
    loudest = TransferFunction(num=tuple(most * b for b in plant.num), den=plant.den, delay_s=plant.delay_s)
    corners = characteristic_frequencies(loudest)
    low, high = corners[0] * 1e-4, corners[-1] * 1e2
    if not high < _WIDEST * low:  # also where one of them is not a number
        raise DesignError(
            f"what matters of this plant and these gains lies from {corners[0]:.3g} to {corners[-1]:.3g} rad/s",
            where="plant",
            remedy="check the model's units and the noise gain that is asked for",
        )
    # the plant's own grid, whatever gains and units: they decide how far it reaches, no digit of what is read between
    own = min(corner_frequencies(plant), default=corners[0])
    first, last = (_POINTS_PER_DECADE * math.log10(end / own) for end in (low, high))
    omega = own * 10.0 ** (np.arange(math.floor(first), math.ceil(last) + 1) / _POINTS_PER_DECADE)
    if plant.delay_s > 0.0:
        step = 0.1 / plant.delay_s
        fine = np.arange(step * _POINTS_PER_DECADE / math.log(10.0), 80.0 / plant.delay_s, step)
        outer = omega[(omega < fine[0] - 0.5 * step) | (omega > fine[-1] + 0.5 * step)]
        omega = np.sort(np.concatenate((outer, fine)))
    for root in np.concatenate((plant.poles, plant.zeros)):
        if abs(root.imag) > 3.0 * abs(root.real):
            offsets = np.geomspace(0.05 * max(abs(root.real), 1e-6 * abs(root)), abs(root.imag), 80)
            near = np.concatenate((abs(root.imag) - offsets, [abs(root.imag)], abs(root.imag) + offsets))
            omega = np.unique(np.concatenate((omega, near[(near > low) & (near < high)])))
    return on_grid(plant, omega, sign)


def on_grid(plant: TransferFunction, omega: FloatArray, sign: float) -> SampledPlant:
    """Return the plant at the given frequencies, which reach a decade beyond all its features.

    Parameters
    ----------
    plant : TransferFunction
        H, time in s.
    omega : (N,) array
        Angular frequencies [rad/s], ascending.
    sign : float
        1 or -1, the sign that the gain of a stabilising PI has.

    Raises
    ------
    DesignError
        A pole or a zero on the imaginary axis at one of them.
    """
    h = sign * plant.response(omega)
    if not np.all(np.isfinite(h)) or not np.all(np.abs(h) > 0.0):
        raise DesignError(
            "the plant's response has a pole or a zero on the imaginary axis", where="plant", remedy="move it aside"
        )
    return SampledPlant(
        omega=omega, h=h, weights=_h2_weights(omega, plant), turn=_denominator_turn(omega, plant), sign=sign
    )


def _h2_weights(omega: FloatArray, plant: TransferFunction) -> FloatArray:
    """Trapezoidal weights in log omega, tails folded into the ends; exponentially accurate on a uniform log grid."""
    steps = np.diff(np.log(omega))
    weights = np.zeros(len(omega))
    weights[:-1] += 0.5 * steps
    weights[1:] += 0.5 * steps
    weights = weights * omega  # d omega = omega d(log omega)
    weights[0] += omega[0]  # the integrand is its limit below the grid
    weights[-1] += omega[-1] / (2 * (len(plant.den) - len(plant.num)) + 1)
    return np.asarray(weights / (np.pi * omega**2))


def _denominator_turn(omega: FloatArray, plant: TransferFunction) -> float:
    """Argument change of s den(s)/(s + a)^(n+1) along the grid, root by root, so that no step can be missed."""
    a = float(np.sqrt(omega[0] * omega[-1]))
    roots = np.append(np.roots(plant.den), 0.0)

    def change(root: complex) -> float:
        end, start = 1j * omega[-1] - root, 1j * omega[0] - root
        # along the axis the argument of j omega - root turns monotonically by less than pi
        angle = float(np.angle(end / start))
        return angle if root.real <= 0.0 or angle <= 0.0 else angle - 2.0 * np.pi

    shift = float(np.angle((1j * omega[-1] + a) / (1j * omega[0] + a)))
    return sum(change(complex(root)) for root in roots) - len(roots) * shift


@njit(cache=True, error_model="numpy")
def evaluate(
    omega: FloatArray,
    h: ComplexArray,
    weights: FloatArray,
    turn: float,
    K: float,
    Ti: float,
    Td: float,
    Tf: float,
    omega_n: float,
) -> Figures:
    """Return the figures of one controller on a sampled plant.

    ``omega_n`` below 0 stands for the highest crossover, which is interpolated: the noise gain must not jump while the
    crossover moves between two frequencies of the grid.

    Parameters
    ----------
    omega : (N,) array
        Angular frequencies [rad/s], ascending.
    h : (N,) complex array
        H(j omega), sign taken out.
    weights : (N,) array
        Quadrature weights of the squared norm (11).
    turn : float
        Argument change of the open loop's denominator along the grid [rad].
    K : float
        Gain, sign taken out [u unit/y unit].
    Ti, Td, Tf : float
        Times of integral, derivative and filter [s].
    omega_n : float
        Lowest frequency of the noise [rad/s]. Below 0 it stands for the highest crossover, which is interpolated: the
        noise gain must not jump while the crossover moves between two frequencies of the grid.
    """
    h2 = 0.0
    smallest = 1e300
    phase = math.pi
    delay = 1e300
    noise = loudest = 0.0  # squares of (15) and (16)
    crossings = 0
    f0 = f1 = 1e300
    power0 = 0.0
    before = 1.0 + 0.0j
    first = 1.0 + 0.0j
    L_before = 0.0j
    gain_before = 1.0
    for i in range(len(omega)):
        w = omega[i]
        C = complex(K, K * (Td * w - 1.0 / (Ti * w)))
        if Tf > 0.0:
            C = C * complex(1.0, -Tf * w) / (1.0 + Tf * w * Tf * w)
        L = C * h[i]
        F = 1.0 + L
        f = F.real * F.real + F.imag * F.imag
        inverse = 1.0 / f
        h2 += weights[i] * (h[i].real * h[i].real + h[i].imag * h[i].imag) * inverse
        if i >= 2 and f1 <= f0 and f1 <= f:
            curvature = f - 2.0 * f1 + f0
            value = f1 - (f - f0) ** 2 / (8.0 * curvature) if curvature > 0.0 else f1
            smallest = min(smallest, max(value, 0.5 * f1))
        smallest = min(smallest, f)
        f0, f1 = f1, f
        power = L.real * L.real + L.imag * L.imag
        if i == 0:
            first = F
        else:
            if (before.imag < 0.0) != (F.imag < 0.0):  # crossing of the real axis: left of 0 the argument wraps
                real = before.real - before.imag * (F.real - before.real) / (F.imag - before.imag)
                if real < 0.0:
                    crossings += 1 if before.imag >= 0.0 else -1
            if (power0 < 1.0) != (power < 1.0):
                share = math.log(power0) / (math.log(power0) - math.log(power))
                ratio = L / L_before
                angle = math.atan2(-L_before.imag, -L_before.real) + share * math.atan2(ratio.imag, ratio.real)
                if abs(angle) < abs(phase):
                    phase = angle
                at = omega[i - 1] * (w / omega[i - 1]) ** share
                delay = min(delay, (angle if angle > 0.0 else angle + 2.0 * math.pi) / at)
                if omega_n < 0.0:  # abs(1 + L) = 2 sin(abs(angle)/2) where abs(L) = 1
                    before_C, now_C = power0 / gain_before, power / (h[i].real * h[i].real + h[i].imag * h[i].imag)
                    loudest = before_C * (now_C / before_C) ** share
                    noise = loudest / (4.0 * math.sin(0.5 * angle) ** 2)
        gain_before = h[i].real * h[i].real + h[i].imag * h[i].imag
        if w >= omega_n:
            size = C.real * C.real + C.imag * C.imag
            loudest, noise = max(loudest, size), max(noise, size * inverse)
        before, L_before, power0 = F, L, power
    if omega_n < 0.0 and phase == math.pi and delay > 1e299:  # no crossover on the grid: it lies below, and is no loop
        noise = loudest = 1e300
    end = math.atan2(before.imag, before.real) - math.atan2(first.imag, first.real)
    modulus = math.sqrt(smallest)
    if round((end + 2.0 * math.pi * crossings + turn) / math.pi) != 0:
        modulus = -modulus
    return Figures(h2, modulus, phase, delay, math.sqrt(noise), math.sqrt(loudest))


@njit(cache=True)
def evaluate_grid(
    omega: FloatArray,
    h: ComplexArray,
    weights: FloatArray,
    turn: float,
    parameters: FloatArray,
    omega_n: float,
) -> FloatArray:
    """Return the figures of :func:`evaluate` for many controllers.

    Parameters
    ----------
    omega : (N,) array
        Angular frequencies [rad/s], ascending.
    h : (N,) complex array
        H(j omega), sign taken out.
    weights : (N,) array
        Quadrature weights of the squared norm (11).
    turn : float
        Argument change of the open loop's denominator along the grid [rad].
    parameters : (M, 4) array
        Rows of K, T_I, T_d, T_f, as :func:`evaluate` takes them.
    omega_n : float
        Lowest frequency of the noise [rad/s]; below 0 the crossover.

    Returns
    -------
    (M, 6) array
        The figures of each row.
    """
    out = np.empty((len(parameters), 6))
    for k in range(len(parameters)):
        K, Ti, Td, Tf = parameters[k]
        figures = evaluate(omega, h, weights, turn, K, Ti, Td, Tf, omega_n)
        for j in range(6):
            out[k, j] = figures[j]
    return out
