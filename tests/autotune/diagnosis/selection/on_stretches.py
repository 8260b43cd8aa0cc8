"""A hypothesis without a simulator: its errors on stretches are stated."""

from __future__ import annotations

import math
from collections.abc import Sequence

from autotune.diagnosis.selection.judged import Judged
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.models import Effect


class Astray(Judged):
    """A hypothesis of a rig whose model errs by more than noise: stretches judge it."""

    leaves_noise = False
    limits: Thresholds = IN_USE
    variance, rows, numbers, error, added = math.nan, 0, 0, 1.0, ()
    beside_still = ()

    def unfelt(self, effects: Sequence[Effect]) -> frozenset[str]:
        """Return none: every effect would be felt."""
        return frozenset()

    @property
    def identity(self) -> frozenset[object]:
        """What tells hypotheses apart."""
        return frozenset(self.names)
