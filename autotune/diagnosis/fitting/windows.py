"""Windows: where the simulated state starts anew, so that an integrating plant does not drift out of all bounds."""

from __future__ import annotations

import numpy as np

from autotune.arrays import IntArray
from autotune.diagnosis.simulation.chain import build_chain
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.models import Model
from autotune.poles import slowest_lag_s
from autotune.recording import Recording


def model_lag_s(model: Model) -> float:
    """Return the slowest time constant of a model's chain [s], integrators left aside."""
    return slowest_lag_s(np.linalg.eigvals(build_chain(model).A))


def known_from_s(model: Model, recording: Recording, thresholds: Thresholds = IN_USE) -> float:
    """Return the time from which on a recording's own commands tell what acts [s].

    What was commanded before a recording begins is unknown: a slowest lag after the dead time it acts little
    more (through a dead time, a rate limit). No window begins before the first reading.
    """
    unknown = model.delay_s + model_lag_s(model)
    from_s = float(recording.t[0] + min(unknown, thresholds.most_left_out * recording.duration_s))
    return max(from_s, float(recording.t[recording.first_reading]))


def window_rows(
    recording: Recording, length_s: float, from_s: float, thresholds: Thresholds = IN_USE
) -> tuple[IntArray, IntArray]:
    """Return the rows where windows of about a length start, and those before which they end.

    Parameters
    ----------
    recording : Recording
        What is cut.
    length_s : float
        Length of a window [s].
    from_s : float
        Time before which no window starts [s].
    thresholds : Thresholds
        How few rows and windows there may be.
    """
    duration = recording.t[-1] - from_s
    least = thresholds.least_window_rows
    length = max(length_s, least * recording.sample_time_s)
    count = max(1, round(duration / length), min(thresholds.least_windows, len(recording) // least))
    edges = from_s + duration / count * np.arange(count)
    starts = np.unique(np.searchsorted(recording.t, edges - 1e-6 * recording.sample_time_s)).astype(np.int64)
    return starts, np.append(starts[1:], len(recording))
