"""Margins of a loop: modulus, phase, gain and delay margin, noise amplification, H2 norm, stability."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.controller import Controller
from autotune.design.figures import Figures, require_frequency
from autotune.design.loop import ContinuousLoop, OpenLoop, Plant, open_loop
from autotune.design.norms import disturbance_h2

_ZOOMS = 4
_SECANTS = 30


@dataclass(frozen=True, kw_only=True)
class Margins:
    """How far a closed loop is from instability, and what it does to noise and disturbances.

    Attributes
    ----------
    stable : bool
        Whether the closed loop is stable. Where it is not, the other figures describe the Nyquist curve only.
    modulus : float
        M_m = min over omega of abs(1 + L), equation (12).
    modulus_frequency_rad_s : float
        Where that minimum is [rad/s].
    phase_rad : float
        Phase margin (13), the smallest over all crossovers, in (-pi, pi] [rad]; pi where abs(L) < 1 throughout.
    delay_s : float
        M_ret: dead time that may be added before the loop becomes unstable [s]; infinite without a crossover.
    gain : float
        Smallest factor above 1 by which L may grow before the curve meets -1; infinite where there is none.
    gain_reduction : float
        Largest factor below 1 likewise (a conditionally stable loop); 0 where there is none.
    crossover_rad_s : float
        omega_gc of (14), the highest one [rad/s]; NaN where abs(L) never is 1.
    noise_gain : float
        True amplification (15): max of abs(C/(1 + L)) over omega >= omega_n.
    noise_gain_bound : float
        Its bound by (16): largest abs(C) at and above omega_n, divided by M_m.
    h2 : float
        Norm (11) of H/(1 + H C)/s; infinite without integral action or stability.
    """

    stable: bool
    modulus: float
    modulus_frequency_rad_s: float
    phase_rad: float
    delay_s: float
    gain: float
    gain_reduction: float
    crossover_rad_s: float
    noise_gain: float
    noise_gain_bound: float
    h2: float

    @property
    def figures(self) -> Figures:
        """What a specification is held against."""
        return Figures(
            squared_norm=self.h2**2,
            modulus=self.modulus if self.stable else -self.modulus,
            phase_rad=self.phase_rad,
            delay_s=self.delay_s,
            noise_gain=self.noise_gain,
            controller_gain=self.noise_gain_bound * self.modulus,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the fixed form of ``margins.json``; what is infinite or does not exist is null."""
        values = {
            "modulus": self.modulus,
            "phase_deg": math.degrees(self.phase_rad),
            "delay_s": self.delay_s,
            "gain": self.gain,
            "crossover_rad_s": self.crossover_rad_s,
            "noise_gain": self.noise_gain,
            "h2": self.h2,
            "noise_gain_bound": self.noise_gain_bound,
            "gain_reduction": self.gain_reduction,
        }
        finite: dict[str, Any] = {key: value if math.isfinite(value) else None for key, value in values.items()}
        return finite | {"stable": self.stable}


def margins(plant: Plant, controller: Controller, *, noise_frequency_rad_s: float | None = None) -> Margins:
    """Return the margins of the loop of ``plant`` and ``controller``.

    Parameters
    ----------
    plant : TransferFunction or Model
        H; of a model the blocks, without its effects.
    controller : PIDController, TransferFunction or DiscreteController
        C. A discrete one makes a sampled loop: H with its zero-order hold, discretised exactly.
    noise_frequency_rad_s : float, optional
        omega_n of (15): lowest frequency of the measurement noise [rad/s]; the crossover where absent.

    Returns
    -------
    Margins
        Frozen.

    Raises
    ------
    DesignError
        A frequency of the noise that is none.

    Notes
    -----
    Extremes are found on a grid that resolves poles, zeros, resonances and dead time, and refined between its nodes;
    stability is counted (see :mod:`autotune.design.loop`). A feature narrower than the damping of every pole and zero
    of H, C and the closed loop does not exist, so none is missed; with dead time the closed loop's poles are not known
    beforehand and a margin below about 1e-3 can be overstated.

    References
    ----------
    Le & Mendes 2010, equations (11) to (16).
    """
    if noise_frequency_rad_s is not None:
        require_frequency("noise frequency", noise_frequency_rad_s)
    loop = open_loop(plant, controller)
    omega = loop.grid
    L = loop.response(omega)
    M_m, at = modulus_margin(loop, omega, L)
    phase, delay, crossover = phase_and_delay_margin(loop, omega, L)
    gain, reduction = _gain_margins(loop, omega, L)
    start = noise_frequency_rad_s
    if start is None:
        start = crossover if math.isfinite(crossover) else omega[0]
    return Margins(
        stable=loop.is_stable,
        modulus=M_m,
        modulus_frequency_rad_s=at,
        phase_rad=phase,
        delay_s=delay,
        gain=gain,
        gain_reduction=reduction,
        crossover_rad_s=crossover,
        noise_gain=noise_amplification(loop, omega, start),
        noise_gain_bound=controller_gain(loop, start) / M_m if M_m > 0.0 else math.inf,
        h2=disturbance_h2(loop),
    )


def controller_gain(loop: OpenLoop, start_rad_s: float) -> float:
    """Return the largest abs(C) from a frequency on, left side of (16); infinite for an improper C.

    Parameters
    ----------
    loop : OpenLoop
        Continuous or sampled.
    start_rad_s : float
        Lowest frequency that counts [rad/s].
    """
    omega = np.append(loop.grid[loop.grid > start_rad_s], start_rad_s)
    largest = float(np.max(np.abs(loop.controller_response(omega))))
    if isinstance(loop, ContinuousLoop):
        num, den = loop.controller.num, loop.controller.den
        excess = len(den) - len(num)
        limit = math.inf if excess < 0 else abs(num[0] / den[0]) if excess == 0 else 0.0
        return max(largest, limit)
    return largest


def refine_minimum(f: Callable[[FloatArray], FloatArray], omega: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Return the minimum of f and where it is, given its values on a grid that resolves it.

    Of the local minima on the grid those within a tenth of the lowest, eight at most, are searched between their
    neighbours.

    Parameters
    ----------
    f : callable
        From (M,) frequencies [rad/s] to (M,) values.
    omega : (N,) array
        Grid [rad/s], ascending.
    values : (N,) array
        f on it.

    Returns
    -------
    tuple of float
        The least value, and its frequency [rad/s].
    """
    inner = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])) + 1
    best = int(np.argmin(values))
    lowest, at = float(values[best]), float(omega[best])
    inner = inner[values[inner] <= lowest + 0.1 * abs(lowest)]
    for i in inner[np.argsort(values[inner])][:8]:
        left, right = float(omega[i - 1]), float(omega[i + 1])
        for _ in range(_ZOOMS):
            x = np.linspace(left, right, 21)
            fx = f(x)
            k = int(np.argmin(fx))
            if fx[k] < lowest:
                lowest, at = float(fx[k]), float(x[k])
            left, right = float(x[max(k - 1, 0)]), float(x[min(k + 1, 20)])
    return lowest, at


def modulus_margin(loop: OpenLoop, omega: FloatArray, L: ComplexArray) -> tuple[float, float]:
    """Return M_m of (12) and the frequency it is at.

    Parameters
    ----------
    loop : OpenLoop
        Continuous or sampled.
    omega : (N,) array
        Its grid [rad/s].
    L : (N,) complex array
        Its response there.

    Returns
    -------
    tuple of float
        M_m, and its frequency [rad/s]; infinite where only ever higher frequencies come near it.
    """
    lowest, at = refine_minimum(lambda x: np.abs(1.0 + loop.response(x)), omega, np.abs(1.0 + L))
    if isinstance(loop, ContinuousLoop) and loop.transfer_function.delay_s > 0.0 and loop.gain_at_infinity > 0.0:
        # dead time turns a gain that does not vanish through -180 deg for ever
        limit = abs(1.0 - loop.gain_at_infinity)
        if limit < lowest:
            return limit, math.inf
    return lowest, at


def _roots(f: Callable[[FloatArray], FloatArray], omega: FloatArray, values: FloatArray) -> FloatArray:
    """Return the frequencies where f changes sign, by bracketed secants, all brackets at once."""
    i = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    if not len(i):
        return omega[np.flatnonzero(values == 0.0)]
    a, b, fa, fb = omega[i], omega[i + 1], values[i], values[i + 1]
    for _ in range(_SECANTS):
        ends = fb - fa
        x = np.where(ends == 0.0, b, (a * fb - b * fa) / np.where(ends == 0.0, 1.0, ends))  # both ends are on the root
        fx = f(x)
        same = np.sign(fx) == np.sign(fb)
        # Illinois: the end that stays counts half, so that neither end is kept for ever
        a, fa = np.where(same, a, b), np.where(same, 0.5 * fa, fb)
        b, fb = x, np.where(fx == 0.0, 1e-300, fx)
        if np.all(np.abs(fx) < 1e-14):
            break
    return np.asarray(np.concatenate((b, omega[np.flatnonzero(values == 0.0)])))


def phase_and_delay_margin(loop: OpenLoop, omega: FloatArray, L: ComplexArray) -> tuple[float, float, float]:
    """Return phase margin (13), delay margin and highest crossover (14).

    Parameters
    ----------
    loop : OpenLoop
        Continuous or sampled.
    omega : (N,) array
        Its grid [rad/s].
    L : (N,) complex array
        Its response there.

    Returns
    -------
    tuple of float
        Phase margin [rad], delay margin [s], crossover [rad/s]; pi, infinite and NaN where abs(L) is never 1.
    """

    def f(x: FloatArray) -> FloatArray:
        return np.log(np.abs(loop.response(x)))

    crossings = _roots(f, omega, np.log(np.maximum(np.abs(L), 1e-300)))
    if not len(crossings):
        return math.pi, math.inf, math.nan
    above = np.angle(-loop.response(crossings))  # arg L + pi, in (-pi, pi]
    ahead = np.where(above > 0.0, above, above + 2.0 * np.pi)
    return float(above[np.argmin(np.abs(above))]), float(np.min(ahead / crossings)), float(np.max(crossings))


def _gain_margins(loop: OpenLoop, omega: FloatArray, L: ComplexArray) -> tuple[float, float]:
    def f(x: FloatArray) -> FloatArray:
        return loop.response(x).imag

    at = loop.response(_roots(f, omega, L.imag))
    factors = -1.0 / at.real[at.real < 0.0]
    up, down = factors[factors > 1.0], factors[factors <= 1.0]
    return float(np.min(up)) if len(up) else math.inf, float(np.max(down)) if len(down) else 0.0


def noise_amplification(loop: OpenLoop, omega: FloatArray, start: float) -> float:
    """Return max abs(C/(1 + L)) of (15) from a frequency on.

    Parameters
    ----------
    loop : OpenLoop
        Continuous or sampled.
    omega : (N,) array
        Its grid [rad/s].
    start : float
        Lowest frequency of the noise [rad/s].
    """

    def f(x: FloatArray) -> FloatArray:
        return -np.abs(loop.controller_response(x) / (1.0 + loop.response(x)))

    above = np.concatenate(([start], omega[omega > start]))
    lowest, _ = refine_minimum(f, above, f(above))
    return -lowest
