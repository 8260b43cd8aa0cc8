"""The H2 norm (11): how far a step disturbance at the plant's input drives the output, integrated over all time.

||H/(1 + H C) 1/s||_2^2 = (1/pi) int_0^inf |H/(1 + H C)|^2 / omega^2 d omega, which is also the integral of the squared
response to a unit step disturbance (Parseval). Evaluated in frequency, so that dead time stays exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from autotune.arrays import FloatArray
from autotune.design.axis import characteristic_frequencies
from autotune.design.loop import ContinuousLoop, OpenLoop, SampledLoop
from autotune.errors import DesignError
from autotune.models import TransferFunction

_FEW = np.polynomial.legendre.leggauss(5)
_MANY = np.polynomial.legendre.leggauss(10)
_LEVELS = 30
#: Relative, of the squared norm.
_TOLERANCE = 1e-9
#: Panels at most, and times those that the loop's features ask for: more swings of a dead time than that are no loop's.
_MOST_PANELS, _TIMES_GIVEN = 100_000, 8


def disturbance_h2(loop: OpenLoop) -> float:
    """Return the H2 norm (11) of H/(1 + H C)/s, output unit sqrt(s) per input unit.

    Parameters
    ----------
    loop : OpenLoop
        Continuous or sampled; for a sampled loop the integral of y^2 is T_s times the sum over the samples, for a step
        that begins at a sample.

    Returns
    -------
    float
        Infinite where the closed loop is unstable, or a step leaves a lasting error (no integral action).

    Raises
    ------
    DesignError
        The integral did not converge to the tolerance.

    References
    ----------
    Le & Mendes 2010, equation (11).
    """
    if not loop.is_stable:
        return math.inf
    if isinstance(loop, SampledLoop):
        return _norm_of_sampled(loop)
    assert isinstance(loop, ContinuousLoop)
    if order_at_zero(loop.plant) - min(order_at_zero(loop.plant) + order_at_zero(loop.controller), 0) < 1:
        return math.inf
    grid = loop.grid
    corners = characteristic_frequencies(loop.plant, loop.controller, loop.transfer_function)
    low, high = corners[0] * 1e-5, corners[-1] * 1e4

    def f(omega: FloatArray) -> FloatArray:
        H = loop.plant.response(omega)
        return np.asarray(np.abs(H / (1.0 + H * loop.controller.response(omega))) ** 2 / omega**2)

    edges = np.unique(np.concatenate(([low, high], grid[(grid > low) & (grid < high)][::4])))
    # below low f is its limit to within (low/corner)^2; above high it falls as omega^-2(r + 1), r the relative degree
    excess = len(loop.plant.den) - len(loop.plant.num)
    tails = f(np.array([low]))[0] * low + f(np.array([high]))[0] * high / (2 * excess + 1)
    return math.sqrt((integral(f, edges, _TOLERANCE) + tails) / math.pi)


def order_at_zero(system: TransferFunction) -> int:
    """Return p where the response goes as s^p at s = 0: negative for integrators, positive for differentiators."""
    num, den = np.array(system.num), np.array(system.den)
    return int(np.flatnonzero(num[::-1])[0] - np.flatnonzero(den[::-1])[0])


def integral(f: Callable[[FloatArray], FloatArray], edges: FloatArray, relative_tolerance: float) -> float:
    """Return the integral over log omega between the edges, each panel halved until two Gauss rules agree.

    The integration variable is log omega; ``edges`` is (M,), positive and ascending [rad/s].

    Parameters
    ----------
    f : callable
        The integrand over log omega, from frequencies [rad/s] of any shape to values of the same.
    edges : (M,) array
        Of the panels [rad/s], positive and ascending.
    relative_tolerance : float
        Of the whole integral.

    Raises
    ------
    DesignError
        It does not converge in bounded work.
    """
    a, b = np.log(edges[:-1]), np.log(edges[1:])
    total = 0.0
    for _ in range(_LEVELS):
        few, many = _rule(f, a, b, _FEW), _rule(f, a, b, _MANY)
        scale = total + float(np.sum(np.abs(many)))
        rough = np.abs(few - many) > relative_tolerance * scale / max(len(edges), 1)
        total += float(np.sum(many[~rough]))
        if not np.any(rough):
            return total
        if 2 * int(np.sum(rough)) > max(_MOST_PANELS, _TIMES_GIVEN * len(edges)):
            break
        middle = 0.5 * (a[rough] + b[rough])
        a, b = np.concatenate((a[rough], middle)), np.concatenate((middle, b[rough]))
    raise DesignError(
        "the H2 integral did not converge",
        where="H2 norm (11)",
        remedy="the closed loop is at the edge of stability, or its dead time is far beyond its lags: change the "
        "controller, or check the delay",
    )


def _rule(
    f: Callable[[FloatArray], FloatArray], a: FloatArray, b: FloatArray, rule: tuple[FloatArray, FloatArray]
) -> FloatArray:
    nodes, weights = rule
    half = 0.5 * (b - a)
    omega = np.exp(0.5 * (a + b)[:, None] + half[:, None] * nodes)
    values = f(omega.ravel()).reshape(omega.shape) * omega
    return np.asarray((values @ weights) * half)


def _norm_of_sampled(loop: SampledLoop) -> float:
    T_s = loop.controller.sample_time_s
    if abs(np.sum(loop.controller.den)) > 1e-12 * np.sum(np.abs(loop.controller.den)):
        return math.inf
    grid = loop.grid

    def f(omega: FloatArray) -> FloatArray:
        # outer edge and integrator poles exactly at omega = 0 only: the grid never touches it
        H = loop.plant_response(omega)
        step = 1.0 / (2.0 * np.sin(0.5 * omega * T_s))
        return np.asarray(np.abs(H / (1.0 + H * loop.controller.response(omega)) * step) ** 2)

    tail = f(grid[:1])[0] * grid[0]
    # sum y^2 = (T_s/2 pi) int over a full circle = (T_s/pi) int_0^(pi/T_s); times T_s for the integral of y^2
    return T_s * math.sqrt((integral(f, grid[::4], _TOLERANCE) + tail) / math.pi)
