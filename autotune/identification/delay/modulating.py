"""Modulating functions: windows whose derivatives vanish at both ends, so that integrals by parts have no end terms.

For f with f^(j)(0) = f^(j)(1) = 0, j < m, m >= n: I_{x^(i), f} = (-1)^i I_{x, f^(i)}. Derivatives of x are never
taken, and no initial state appears.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import InputError


@dataclass(frozen=True, kw_only=True)
class SinePower:
    """f(s) = sin^m(pi s) on [0, 1]: shifting it stays within a finite family of sines and cosines.

    Attributes
    ----------
    m : int
        Power; derivatives below the m-th vanish at the ends.
    """

    m: int

    def derivative(self, i: int, s: FloatArray) -> FloatArray:
        """Return f^(i)(s), same shape as s."""
        # sin^m(theta) = (2j)^-m sum_q C(m, q) (-1)^q exp(j (m - 2q) theta)
        total = np.zeros(s.shape, dtype=np.complex128)
        for q in range(self.m + 1):
            frequency = (self.m - 2 * q) * np.pi
            total += math.comb(self.m, q) * (-1) ** q * (1j * frequency) ** i * np.exp(1j * frequency * s)
        return np.asarray((total / (2j) ** self.m).real, dtype=np.float64)

    def fourier(self) -> tuple[tuple[float, float], ...]:
        """Return (c_q, omega_q), f(s) = sum c_q cos(omega_q s), for even m.

        Raises
        ------
        InputError
            m is odd: the family of its shifts is not the cosines' and sines' of whole periods.
        """
        if self.m % 2:
            raise InputError(f"sin^{self.m}", where="window", remedy="the exact shift needs an even power")
        half = self.m // 2
        terms = [(math.comb(self.m, half) / 2.0**self.m, 0.0)]
        for q in range(1, half + 1):
            terms.append(((-1) ** q * 2.0 * math.comb(self.m, half - q) / 2.0**self.m, 2.0 * np.pi * q))
        return tuple(terms)


@dataclass(frozen=True, kw_only=True)
class PolynomialWindow:
    """f(s) = s^m (1 - s)^m on [0, 1].

    Attributes
    ----------
    m : int
        Power; derivatives below the m-th vanish at the ends.
    """

    m: int

    def derivative(self, i: int, s: FloatArray) -> FloatArray:
        """Return f^(i)(s), same shape as s."""
        f = np.polynomial.Polynomial([0.0, 1.0]) ** self.m * np.polynomial.Polynomial([1.0, -1.0]) ** self.m
        return np.asarray(f.deriv(i)(s) if i else f(s), dtype=np.float64)


Window = SinePower | PolynomialWindow


def require_window(window: Window, order: int) -> None:
    """Refuse a window that is too flat-footed for the order.

    Raises
    ------
    InputError
        m below n: terms at the window's ends would remain.
    """
    if window.m < order:
        raise InputError(
            f"window of power {window.m} for order {order}", where="window", remedy=f"take a power of at least {order}"
        )
