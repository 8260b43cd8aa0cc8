"""The measurement noise, estimated without believing any model's slow behaviour.

Differences of a simulation residual keep the noise and lose what is slow: what a structure lacks moves over many
samples. For AR(1) noise n_k = rho n_{k-1} + e_k the first difference has variance 2 s^2 (1 - rho) and lag-one
covariance -s^2 (1 - rho)^2, which gives both numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, FloatArray

#: Correlation from row to row beyond which a first difference cannot tell noise from a slow residual.
LARGEST_CORRELATION = 0.9
#: Ratio of the standard deviations that the farthest tenth and the median of differences tell, from which on most of
#: them are small and some are jumps: normal noise has 1, Laplace's 1.4.
MOSTLY_SMALL = 2.0


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Autoregressive noise n_k = a1 n_{k-1} + ... + e_k.

    Attributes
    ----------
    sd : float
        Standard deviation of the innovations e.
    ar : tuple of float
        a1, a2, ...
    """

    sd: float
    ar: tuple[float, ...] = ()

    @property
    def total_sd(self) -> float:
        """Standard deviation of the noise itself."""
        if not self.ar:
            return self.sd
        response = np.zeros(400)
        response[0] = 1.0
        for k in range(1, response.size):
            for lag, a in enumerate(self.ar[:k], start=1):
                response[k] += a * response[k - lag]
        return float(self.sd * np.sqrt(response @ response))


def noise_from_differences(residuals: Sequence[FloatArray], good: Sequence[BoolArray]) -> Noise:
    """Estimate the measurement noise as AR(1).

    Parameters
    ----------
    residuals : sequence of (N,) array
        y - y_sim per recording, or y itself.
    good : sequence of (N,) bool array
        Rows that count.

    Returns
    -------
    Noise
        Innovations in the residual's unit and the correlation from one row to the next.

    Notes
    -----
    Differences are winsorised at 4.5 robust standard deviations, so that single jumps (a relay's edge that the model
    misses, an outlier) do not count as noise; a coarse converter's do, where a tenth of the rows has them. What is
    missing and faster than some samples is taken for noise.
    """
    c0 = c1 = n = 0.0
    for r, ok in zip(residuals, good, strict=True):
        d = np.diff(r)
        use = ok[1:] & ok[:-1]
        if use.sum() < 8:
            continue
        spread = _usual_spread(d[use])
        if spread > 0.0:
            d = np.clip(d, -4.5 * spread, 4.5 * spread)
        d = np.where(use, d - np.mean(d[use]), 0.0)
        c0 += float(d @ d)
        c1 += float(d[1:] @ d[:-1])
        n += float(use.sum())
    if n == 0.0 or c0 == 0.0:
        return Noise(sd=0.0)
    rho = float(np.clip(1.0 + 2.0 * c1 / c0, 0.0, LARGEST_CORRELATION))
    return Noise(sd=float(np.sqrt(c0 / n * (1.0 + rho) / 2.0)), ar=(rho,))


def _usual_spread(d: FloatArray) -> float:
    """Return a robust standard deviation: from the median, or from the farthest tenth where most differences are small.

    Behind a coarse converter most readings stay: their median tells nothing of its jumps.
    """
    off = np.abs(d - np.median(d))
    usual, far = 1.4826 * float(np.median(off)), float(np.quantile(off, 0.9)) / 1.645
    return far if far > MOSTLY_SMALL * usual else usual


def autoregressive_up_to(residuals: Sequence[FloatArray], good: Sequence[BoolArray], orders: int) -> list[Noise]:
    """Return autoregressive models of a residual that is taken to be noise alone, of every order from 1 on.

    They are Yule and Walker's; residuals and rows that count as in :func:`noise_from_differences`.
    """
    c = _autocovariances(residuals, good, orders)
    return [_yule_walker(c[: order + 1]) for order in range(1, orders + 1)]


def _autocovariances(residuals: Sequence[FloatArray], good: Sequence[BoolArray], order: int) -> FloatArray:
    c = np.zeros(order + 1)
    for lag in range(order + 1):
        count = 0
        for r, ok in zip(residuals, good, strict=True):
            both = ok[lag:] & ok[: r.size - lag]
            c[lag] += float(np.sum((r[lag:] * r[: r.size - lag])[both]))
            count += int(both.sum())
        c[lag] /= max(count, 1)
    return c


def _yule_walker(c: FloatArray) -> Noise:
    """Return the autoregressive model that autocovariances from lag 0 on belong to."""
    order = c.size - 1
    if c[0] <= 0.0:
        return Noise(sd=0.0)
    R = np.array([[c[abs(i - j)] for j in range(order)] for i in range(order)]) + 1e-9 * c[0] * np.eye(order)
    a = np.linalg.solve(R, c[1:])
    return Noise(sd=float(np.sqrt(max(c[0] - a @ c[1:], 1e-12 * c[0]))), ar=tuple(float(x) for x in a))
