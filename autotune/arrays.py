"""Array types that every room uses in its signatures, and deviations that rounding leaves whole."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int64]


def is_real(value: Any) -> bool:
    """Return whether something is a number that floating point holds, NaN and infinity included; True is none."""
    # hasattr and not isinstance(value, SupportsFloat), which says the same and takes twenty times as long
    if isinstance(value, bool | str | bytes) or not hasattr(value, "__float__"):
        return False
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


def deviations_beside_prior(J: FloatArray) -> FloatArray:
    """Return standard deviations of numbers from derivatives in units of the noise, beside a prior of deviation 1.

    Parameters
    ----------
    J : (N, p) array
        Derivatives of the whitened residual by every number, in units of what is believed of it.

    Returns
    -------
    (p,) array
        Roots of the diagonal of (J' J + I)^-1: between 0 and 1.

    Notes
    -----
    J' J + I = R' R for the triangular factor R of [J; I], so the diagonal is a sum of squares: an inverse of the
    product loses it to rounding where one number says a million times more than another, and may leave it negative.
    """
    R = np.linalg.qr(np.vstack([J, np.eye(J.shape[1])]), mode="r")
    rows = np.linalg.solve(R, np.eye(J.shape[1]))  # its factors are I and R: substitution alone
    return np.asarray(np.linalg.norm(rows, axis=1))
