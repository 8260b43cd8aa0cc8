"""The open loop L = H C: its response, a frequency grid that misses nothing, and its closed-loop stability.

Stability is counted, never guessed from margins: with D(s) = den(s) + num(s) exp(-s L), the argument of D(j omega)/(j
omega + a)^n turns by -pi N between 0 and infinity, where N is the number of closed-loop poles in the right half plane
(Mikhailov). Integrators and unstable open-loop poles need no indentation, and dead time stays exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeAlias

import numpy as np
from scipy.linalg import expm

from autotune.arrays import ComplexArray, FloatArray
from autotune.controller import Controller, DiscreteController, PIDController
from autotune.design.axis import beyond_numbers, characteristic_frequencies, require_range, turn_along_axis
from autotune.errors import DesignError
from autotune.models import Model, TransferFunction

Plant: TypeAlias = TransferFunction | Model

_POINTS_PER_DECADE = 120
_MOST_DELAY_POINTS = 200_000


class OpenLoop(Protocol):
    """What margins and norms need of a loop."""

    @property
    def grid(self) -> FloatArray:
        """Angular frequencies [rad/s] that resolve every feature of the loop, ascending."""
        ...

    @property
    def is_stable(self) -> bool:
        """Whether the closed loop is stable."""
        ...

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return L(j omega)."""
        ...

    def plant_response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return H(j omega), the hold included in a sampled loop."""
        ...

    def controller_response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return C(j omega)."""
        ...


def transfer_function_of(plant: Plant) -> TransferFunction:
    """Return the small-signal transfer function of a plant."""
    return plant.transfer_function() if isinstance(plant, Model) else plant


@dataclass(frozen=True, kw_only=True)
class ContinuousLoop:
    """L(s) = H(s) C(s) with exact dead time.

    Attributes
    ----------
    plant, controller : TransferFunction
        H and C.
    """

    plant: TransferFunction
    controller: TransferFunction

    @cached_property
    def transfer_function(self) -> TransferFunction:
        """The product H C, common factors kept."""
        return self.plant * self.controller

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return L(j omega), same shape as ``omega_rad_s``."""
        return self.plant.response(omega_rad_s) * self.controller.response(omega_rad_s)

    def plant_response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return H(j omega), same shape as ``omega_rad_s``."""
        return self.plant.response(omega_rad_s)

    def controller_response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return C(j omega), same shape as ``omega_rad_s``."""
        return self.controller.response(omega_rad_s)

    @cached_property
    def gain_at_infinity(self) -> float:
        """abs(L) at infinite frequency; infinite for an improper loop."""
        excess = len(self.transfer_function.den) - len(self.transfer_function.num)
        if excess > 0:
            return 0.0
        return abs(self.transfer_function.num[0] / self.transfer_function.den[0]) if excess == 0 else math.inf

    @cached_property
    def grid(self) -> FloatArray:
        """Logarithmic grid over all features, dense around resonances and as fine as the dead time asks."""
        L = self.transfer_function
        require_range(self.plant, self.controller, L)
        corners = characteristic_frequencies(self.plant, self.controller, L)
        low, high = float(corners[0]) * 1e-3, float(corners[-1]) * 1e3
        if low == 0.0 or math.isinf(high / low):
            raise beyond_numbers(f"the loop's corners, {corners[0]:.3g} to {corners[-1]:.3g} rad/s, leave")
        count = int(_POINTS_PER_DECADE * math.log10(high / low)) + 1
        parts = [np.geomspace(low, high, count)]
        closed = np.roots(np.polyadd(L.num, L.den)) if L.delay_s == 0.0 else np.zeros(0)
        resonant = [L.poles, L.zeros, np.asarray(closed, dtype=np.complex128)]
        for root in np.concatenate(resonant):
            if abs(root.imag) > 2.0 * abs(root.real):
                width = max(abs(root.real), 1e-7 * abs(root))
                offsets = np.geomspace(0.1 * width, abs(root.imag), 60)
                around = np.concatenate((abs(root.imag) - offsets, [abs(root.imag)], abs(root.imag) + offsets))
                parts.append(around[(around > low) & (around < high)])
        if L.delay_s > 0.0:
            with np.errstate(divide="ignore", invalid="ignore"):  # a pole on the axis, at one of the frequencies
                audible = parts[0][np.abs(self.response(parts[0])) > 0.04]
            end = min(audible[-1] if len(audible) else low, 2000.0 / L.delay_s)
            points = min(int(end * L.delay_s / 0.2) + 2, _MOST_DELAY_POINTS)
            parts.append(np.linspace(low, end, points)[1:] if end > low else parts[0][:0])
        return np.unique(np.concatenate(parts))

    @cached_property
    def unstable_poles(self) -> float:
        """Closed-loop poles with non-negative real part; infinite where dead time meets abs(L) >= 1 at infinity."""
        L = self.transfer_function
        D = np.polyadd(L.num, L.den)
        if not np.any(D):
            raise DesignError("H C = -1 at every frequency", where="closed loop", remedy="change the controller")
        if L.delay_s == 0.0:
            roots = np.roots(D)
            scale = np.maximum(np.abs(roots), 1e-300)
            unstable = int(np.sum(roots.real >= -1e-12 * scale))
            return math.inf if len(L.num) > len(L.den) and len(D) < len(L.num) else float(unstable)
        if self.gain_at_infinity >= 1.0:
            return math.inf
        return self._mikhailov()

    def _mikhailov(self) -> float:
        L = self.transfer_function
        a = float(np.exp(np.mean(np.log(characteristic_frequencies(L)))))
        order = len(L.den) - 1

        def parts(omega: FloatArray) -> ComplexArray:
            s = 1j * omega
            found = np.array([np.polyval(L.den, s), np.polyval(L.num, s) * np.exp(-s * L.delay_s)])
            return np.asarray(found / (s + a) ** order, dtype=np.complex128)

        turned = turn_along_axis(parts, np.concatenate(([0.0], self.grid)))
        if turned is None:
            return math.inf
        # D/(s + a)^n tends to den[0] (1 + L(inf)), whose argument is within asin|L(inf)| of den[0]'s: rounding
        # absorbs the rest
        return max(0.0, round(-turned / np.pi))

    @property
    def is_stable(self) -> bool:
        """Whether every closed-loop pole has a negative real part."""
        return self.unstable_poles == 0.0


@dataclass(frozen=True, kw_only=True)
class SampledLoop:
    """L(z) = H(z) C(z) with H held between samples (zero-order hold) and discretised exactly, dead time included.

    Attributes
    ----------
    plant : TransferFunction
        Strictly proper or proper H.
    controller : DiscreteController
        C(q).
    """

    plant: TransferFunction
    controller: DiscreteController

    @cached_property
    def _delay(self) -> tuple[int, float]:
        """Dead time as whole samples and the rest in samples, 0 where it is nothing but rounding."""
        samples = self.plant.delay_s / self.controller.sample_time_s
        whole = math.floor(samples + 1e-9)
        return whole, samples - whole if samples - whole > 1e-9 else 0.0

    @cached_property
    def _matrices(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
        """Phi, Gamma_1 (older command), Gamma_0 (newer command), c and direct term of the sampled plant."""
        T_s = self.controller.sample_time_s
        if not self.plant.is_proper:
            raise DesignError("the plant is not proper", where="sampled loop", remedy="give it at least as many poles")
        den = np.array(self.plant.den)
        order = len(den) - 1
        scale = characteristic_frequencies(self.plant)
        w = float(np.exp(np.mean(np.log(scale))))  # time in units of 1/w, so that the companion form is well scaled
        powers = w ** np.arange(order, -1, -1.0)
        den = den * powers
        num = np.concatenate((np.zeros(order + 1 - len(self.plant.num)), self.plant.num)) * powers / den[0]
        den = den / den[0]
        direct = float(num[0])
        A = np.eye(order, k=-1)
        A[:1] = -den[1:]
        B, C = np.eye(order, 1), (num - direct * den)[None, 1:]
        fraction = self._delay[1] * T_s

        def held(duration: float) -> tuple[FloatArray, FloatArray]:
            block = np.zeros((order + 1, order + 1))
            block[:order, :order], block[:order, order:] = A * duration * w, B * duration * w
            exponential = expm(block)
            return exponential[:order, :order], exponential[:order, order:]

        Phi, _ = held(T_s)
        Phi_new, Gamma_0 = held(T_s - fraction)
        Gamma_1 = Phi_new @ held(fraction)[1]
        return Phi, Gamma_1, Gamma_0, C, direct

    def _pulse(self, z: ComplexArray) -> ComplexArray:
        """Pulse transfer function H(z)."""
        Phi, Gamma_1, Gamma_0, C, direct = self._matrices
        whole, fraction = self._delay
        order = len(Phi)
        total = np.full(z.shape, direct, dtype=np.complex128) * (1.0 / z if fraction > 0.0 else 1.0)
        if order:
            states = z[:, None, None] * np.eye(order) - Phi
            inputs = Gamma_0[None, :, :] + Gamma_1[None, :, :] / z[:, None, None]
            total = total + (C[None, :, :] @ np.linalg.solve(states, inputs))[:, 0, 0]
        return np.asarray(total * z ** (-float(whole)), dtype=np.complex128)

    def plant_response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return H(exp(j omega T_s)) with its hold, same shape as the (N,) ``omega_rad_s``."""
        return self._pulse(np.exp(1j * np.asarray(omega_rad_s) * self.controller.sample_time_s))

    def controller_response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return C(exp(j omega T_s)), same shape as ``omega_rad_s``."""
        return self.controller.response(omega_rad_s)

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return L(exp(j omega T_s)), same shape as the (N,) ``omega_rad_s``."""
        return self.plant_response(omega_rad_s) * self.controller_response(omega_rad_s)

    @cached_property
    def grid(self) -> FloatArray:
        """Logarithmic from far below every feature, then linear up to the Nyquist frequency."""
        T_s = self.controller.sample_time_s
        nyquist = math.pi / T_s
        low = min(characteristic_frequencies(self.plant)[0], 0.1 * nyquist) * 1e-3
        log_part = np.geomspace(low, nyquist, int(_POINTS_PER_DECADE * math.log10(nyquist / low)) + 2)
        points = min(int(800 + 40 * self.plant.delay_s / T_s), _MOST_DELAY_POINTS)
        return np.unique(np.concatenate((log_part, np.linspace(low, nyquist, points))))

    @cached_property
    def is_stable(self) -> bool:
        """Whether every closed-loop pole lies inside the unit circle.

        D(z)/z^n, with D = den_H den_C + num_H num_C, winds 0 times around the origin on the unit circle exactly then.
        """
        Phi = self._matrices[0]
        den_C = np.array(self.controller.den)
        T_s = self.controller.sample_time_s

        def parts(omega: FloatArray) -> ComplexArray:
            z = np.exp(1j * omega * T_s)
            states = np.linalg.det(np.eye(len(Phi)) - Phi / z[:, None, None]) if len(Phi) else np.ones(len(z))
            controller = np.polyval(den_C[::-1], 1.0 / z)
            numerator = np.polyval(np.array(self.controller.num)[::-1], 1.0 / z)
            return np.array([states * controller, states * self._pulse(z) * numerator], dtype=np.complex128)

        turned = turn_along_axis(parts, np.concatenate(([self.grid[0] * 1e-3], self.grid)))
        return turned is not None and round(turned / np.pi) == 0


def open_loop(plant: Plant, controller: Controller) -> ContinuousLoop | SampledLoop:
    """Return the loop of a plant and a controller: continuous, or sampled where the controller is discrete.

    Parameters
    ----------
    plant : Plant
        Continuous, time in s.
    controller : Controller
        A PI or PID, a continuous transfer function, or a discrete one behind a hold.
    """
    H = transfer_function_of(plant)
    match controller:
        case DiscreteController():
            return SampledLoop(plant=H, controller=controller)
        case PIDController():
            return ContinuousLoop(plant=H, controller=controller.transfer_function())
        case TransferFunction():
            return ContinuousLoop(plant=H, controller=controller)
