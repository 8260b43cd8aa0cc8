"""Quantiles and tails of the distributions that tests and regions rest on, from scipy.special.

The objects of scipy.stats give the same numbers; importing them takes a third of a second, a tenth of a whole tuning.
"""

from __future__ import annotations

from typing import TypeVar

from scipy.special import chdtrc, chdtri, fdtrc, fdtri, log_ndtr, ndtr, ndtri, stdtrit

from autotune.arrays import FloatArray

Values = TypeVar("Values", float, FloatArray)


def chi2_quantile(probability: float, freedom: float) -> float:
    """Return the value below which chi-square lies with a probability.

    Parameters
    ----------
    probability : float
        0 to 1.
    freedom : float
        Degrees of freedom.
    """
    return float(chdtri(freedom, 1.0 - probability))


def chi2_tail(value: float, freedom: float) -> float:
    """Return the probability that chi-square exceeds a value.

    Parameters
    ----------
    value : float
        At least 0.
    freedom : float
        Degrees of freedom.
    """
    return float(chdtrc(freedom, value))


def f_quantile(probability: float, above: float, below: float) -> float:
    """Return the value below which the ratio F of two mean squares lies with a probability.

    Parameters
    ----------
    probability : float
        0 to 1.
    above, below : float
        Degrees of freedom of the numerator and of the denominator.
    """
    return float(fdtri(above, below, probability))


def f_tail(value: float, above: float, below: float) -> float:
    """Return the probability that the ratio F of two mean squares exceeds a value.

    Parameters
    ----------
    value : float
        At least 0.
    above, below : float
        Degrees of freedom of the numerator and of the denominator.
    """
    return float(fdtrc(above, below, value))


def normal_quantile(probability: float) -> float:
    """Return the value below which the standard normal distribution lies with a probability."""
    return float(ndtri(probability))


def normal_tail(value: Values) -> Values:
    """Return the probability that a standard normal variable exceeds each value."""
    return ndtr(-value)


def log_normal_tail(value: Values) -> Values:
    """Return the logarithm of the probability that a standard normal variable exceeds each value."""
    return log_ndtr(-value)


def student_quantile(probability: float, freedom: Values) -> Values:
    """Return the value below which Student's t lies with a probability.

    Parameters
    ----------
    probability : float
        0 to 1.
    freedom : float or (N,) array
        Degrees of freedom.

    Returns
    -------
    float or (N,) array
        One for each number of degrees of freedom.
    """
    return stdtrit(freedom, probability)  # type: ignore[return-value]  # of the stubs: half precision too
