"""Adequacy: whether what the chosen model leaves of the recordings is noise.

Three looks at the residual: its variance beside the noise that its own row-to-row jitter shows, its slow part, and what
swings, bends or goes past the chain. The bounds were counted on concealed cases, none of them of the proof (``python -m
tests.benchmarks calibrate``): they stand where nothing that is right is refused any more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from autotune.diagnosis.evidence.constancy import Variation, largest_variation
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.retuning import BLOCKS, reduced_chi2, whiteness

#: Reduced chi-square up to which a model is adequate, beside one standard deviation of it.
ADEQUATE = 1.04
#: The same for a residual without any slow part: then what is more is jitter that the differences of coloured noise did
#: not show, and physics left out would have been slow.
ADEQUATE_QUICK, QUICK = 1.12, 1.0
#: The same for the slow part of the residual, after its own AR(2) has been taken out, beside two standard deviations.
WHITE = 1.10
#: Chi-square of the largest of some hundred score tests (:mod:`autotune.diagnosis.evidence.constancy`) from which on
#: something swings or leads past the chain that the model does not have, and its least share of what effects gained:
#: right models leave up to 15 (where thresholds make fits rough two hundredths of what they gain), wrong ones a third.
INCONSTANT, OF_THE_GAINED = 25.0, 0.1
#: Share of what effects gained from which on what they leave weighs as much as they do; real rigs leave a quarter.
HALF_OF_THE_GAINED = 0.5


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
        What would explain most of it among what swings, bends and goes past the chain.
    gained : float
        Penalised chi-square that the effects gained beside the retuned model.
    """

    reduced_chi2: float
    reduced_chi2_chance: float
    slow: float
    slow_chance: float
    varies: Variation
    gained: float

    @property
    def allowed(self) -> float:
        """Largest reduced chi-square of noise."""
        return (ADEQUATE_QUICK if self._is_white(QUICK) else ADEQUATE) + self.reduced_chi2_chance

    @property
    def is_noise(self) -> bool:
        """Whether it is noise: no more variance than its jitter shows, no slow part, and nothing that varies."""
        return self.reduced_chi2 < self.allowed and self._is_white(WHITE) and self.is_constant

    @property
    def is_constant(self) -> bool:
        """Whether nothing swings, bends or goes past the chain in it, beside what the effects gained."""
        return self.varies.gain < max(INCONSTANT, OF_THE_GAINED * self.gained)

    @property
    def is_lesser(self) -> bool:
        """Whether what varies in it is less than half of what the effects gained."""
        return self.varies.gain < HALF_OF_THE_GAINED * self.gained

    def _is_white(self, bound: float) -> bool:
        return self.slow < bound + 2.0 * self.slow_chance

    def as_json(self) -> dict[str, Any]:
        """Return the content of the key ``residual`` of diagnosis.json."""
        period = self.varies.period_s
        varies = {"chi2": self.varies.gain, "places": list(self.varies.places), "what": self.varies.what,
                  "period_s": period if math.isfinite(period) else None}  # fmt: skip
        return {
            "reduced_chi2": self.reduced_chi2,
            "reduced_chi2_chance": self.reduced_chi2_chance,
            "slow": self.slow,
            "slow_chance": self.slow_chance,
            "gained": self.gained,
            "varies": varies,
        }


def residual_tests(result: Fit, data: Data, gained: float) -> ResidualTests:
    """Return what a model leaves.

    Parameters
    ----------
    result : Fit
        A fit at its minimum.
    data : Data
        What it was fitted to.
    gained : float
        Penalised chi-square that its effects gained beside the retuned model.
    """
    return ResidualTests(
        reduced_chi2=reduced_chi2(result, data),
        reduced_chi2_chance=math.sqrt(2.0 / result.rows),
        slow=whiteness(result, data),
        slow_chance=_slow_chance(result),
        varies=largest_variation(result, data),
        gained=gained,
    )


def _slow_chance(result: Fit) -> float:
    return math.sqrt(2.0 / (BLOCKS * len(result.windows)))


def is_white(result: Fit, data: Data) -> bool:
    """Whether a residual has no slow part beyond what chance brings."""
    return whiteness(result, data) < WHITE + 2.0 * _slow_chance(result)
