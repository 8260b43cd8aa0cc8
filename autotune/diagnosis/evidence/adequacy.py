"""Adequacy: whether what the chosen model leaves of the recordings is noise.

Three looks at the residual: its variance beside the noise that its own row-to-row jitter shows, its slow part, and what
swings, bends or goes past the chain. The bounds stand where nothing that is right is refused any more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.constancy import UNASKED, Variation, largest_variation
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.retuning import BLOCKS, reduced_chi2, under_noise, whiteness
from autotune.diagnosis.thresholds import Thresholds


@dataclass(frozen=True, kw_only=True)
class ResidualTests:
    """Whether what a model leaves of the recordings is noise.

    Attributes
    ----------
    reduced_chi2 : float
        Variance of the residual over the noise's.
    reduced_chi2_chance : float
        Standard deviation that chance gives to it.
    slow : float
        Slow power of the residual over the noise's, after its own AR(2) has been taken out.
    slow_chance : float
        Standard deviation that chance gives to it.
    varies : Variation
        What would explain most of it among what swings, bends and goes past the chain where that is asked.
    uneven : bool
        Whether samples show that some rows' noise is larger than others': the variance then says nothing.
    accounted : bool
        Whether a noise that is not white accounts for it: one of its own colour, or that of rows which are late.
    limits : Thresholds
        What decides between two findings.
    """

    reduced_chi2: float
    reduced_chi2_chance: float
    slow: float
    slow_chance: float
    varies: Variation = UNASKED
    uneven: bool = False
    accounted: bool = False
    limits: Thresholds = field(default_factory=Thresholds)

    @property
    def allowed(self) -> float:
        """Largest reduced chi-square of noise: larger where it has no slow part, whose power over noise's is then 1."""
        limits = self.limits
        return (limits.white if self._is_white(1.0) else limits.adequate) + self.reduced_chi2_chance

    @property
    def is_noise(self) -> bool:
        """Whether it is noise: no more variance than its jitter shows, no slow part, nothing that varies."""
        even = self.uneven or self.reduced_chi2 < self.allowed
        return self.accounted or (even and self.is_slowly_white and self.is_constant)

    @property
    def is_slowly_white(self) -> bool:
        """Whether it has no slow part beyond what chance brings."""
        return self._is_white(self.limits.white)

    @property
    def is_missing(self) -> bool:
        """Whether its variance alone shows that something is missing."""
        return not (self.uneven or self.accounted) and self.reduced_chi2 > self.limits.adequate

    @property
    def is_constant(self) -> bool:
        """Whether nothing swings, bends or goes past the chain in it."""
        return self.accounted or self.varies.gain < self.limits.beyond_chance

    def _is_white(self, bound: float) -> bool:
        return self.slow < bound + 2.0 * self.slow_chance

    def as_json(self) -> dict[str, Any]:
        """Return the content of the key ``residual`` of diagnosis.json."""
        return {
            "reduced_chi2": self.reduced_chi2,
            "reduced_chi2_chance": self.reduced_chi2_chance,
            "slow": self.slow,
            "slow_chance": self.slow_chance,
            "uneven": self.uneven,
            "accounted": self.accounted,
            "varies": self.varies.as_json(),
        }


def residual_tests(result: Fit, data: Data, *, uneven: bool = False) -> ResidualTests:
    """Return what a model leaves.

    Parameters
    ----------
    result : Fit
        A fit at its minimum.
    data : Data
        What it was fitted to.
    uneven : bool
        Whether samples show that some rows' noise is larger than others'.
    """
    return ResidualTests(
        reduced_chi2=reduced_chi2(result, data),
        reduced_chi2_chance=math.sqrt(2.0 / result.rows),
        slow=whiteness(result, data),
        slow_chance=_slow_chance(result),
        varies=largest_variation(result, data),
        uneven=uneven,
        limits=data.thresholds,
    )


def strongest_line(result: Fit, data: Data) -> float:
    """Return the logarithm of the odds against chance of the strongest line in a residual's spectrum.

    Where a signal swings within some rows, what a model lacks swings as fast: differences from row to row take that for
    noise, and blocks of rows do not see it. Noise has no line.

    Notes
    -----
    Of N ordinates of a periodogram of white noise of mean 1 the largest is above x with probability N exp(-x). The
    residual is whitened by the noise that fits assume; the mean is taken from the median, which a few lines do not
    move.

    References
    ----------
    Fisher, Proc. R. Soc. A 125, 1929: tests of significance in harmonic analysis.
    """
    return line_in(data.whitened(list(result.residuals)))


def line_in(parts: Sequence[FloatArray]) -> float:
    """Return the logarithm of the odds against chance of the strongest line in parts that are whitened."""
    odds = [0.0]
    for e in parts:
        power = np.abs(np.fft.rfft(e * np.hanning(e.size))[2:-1]) ** 2
        middle = float(np.median(power)) / math.log(2.0) if power.size else 0.0
        if middle > 0.0:
            odds.append(float(np.max(power)) / middle - math.log(power.size))
    return max(odds)


def _slow_chance(result: Fit) -> float:
    return math.sqrt(2.0 / (BLOCKS * len(result.windows)))


def is_noise(result: Fit, data: Data) -> bool:
    """Whether a residual has no more variance than its jitter shows and no slow part: its size alone is looked at.

    What is as correlated from row to row as ``slow_noise`` is no noise: a model's error is as slow.
    """
    limits, slow, chance = data.thresholds, whiteness(result, data), 2.0 * _slow_chance(result)
    correlation = max(under_noise(result, data).noise.ar, default=0.0)
    allowed = limits.white if slow < 1.0 + chance else limits.adequate
    quiet = reduced_chi2(result, data) < allowed + math.sqrt(2.0 / result.rows)
    return quiet and slow < limits.white + chance and correlation < limits.slow_noise
