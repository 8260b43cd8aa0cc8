"""Array types that every room uses in its signatures, and inverses and deviations that rounding leaves whole."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int64]

#: part of the largest eigenvalue of a product below which another may be rounding
_ROUNDING = 1e-13


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


def inverse_in_any_units(matrix: FloatArray) -> FloatArray:
    """Return the pseudo-inverse of a covariance or an information, whatever the units of its rows.

    Parameters
    ----------
    matrix : (P, P) array
        Symmetric, not negative.

    Returns
    -------
    (P, P) array
        Its inverse; directions that the matrix does not hold, once every diagonal element is 1, stay 0.

    Notes
    -----
    What a pseudo-inverse leaves out as rounding depends on the units otherwise: beside the variance of a dead time of
    minutes, that of a small gain per second is none.
    """
    scale = _deviations(matrix)
    unit = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=_ROUNDING, hermitian=True)
    return np.asarray(unit / np.outer(scale, scale), dtype=np.float64)


def principal_axes(covariance: FloatArray) -> FloatArray:
    """Return A with A A' = covariance, to the accuracy of each row's own deviation.

    Parameters
    ----------
    covariance : (P, P) array
        Symmetric, not negative.

    Returns
    -------
    (P, P) array
        Its columns are the principal axes where every parameter is measured in its standard deviation, each with its
        largest entry positive: an axis has no sign, and the last digit must not choose one.
    """
    scale = _deviations(covariance)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    largest = np.take_along_axis(vectors, np.argmax(np.abs(vectors), axis=0)[None, :], axis=0)
    vectors = vectors * np.where(largest < 0.0, -1.0, 1.0)
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)), dtype=np.float64)


def _deviations(matrix: FloatArray) -> FloatArray:
    """Return the roots of the diagonal, 1 where it is 0."""
    scale = np.sqrt(np.maximum(np.diagonal(matrix), 0.0))
    return np.where(scale > 0.0, scale, 1.0)


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


def smallest_step(signal: FloatArray) -> float:
    """Return the smallest difference between values (N,) of a signal, below 1e-6 of its range none; 0 of one value."""
    apart = np.diff(np.unique(signal))
    return float(np.min(apart, where=apart > 1e-6 * np.ptp(signal), initial=np.inf)) if apart.size else 0.0


def is_constant(values: FloatArray) -> bool:
    """Return whether values (N,), one at least and all finite, differ by no more than rounding."""
    return bool(np.ptp(values) <= 1e-12 * np.max(np.abs(values)))
