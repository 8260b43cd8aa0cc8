"""How late this computer is at a wanted period, tried for two seconds, and how to get real-time priority."""

from __future__ import annotations

import getpass
import os
from dataclasses import dataclass

import numpy as np

from drivers.clock import MonotonicClock

#: how long is tried, and the longest period that is: what the scheduler does to longer ones is the same [s]
TRIED_S, LONGEST_S = 2.0, 0.05
#: real-time priority that is enough: above all that is not real-time, below the kernel's own threads
PRIORITY = 50


@dataclass(frozen=True, kw_only=True)
class Lateness:
    """What was found.

    Attributes
    ----------
    period_s : float
        Time between two deadlines [s].
    deadlines, missed : int
        How many were tried, and how many were later than a period.
    usual_s, late_s, worst_s : float
        Lateness: median, 99 %, worst [s].
    """

    period_s: float
    deadlines: int
    missed: int
    usual_s: float
    late_s: float
    worst_s: float

    def __str__(self) -> str:
        return (
            f"a sample every {1e3 * self.period_s:g} ms: {1e3 * self.usual_s:.3g} ms late in the median,"
            f" {1e3 * self.late_s:.3g} ms in 99 %, {1e3 * self.worst_s:.3g} ms at worst;"
            f" {self.missed} of {self.deadlines} deadlines missed"
        )


def measure_lateness(sample_time_s: float) -> Lateness:
    """Keep absolute deadlines as a run keeps them, and return how late they were met.

    Parameters
    ----------
    sample_time_s : float
        Wanted period [s]; of a longer one than 50 ms this is tried.
    """
    clock = MonotonicClock()
    period_s = min(sample_time_s, LONGEST_S)
    count = round(TRIED_S / period_s)
    start_s, late = clock.now(), np.empty(count)
    for k in range(count):
        deadline_s = start_s + (k + 1) * period_s
        clock.sleep_until(deadline_s)
        late[k] = clock.now() - deadline_s
    return Lateness(
        period_s=period_s,
        deadlines=count,
        missed=int((late > period_s).sum()),
        usual_s=float(np.median(late)),
        late_s=float(np.quantile(late, 0.99)),
        worst_s=float(late.max()),
    )


def real_time_priority() -> tuple[str, str]:
    """Return which scheduling this process has, and how to get real-time priority; the latter empty where it has it."""
    if not hasattr(os, "sched_getscheduler"):
        return "as the operating system gives it", "close other programs during a run"
    policy = os.sched_getscheduler(0)
    if policy in (os.SCHED_FIFO, os.SCHED_RR):
        return f"real-time priority {os.sched_getparam(0).sched_priority}", ""
    return "no real-time priority", f"chrt --fifo {PRIORITY} autotune run CONFIG.toml ...{_missing_permission()}"


def _missing_permission() -> str:
    """Return what has to be done before a program may ask for it; nothing where it may."""
    import resource

    if os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] >= PRIORITY:
        return ""
    line = f"{getpass.getuser()} - rtprio {PRIORITY}"
    return f'; once before: echo "{line}" | sudo tee /etc/security/limits.d/autotune.conf, then log in again'
