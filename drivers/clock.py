"""The clock of a real rig: monotonic, with absolute deadlines."""

from __future__ import annotations

import time

_SPIN_S = 300e-6


class MonotonicClock:
    """Seconds since the clock was made, on the operating system's monotonic clock.

    Notes
    -----
    A plain sleep wakes 0.1 ms late in the median and several milliseconds under load. Sleeping until 0.3 ms before the
    deadline and spinning over the rest is a few microseconds late in the median; what the scheduler adds beyond that
    is in the time stamps, so nothing may assume that a deadline was met.
    """

    #: time goes on whether anybody waits or not
    goes_on = True

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def now(self) -> float:
        """Return the time [s]."""
        return time.perf_counter() - self._start

    def sleep_until(self, t_s: float) -> None:
        """Return at the absolute deadline ``t_s`` [s], at once when it has passed."""
        remaining = t_s - self.now()
        if remaining > _SPIN_S:
            time.sleep(remaining - _SPIN_S)
        while self.now() < t_s:
            pass
