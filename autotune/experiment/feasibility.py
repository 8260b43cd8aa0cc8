"""Up to which frequency a link lets points be measured: what its latency leaves unknown of the time stamps."""

from __future__ import annotations

import math

from autotune.experiment.loop import Timing

#: samples per period that an estimate needs at least
LEAST_SAMPLES = 8


def highest_frequency_rad_s(timing: Timing, sample_time_s: float, gain_sd: float, *, exact: bool) -> float:
    """Return the frequency up to which a point's error from the link stays within the wanted standard deviation.

    Parameters
    ----------
    timing : Timing
        Latencies seen so far.
    sample_time_s : float
        Control period [s].
    gain_sd : float
        Relative standard deviation that is wanted of a point, which is one of its phase as well [rad].
    exact : bool
        Whether rows carry the device's own stamps: then only the samples per period count.

    Returns
    -------
    float
        Angular frequency [rad/s].

    Notes
    -----
    A command acts about one median latency later than its row says, which is a dead time in the phase; the latency's
    scatter averages out over the samples of a period, of which the fewest are assumed.
    """
    by_samples = 2.0 * math.pi / (LEAST_SAMPLES * sample_time_s)
    typical, late, _ = timing.latency_s
    unknown_s = math.hypot(typical, (late - typical) / math.sqrt(LEAST_SAMPLES))
    if exact or not unknown_s > 0.0:  # NaN where nothing was asked for
        return by_samples
    return min(by_samples, gain_sd / unknown_s)
