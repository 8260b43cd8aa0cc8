"""Windows: where the simulated state starts anew, so that an integrating plant does not drift out of all bounds."""

from __future__ import annotations

import numpy as np

from autotune.arrays import IntArray
from autotune.diagnosis.simulation.chain import build_chain
from autotune.models import Model
from autotune.recording import Recording

#: Windows last this many of the slowest lag's time constants: long enough for structure to show.
LAGS_PER_WINDOW = 10.0
LEAST_ROWS = 60
LEAST_WINDOWS = 6
#: What was commanded before a recording begins is unknown: that many of the slowest lags after the dead time it acts no
#: more (through a dead time, a rate limit); at most this share of the recording is left out.
UNKNOWN_LAGS, MOST_LEFT_OUT = 1.0, 0.03


def slowest_lag_s(model: Model) -> float:
    """Return the slowest time constant of a model's chain [s], integrators left aside."""
    poles = np.linalg.eigvals(build_chain(model).A)
    rates = np.abs(poles.real)
    rates = rates[rates > 1e-9 * max(float(np.abs(poles).max()), 1e-12)]
    return float(1.0 / rates.min()) if rates.size else 0.0


def known_from_s(model: Model, recording: Recording) -> float:
    """Return the time from which on a recording's own commands tell what acts [s]."""
    delay = sum(block.dynamics.delay_s for block in model.blocks)
    unknown = delay + UNKNOWN_LAGS * slowest_lag_s(model)
    return float(recording.t[0] + min(unknown, MOST_LEFT_OUT * recording.duration_s))


def window_rows(recording: Recording, length_s: float, from_s: float) -> tuple[IntArray, IntArray]:
    """Return the rows where windows of about a length start, and those before which they end.

    Parameters
    ----------
    recording : Recording
        What is cut.
    length_s : float
        Length of a window [s].
    from_s : float
        Time before which no window starts [s].
    """
    duration = recording.t[-1] - from_s
    length = max(length_s, LEAST_ROWS * recording.sample_time_s)
    count = max(1, round(duration / length), min(LEAST_WINDOWS, len(recording) // LEAST_ROWS))
    edges = from_s + duration / count * np.arange(count)
    starts = np.unique(np.searchsorted(recording.t, edges - 1e-9)).astype(np.int64)
    return starts, np.append(starts[1:], len(recording))
