"""What rational functions have along the imaginary axis: where their features lie, and how far an argument turns."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import InputError
from autotune.models import TransferFunction

#: Ratio of a coefficient to the largest below which roots, or products of responses, leave the range of numbers.
_LEAST = 1e-60


def beyond_numbers(what: str) -> InputError:
    """Return the refusal of what leaves the range of numbers."""
    remedy = "check the units of gains and times"
    return InputError(f"{what} the range of numbers", where="closed loop", remedy=remedy)


def require_range(*systems: TransferFunction) -> None:
    """Refuse polynomials whose roots leave the range of numbers."""
    for polynomial in (p for system in systems for p in (system.num, system.den)):
        sizes = np.abs([c for c in polynomial if c != 0.0])
        if sizes.size and np.max(sizes) * _LEAST > np.min(sizes):
            raise beyond_numbers(f"coefficients from {np.min(sizes):.3g} to {np.max(sizes):.3g} leave")


def characteristic_frequencies(*systems: TransferFunction) -> FloatArray:
    """Return magnitudes of nonzero poles, zeros, asymptote crossings of gain 1 and reciprocal delays [rad/s].

    Crossings of gain 1 mean something of a loop; of a plant they depend on its units, see :func:`corner_frequencies`.
    """
    crossings: list[float] = []
    for system in systems:
        num, den = np.array(system.num), np.array(system.den)
        crossings.extend(_roots(np.polyadd(num, den)))
        if np.any(num):
            crossings.extend(_unit_gain_asymptotes(num, den))
    values = _sorted([*crossings, *corner_frequencies(*systems, beside=max(crossings, default=0.0))])
    return values if len(values) else np.array([1.0])


def corner_frequencies(*systems: TransferFunction, beside: float = 0.0) -> FloatArray:
    """Return magnitudes of nonzero poles and zeros, and reciprocal delays [rad/s]: whatever the units of gains.

    Parameters
    ----------
    *systems : TransferFunction
        Time in s.
    beside : float
        Another feature [rad/s]; a dead time a million times shorter than all else is none.
    """
    found: list[float] = [beside] if beside > 0.0 else []
    for system in systems:
        found.extend(root for p in (system.num, system.den) for root in _roots(np.array(p)) if root > 0.0)
        if system.delay_s > 0.0:
            found.append(min(1.0 / system.delay_s, 1e6 * max(found, default=math.inf)))
    return _sorted(found)


def _roots(polynomial: FloatArray) -> list[float]:
    """Return magnitudes of roots; none of a polynomial that is 0."""
    return [float(root) for root in np.abs(np.roots(polynomial))] if np.any(polynomial) else []


def _sorted(frequencies: list[float]) -> FloatArray:
    return np.unique([value for value in frequencies if value > 0.0 and math.isfinite(value)])


def _unit_gain_asymptotes(num: FloatArray, den: FloatArray) -> list[float]:
    high = len(den) - len(num)
    low = np.flatnonzero(den[::-1])[0] - np.flatnonzero(num[::-1])[0]
    found = []
    if high != 0:
        found.append(abs(num[0] / den[0]) ** (1.0 / high))
    if low != 0:
        found.append(
            abs(num[::-1][np.flatnonzero(num[::-1])[0]] / den[::-1][np.flatnonzero(den[::-1])[0]]) ** (1 / low)
        )
    return [float(value) for value in found]


def turn_along_axis(parts: Callable[[FloatArray], ComplexArray], omega: FloatArray) -> float | None:
    """Return by how much the argument of a characteristic polynomial turns along the axis [rad]; None for a pole on it.

    Parameters
    ----------
    parts : callable
        From (N,) frequencies [rad/s] to (2, N): den_H den_C and num_H num_C, whose sum it is. The sum may range over
        any number of decades; it is 0 where its two parts take each other away to within rounding.
    omega : (N,) array
        Where the count begins; every step that turns by more than an eighth of a circle is halved.

    Raises
    ------
    InputError
        A response leaves the range of numbers.
    """
    values = parts(omega)
    for _ in range(14):
        D = values.sum(axis=0)
        coarse = np.flatnonzero(np.abs(np.angle(D[1:] / D[:-1])) > np.pi / 4.0)
        if not len(coarse):
            break
        middle = 0.5 * (omega[coarse] + omega[coarse + 1])
        omega = np.insert(omega, coarse + 1, middle)
        values = np.insert(values, coarse + 1, parts(middle), axis=1)
    D = values.sum(axis=0)
    if not np.all(np.isfinite(D)):
        raise beyond_numbers("the loop's response leaves")
    if np.any(np.abs(D) <= 1e-12 * np.sum(np.abs(values), axis=0)):
        return None
    return float(np.sum(np.angle(D[1:] / D[:-1])))
