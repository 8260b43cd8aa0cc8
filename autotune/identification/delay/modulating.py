"""Modulating functions: windows whose derivatives vanish at both ends, so that integrals by parts have no end terms.

For f with f^(j)(0) = f^(j)(1) = 0, j < m, m >= n: I_{x^(i), f} = (-1)^i I_{x, f^(i)}. Derivatives of x are never
taken, and no initial state appears.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray


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
        """Return f^(i)(s), same shape as s.

        Parameters
        ----------
        i : int
            Order of the derivative, 0 for f itself.
        s : array
            Place in the interval, 0 to 1; any shape.
        """
        total = np.zeros(s.shape)
        for c, omega in self.fourier():
            total += np.real(c * (1j * omega) ** i * np.exp(1j * omega * s))
        return total

    def fourier(self) -> tuple[tuple[complex, float], ...]:
        """Return (c_q, omega_q), f(s) = sum Re c_q exp(j omega_q s), the lowest frequency first.

        Even powers are cosines of whole periods and a constant, odd powers sines of half periods (1, 3, ..).
        """
        terms: list[tuple[complex, float]] = []
        if self.m % 2 == 0:
            terms.append((math.comb(self.m, self.m // 2) / 2.0**self.m + 0j, 0.0))
        for frequency in range(2 - self.m % 2, self.m + 1, 2):
            q = (self.m - frequency) // 2  # sin^m = (2j)^-m sum_q C(m, q) (-1)^q exp(j (m - 2q) theta)
            terms.append((2.0 * math.comb(self.m, q) * (-1) ** q / (2j) ** self.m, math.pi * frequency))
        return tuple(terms)
