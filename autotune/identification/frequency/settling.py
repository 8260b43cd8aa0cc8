"""Whether a limit cycle has settled: a convergence statistic that can be evaluated while the relay runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.frequency.limit_cycle import relay_edges


@dataclass(frozen=True, kw_only=True)
class Settling:
    """How far the last cycles still move.

    Attributes
    ----------
    change : float
        Largest relative change from one period to the next, of the period or of the amplitude of y.
    change_sd : float
        Its standard deviation, from the scatter of the cycles and the noise.
    tolerance : float
        Relative change that is asked for.
    periods : int
        Whole periods looked at.
    """

    change: float
    change_sd: float
    tolerance: float
    periods: int

    @property
    def is_settled(self) -> bool:
        """Whether the change is within the tolerance, or cannot be told from the noise at two standard deviations."""
        return self.change <= max(self.tolerance, 2.0 * self.change_sd)


def settling(
    t: FloatArray, u: FloatArray, y: FloatArray, *, tolerance: float = 0.02, last_periods: int = 3
) -> Settling:
    """Judge from the recorded arrays whether the limit cycle under a constant relay setting has settled.

    Parameters
    ----------
    t, u, y : (N,) array
        Stamps [s], held command and measurement since the setting was made.
    tolerance : float
        Relative change per period that is small enough. The estimate carries what is left of the transient, so
        2 % costs it nothing that can be seen.
    last_periods : int
        Periods looked at, at least two: the latest ones, so that the start is forgotten.

    Returns
    -------
    Settling
        The change per period with its standard deviation; ``is_settled`` is the verdict.

    Raises
    ------
    IdentificationError
        No relay in the command, or fewer than two whole periods yet.

    Notes
    -----
    Each period gives its length and, by least squares over it with offset and drift, the fundamental amplitude of y.
    With two periods the change is their difference; with more, the slope of a line. A change hidden in the noise is
    smaller than what the noise does to the points as well.
    """
    edges = relay_edges(t, u)
    rises = edges.times_s[edges.rising][-(last_periods + 1) :]
    falls = edges.times_s[~edges.rising][-(last_periods + 1) :]
    starts = rises if rises.size and (not falls.size or rises[-1] > falls[-1]) else falls
    if starts.size < 3:
        raise IdentificationError(
            f"{max(starts.size - 1, 0)} whole period(s) so far", where="limit cycle", mend="wait for two whole periods"
        )
    lengths = np.diff(starts)
    amplitudes, variances = np.empty(lengths.size), np.empty(lengths.size)
    for i in range(lengths.size):
        amplitudes[i], variances[i] = _amplitude(t, y, float(starts[i]), float(starts[i + 1]))
    step = float(np.median(np.diff(t)))
    period = _change(lengths, np.full(lengths.size, step**2 / 6.0))
    amplitude = _change(amplitudes, variances)
    change, change_sd = max((period, amplitude), key=lambda pair: pair[0] - 2.0 * pair[1])
    return Settling(change=change, change_sd=change_sd, tolerance=tolerance, periods=lengths.size)


def _amplitude(t: FloatArray, y: FloatArray, start_s: float, end_s: float) -> tuple[float, float]:
    """Return the fundamental amplitude over one period and its variance."""
    use = (t >= start_s) & (t < end_s) & np.isfinite(y)
    count = int(use.sum())
    if count < 8:
        raise IdentificationError(
            f"{count} samples in one period are too few",
            where="limit cycle",
            mend="sample faster, or add delay to the relay so that it oscillates more slowly",
        )
    x = (t[use] - start_s) / (end_s - start_s)
    orders = (1, 3) if count < 16 else (1, 2, 3, 5)
    columns = [f(2.0 * np.pi * n * x) for n in orders for f in (np.cos, np.sin)]
    design = np.column_stack([*columns, np.ones_like(x), x])
    theta, *_ = np.linalg.lstsq(design, y[use], rcond=None)
    left = y[use] - design @ theta
    variance = float(left @ left) / max(count - design.shape[1], 1)
    return math.hypot(theta[0], theta[1]), variance * float(np.linalg.inv(design.T @ design)[0, 0])


def _change(values: FloatArray, variances: FloatArray) -> tuple[float, float]:
    """Return the relative change per period (slope of a line) and its standard deviation."""
    x = np.arange(values.size) - 0.5 * (values.size - 1)
    weights = x / (x @ x)
    slope = float(weights @ values)
    left = values - values.mean() - slope * x
    scatter = float(left @ left) / (values.size - 2) if values.size > 2 else 0.0
    # the scatter of so few cycles has one or two degrees of freedom: never less than what noise alone explains
    variance = np.maximum(variances, scatter)
    mean = max(float(np.abs(values.mean())), 1e-300)
    return abs(slope) / mean, math.sqrt(float(weights**2 @ variance)) / mean
