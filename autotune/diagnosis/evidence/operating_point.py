"""What the operating point tells: commands that never move, and a shift that stands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.residual import shifts_by_window
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import ALL
from autotune.models import Model
from autotune.recording import Recording

#: Share of its whole travel within which a recording's first reading is at the model's rest.
AT_REST = 0.02


@dataclass(frozen=True, kw_only=True)
class Offset:
    """A shift of the operating point with its 1-sigma [u]."""

    value: float
    sd: float


def unmoved(model: Model, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the effects that are not told from others where no command moves.

    Those that act on the command are a constant there, and what only bends or delays the reading is the plant in other
    coordinates. A recording that begins at the model's rest under another command begins with a step.
    """
    if any(float(np.ptp(r.u[r.first_reading :])) > 0.0 or _begins_with_a_step(model, r) for r in recordings):
        return ()
    return tuple(k.name for k in ALL if k.place == "actuator" or k.name == "timing.dead_time" or k.recoordinates)


def _begins_with_a_step(model: Model, recording: Recording) -> bool:
    readings = recording.y[np.isfinite(recording.y)]
    at_rest = abs(float(readings[0]) - model.output.offset) <= AT_REST * float(np.ptp(readings))
    return at_rest and float(recording.u[0]) != model.input.offset


def offset_of(result: Fit, beyond_chance: float = Thresholds.beyond_chance) -> Offset | None:
    """Return the operating point's shift where it is far outside its uncertainty.

    A shift may wander from window to window: its uncertainty is at least that of the windows' mean.
    """
    for i, free in enumerate(result.parametrisation.free):
        if free.kind == "u_offset":
            variance = max(float(result.covariance[i, i]), 0.0)
            sd = math.sqrt(max(variance, _variance_of_mean(shifts_by_window(result, i)))) * free.size
            shift = result.theta[i] * free.size
            if sd > 0.0 and shift**2 > beyond_chance * sd**2 and abs(shift) > 1e-3 * free.size:
                return Offset(value=-shift, sd=sd)
    return None


def _variance_of_mean(x: FloatArray) -> float:
    """Return the variance of the mean of values that follow one another, each like the one before."""
    d = x - np.mean(x) if x.size > 3 else np.zeros(0)
    if not np.any(d):
        return 0.0
    alike = float(np.clip(d[1:] @ d[:-1] / (d @ d), 0.0, 0.9))
    return float(np.mean(d**2)) * (1.0 + alike) / (1.0 - alike) / x.size
