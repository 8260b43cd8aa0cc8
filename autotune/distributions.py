"""Quantiles and tails of chi-square, that tests and regions rest on, from scipy.special.

The objects of scipy.stats give the same numbers; importing them takes a third of a second, a tenth of a whole tuning.
Other distributions are asked of scipy.special where they are needed.
"""

from __future__ import annotations

from scipy.special import chdtrc, chdtri


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
