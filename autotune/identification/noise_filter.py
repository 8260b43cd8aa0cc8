"""Filters that make noise white: of an autoregression, and of a load that wanders.

A plant's output wanders with its load, far more slowly than a sensor's noise, and few rows show it: an autoregression
that a criterion chooses from a residual leaves it out. It comes in where the command does, through the plant's own
lags, so that one variance says what it does at all frequencies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from autotune.arrays import ComplexArray, FloatArray

#: What a load adds to the density of the other noise at its own corner frequency, from hardly anything to all.
_LOADS = np.geomspace(0.03, 1000.0, 10)


@dataclass(frozen=True, kw_only=True, eq=False)
class Whitening:
    """The filter (1 + c_1 q^-1 + ..)/(1 + d_1 q^-1 + ..), q^-1 the previous row, that makes a noise white.

    Attributes
    ----------
    ar : (p,) array
        c_1..c_p: of the autoregression, and of the load that d goes with.
    ma : (r,) array
        d_1..d_r, r at most p; empty where no load was found.
    """

    ar: FloatArray = field(default_factory=lambda: np.empty(0))
    ma: FloatArray = field(default_factory=lambda: np.empty(0))

    @property
    def lost(self) -> int:
        """Rows at the beginning that are dropped: an autoregression knows no past; a load begins at the first row."""
        return self.ar.size - self.ma.size

    def filtered(self, signals: FloatArray) -> FloatArray:
        """Return signals (N, S) filtered as if nothing had been before them, (N, S)."""
        rows = np.vstack([np.zeros((self.ar.size, signals.shape[1])), signals])
        white = np.zeros((self.ma.size + len(signals), signals.shape[1]))
        filter_rows(rows, self.ar, self.ma, white)
        return white[self.ma.size :]


WHITE = Whitening()


@njit(cache=True, nogil=True)
def filter_rows(rows: FloatArray, ar: FloatArray, ma: FloatArray, white: FloatArray) -> None:
    """Write the filtered rows.

    Parameters
    ----------
    rows : (p + N, S) array
        Signals, after those of the p rows before them.
    ar, ma : (p,) and (r,) arrays
        The filter's, as of :class:`Whitening`.
    white : (r + N, S) array
        Where they are written, after the r filtered ones before them.
    """
    p, r = ar.size, ma.size
    for k in range(rows.shape[0] - p):
        for c in range(rows.shape[1]):
            total = rows[p + k, c]
            for i in range(p):
                total += ar[i] * rows[p + k - 1 - i, c]
            for i in range(r):
                total -= ma[i] * white[r + k - 1 - i, c]
            white[r + k, c] = total


def load_filters(poles: ComplexArray, corner: float) -> list[Whitening]:
    """Return the filters that whiten white noise with a load of several sizes, none first.

    Parameters
    ----------
    poles : (r,) array
        From one row to the next of what the load is on its way to y: its own and the plant's.
    corner : float
        Frequency [rad/row] at which it is held against the white noise.

    Notes
    -----
    With w = 2 - z - 1/z each pole p has (1 - p/z)(1 - p z) = (1 - p)^2 + p w. The noise's spectrum is that of the
    poles' product, and the ratio of variances more, over that product: its zeros come from the roots in w, which keep
    the digits that those in z lose beside 1. Zeros of the load's own way do not count.
    """
    squares = (1.0 - poles) ** 2
    unit = corner**2
    product = np.array([1.0 + 0.0j])  # ascending powers of w over the unit
    for square, pole in zip(squares, poles, strict=True):
        product = np.convolve(product, np.array([square / unit, pole]))
    at_corner = float(np.abs(np.polyval(product[::-1], 2.0 * (1.0 - math.cos(corner)) / unit)))
    ar = np.real(np.poly(poles))[1:].copy()  # rows in memory, as all filters are: another layout is compiled again
    found = [WHITE]
    for ratio in _LOADS:
        w = unit * np.roots((product + ratio * at_corner * (np.arange(product.size) == 0))[::-1])
        root = np.sqrt(-0.5 * w * (2.0 - 0.5 * w))
        zeros = 1.0 - 0.5 * w - np.where(np.abs(1.0 - 0.5 * w - root) < 1.0, root, -root)
        found.append(Whitening(ar=ar, ma=np.real(np.poly(zeros))[1:].copy()))
    return found
