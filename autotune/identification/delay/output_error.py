"""Separable output-error fit of x^(n) = sum a_i x^(i) + b u(t - h) + d: maximum likelihood, with its covariance.

For given (a, h) the response is linear in b, d and the initial state, which are solved for; (a, h) move by
Levenberg-Marquardt steps with analytic sensitivities (variable projection in Kaufman's form: the normal equations
of all parameters, damped in a and h only, give the same step). Under coloured noise the residual and its
sensitivities pass the filter that whitens the noise, which is prediction-error identification with an
autoregressive noise model independent of the plant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autotune.arrays import BoolArray, FloatArray
from autotune.identification.delay.compiled import cholesky_solve
from autotune.identification.delay.data import DelayData
from autotune.identification.delay.response import linear_part, normal_matrix, output
from autotune.identification.noise_filter import WHITE, Whitening


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Which parameters are free.

    Attributes
    ----------
    order : int
        Order n.
    integrator : bool
        Whether a_0 = 0 is known.
    offset : bool
        Whether the constant d is estimated.
    zeros : int
        Degree m of b_0 + b_1 s + .. + b_m s^m, below n.
    """

    order: int
    integrator: bool = False
    offset: bool = True
    zeros: int = 0

    @property
    def linear(self) -> BoolArray:
        """Which of (b_0, d, initial state, b_1..b_m) are free."""
        return np.array([True, self.offset, *[True] * (self.order + self.zeros)])

    @property
    def free(self) -> BoolArray:
        """Which of (b_0, d, initial state, b_1..b_m, a, h) are free."""
        return np.array([*self.linear, not self.integrator, *[True] * self.order])

    @property
    def free_parameters(self) -> BoolArray:
        """Which of (a, b, h, constant, initial state) are free; of an equation without zeros."""
        return np.array([not self.integrator, *[True] * (self.order + 1), self.offset, *[True] * self.order])

    @property
    def parameters(self) -> int:
        """How many there are."""
        return int(self.free.sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class Point:
    """A candidate: (a, h), what the linear parameters (b_0, d, initial state, b_1..b_m) then are, and its cost."""

    a: tuple[float, ...]
    h: float
    theta: FloatArray
    cost: float
    rows: int

    @property
    def variance(self) -> float:
        """Residual variance with the degrees of freedom counted."""
        return self.cost / max(self.rows - self.theta.size - len(self.a) - 1, 1)


def solve_linear(
    data: DelayData, structure: Structure, a: tuple[float, ...], h: float, whitening: Whitening = WHITE
) -> Point:
    """Return the best b, d and initial state for given (a, h); an unstable response that overflows costs infinity.

    Parameters
    ----------
    data : DelayData
        The record.
    structure : Structure
        Which parameters are free.
    a : tuple of n floats
        Coefficients a_0..a_{n-1}.
    h : float
        Delay [s].
    whitening : Whitening
        Makes the noise white.
    """
    theta, cost = linear_part(data, a, h, structure.offset, structure.zeros, whitening)
    return Point(a=a, h=h, theta=theta, cost=cost, rows=data.ty.size - whitening.lost)


def minimise(
    data: DelayData,
    structure: Structure,
    start: Point,
    *,
    max_delay_s: float,
    whitening: Whitening = WHITE,
    iterations: int = 30,
    tolerance: float = 1e-4,
    held: int | None = None,
) -> Point:
    """Move (a, h) to the next minimum of the sum of squares.

    Parameters
    ----------
    data : DelayData
        Rows that any delay up to ``max_delay_s`` can explain.
    structure : Structure
        Which parameters are free.
    start : Point
        Where to begin, evaluated on the same data.
    max_delay_s : float
        Upper limit of h [s].
    whitening : Whitening
        Makes the noise white.
    iterations : int
        Largest number of accepted steps.
    tolerance : float
        Stops when a step gains less than this many residual variances: 1e-4 is 0.01 standard deviations.
    held : int, optional
        Index in (b_0, d, initial state, b_1..b_m, a, h) of a coefficient, or of the delay, that stays where it is.

    Returns
    -------
    Point
        Never costlier than ``start``.
    """
    n, linear = structure.order, structure.linear.size
    every = np.flatnonzero(structure.free)
    every = every[every != held]
    damping = 1e-3
    point = start
    for _ in range(iterations):
        gram, finite = normal_matrix(data, point.a, point.h, point.theta, True, whitening)
        if not finite:
            return point
        for _trial in range(8):
            step, regular = _damped_step(gram, every, linear, damping)
            if regular and not 0.0 <= point.h + step[-1] <= max_delay_s and point.h in (0.0, max_delay_s):
                step, regular = _damped_step(gram, every[every != linear + n], linear, damping)  # along the limit of h
            if not regular:
                damping *= 8.0
                continue
            a = tuple(float(value) for value in np.array(point.a) + step[linear : linear + n])
            h = float(min(max(point.h + step[-1], 0.0), max_delay_s))
            trial = solve_linear(data, structure, a, h, whitening)
            if trial.cost < point.cost:
                break
            damping *= 8.0
        else:
            return point
        gained = (point.cost - trial.cost) / trial.variance
        point = trial
        damping = max(damping / 10.0, 1e-9)
        if gained < tolerance:
            break
    return point


def _damped_step(gram: FloatArray, free: NDArray[np.intp], linear: int, damping: float) -> tuple[FloatArray, bool]:
    """Return the step of (b_0, d, initial state, b_1..b_m, a, h), and whether the matrix was regular."""
    G = gram[np.ix_(free, free)]
    step = np.zeros(len(gram) - 1)
    step[free], _, regular = cholesky_solve(G + np.diag(damping * (free >= linear) * np.diag(G)), gram[free, -1], 1e-13)
    return step, regular


def residuals(data: DelayData, point: Point) -> FloatArray:
    """Return y - x at the output times.

    Parameters
    ----------
    data : DelayData
        N rows of y.
    point : Point
        The candidate.

    Returns
    -------
    (N,) array
        In y's unit; NaN from where the response overflows.
    """
    return np.asarray(data.y - output(data, point.a, point.h, point.theta), dtype=np.float64)
