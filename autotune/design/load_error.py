"""The integral of the absolute error after a step of load (IAE): what an operator sees of a disturbance.

The norm (11) is the integral of the square and weighs the peak; the absolute error weighs the tail as well, which a
slow integral action makes. Computed from the response to a slow square wave, whose odd harmonics give the settled
response to a step of twice its amplitude, dead time exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import irfft

from autotune.arrays import ComplexArray, FloatArray
from autotune.design.search import MOST_SLACK, minimise
from autotune.design.simplex import search_by_simplex

_PER_CROSSOVER = 0.08  # radians of the crossover per step of time
_LEAST, _MOST = 1 << 10, 1 << 16
_WALL = 300.0  # cost of a constraint violated by all of it, in logarithms of the error
#: sizes of the simplexes, in logarithms of the gains; of two gains the first pair ends where the others do, to 1e-7
_SPANS = (0.3, 0.1, 0.03)
_NEAR = 0.05  # how far the last search may go, in logarithms of the gains


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadStep:
    """A plant under a step of load at its input, at the harmonics of a square wave.

    Attributes
    ----------
    omega : (N,) array
        Odd harmonics [rad/s].
    h : (N,) complex array
        Plant there, its sign taken out.
    half_period_s : float
        Time that the response has to settle [s].
    rows : int
        Of the response over a whole period.
    """

    omega: FloatArray
    h: ComplexArray
    half_period_s: float
    rows: int

    @cached_property
    def _square_wave(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Its frequencies on the imaginary axis, what an integral is there, and its amplitudes."""
        s = np.asarray(1j * self.omega, dtype=np.complex128)
        k = np.arange(1, 2 * self.omega.size, 2)
        wave = np.asarray(-1j * self.rows / (math.pi * k), dtype=np.complex128)
        integral = np.asarray(-1j / self.omega, dtype=np.complex128)
        return s, integral, wave

    def error(self, p: FloatArray) -> float:
        """Return the integral of abs(y) after a unit step, output unit times s, with gains (K, T_I, T_d, T_f)."""
        K, Ti, Td, Tf = p
        s, integral, wave = self._square_wave
        C = K + K / Ti * integral
        if Td or Tf:
            C = (C + K * Td * s) / (1.0 + Tf * s)
        spectrum = np.zeros(self.rows // 2 + 1, dtype=np.complex128)
        spectrum[1 : 2 * s.size : 2] = self.h / (1.0 + self.h * C) * wave
        y = irfft(spectrum, self.rows)
        size, following = np.abs(y), np.append(y[1:], y[0])
        # on a straight line from row to row: without it the sum has a ripple that searches end in
        crossing = np.flatnonzero(y * following < 0.0)
        a, b = size[crossing], np.abs(following[crossing])
        too_much = np.sum(a * b / (a + b))
        return (float(np.sum(size)) - float(too_much)) / self.rows * self.half_period_s


def load_step(
    response: Callable[[FloatArray], ComplexArray], start: FloatArray, crossover_rad_s: float, delay_s: float
) -> LoadStep:
    """Return the square wave that settles under the (4,) controller ``start`` and those near it.

    Parameters
    ----------
    response : callable
        Plant, sign taken out, at angular frequencies [rad/s].
    start : (4,) array
        K, T_I, T_d, T_f of a good controller.
    crossover_rad_s, delay_s : float
        Of its loop and its plant.
    """
    K, Ti = float(start[0]), float(start[1])
    slow = 1e-3 / (Ti + delay_s + 1.0 / crossover_rad_s)
    static = float(np.abs(response(np.array([slow])))[0])
    half = 15.0 * Ti * (1.0 + 1.0 / max(K * static, 1e-3)) + 40.0 / crossover_rad_s + 10.0 * delay_s
    wanted = 2.0 * half * crossover_rad_s / _PER_CROSSOVER
    rows = 1 << int(np.clip(math.ceil(math.log2(wanted)), math.log2(_LEAST), math.log2(_MOST)))
    omega = np.arange(1, rows // 2, 2, dtype=np.float64) * (math.pi / half)
    return LoadStep(omega=omega, h=response(omega), half_period_s=half, rows=rows)


def least_error(load: LoadStep, slacks: Callable[[FloatArray], FloatArray], start: FloatArray) -> FloatArray:
    """Return the (4,) gains of least error near the start, by simplexes against a steep wall at the constraints.

    The error has kinks where the response begins to swing, which no gradient leads across.

    Parameters
    ----------
    load : LoadStep
        What is minimised.
    slacks : callable
        Relative slacks of the constraints for (4,) gains; negative is violated.
    start : (4,) array
        Gains that keep the constraints; those that are 0 stay so.
    """
    seen = _Seen(load=load, slacks=slacks, best=start)
    free = start > 0.0
    size = int(np.sum(free))

    def cost(p: FloatArray) -> float:
        error, slack = seen.look(p)
        least = float(np.min(slack))
        return error - _WALL * min(least, 0.0) + (10.0 if least <= -1.0 else 0.0)

    inside = np.log([0.85, 0.75, 1.0, 1.0])[free]  # off the corner of two constraints, where a simplex would stay
    for span in _SPANS if size > 2 else _SPANS[:1]:
        for direction in (1.0, -1.0):
            at = np.log(seen.best[free] / start[free]) + (inside if span == _SPANS[0] else 0.0)
            vertices = np.vstack((at, at + direction * span * (np.eye(size) - 0.5 / size)))
            search_by_simplex(cost, start, vertices, xatol=1e-3, fatol=1e-5, maxiter=60 * size)
    return settle(load, slacks, seen.best)


def settle(load: LoadStep, slacks: Callable[[FloatArray], FloatArray], start: FloatArray) -> FloatArray:
    """Return the (4,) gains of least error close to a start, on their constraints to the last digits.

    Parameters
    ----------
    load, slacks, start
        As of :func:`least_error`; a start that misses the constraints a little is led back.
    """
    seen = _Seen(load=load, slacks=slacks, best=start)
    free = start > 0.0

    def look(x: FloatArray) -> tuple[float, FloatArray]:
        p = start.copy()
        p[free] *= np.exp(x)
        return seen.look(p)

    minimise(look, np.zeros(int(np.sum(free))), _NEAR, most=40, tolerance=1e-12)
    return seen.best


@dataclass(kw_only=True)
class _Seen:
    """The best gains that a search has looked at: where it ends may be a last digit beyond a constraint."""

    load: LoadStep
    slacks: Callable[[FloatArray], FloatArray]
    best: FloatArray
    least: float = math.inf

    def look(self, p: FloatArray) -> tuple[float, FloatArray]:
        """Return the logarithm of the error of gains, and their slacks."""
        error, slack = math.log(max(self.load.error(p), 1e-300)), np.minimum(self.slacks(p), MOST_SLACK).ravel()
        if np.min(slack) >= 0.0 and error < self.least:
            self.best, self.least = p, error
        return error, slack
