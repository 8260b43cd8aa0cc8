"""Bring the estimators into memory before a rig is touched: their first call takes longer than many samples."""

from __future__ import annotations

import contextlib
import functools
import sys

import numpy as np

from autotune.errors import IdentificationError
from autotune.experiment.priority import spare_collections
from autotune.identification.frequency.limit_cycle import WholePeriods
from autotune.identification.frequency.limit_cycle_points import limit_cycle_points
from autotune.identification.sweep_estimate import estimate_sweep
from autotune.recording import Recording

#: longest time for which another thread of this process, a progress bar's, may hold up the loop's [s]
SWITCH_S = 2e-4


@functools.cache
def warm_up() -> None:
    """Estimate the points of made-up limit cycles, each by itself and together, and forget them.

    The first call in a process imports, and loads or compiles what is compiled: a third of a second, or several after
    an installation. In the middle of a loop at 100 Hz that would be a link too slow, and so would a full garbage
    collection of all that is imported.
    """
    t = 0.01 * np.arange(900, dtype=np.float64)
    u = np.where(np.sin(np.pi * t) >= 0.0, 1.0, -1.0)
    y = np.cumsum(u) * 0.01 + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    with contextlib.suppress(IdentificationError):
        points = limit_cycle_points(t, u, y, highest_harmonic=3).points
        window = WholePeriods(start_s=2.0, end_s=8.0, periods=3)
        limit_cycle_points(t, u, y, window=window, known=points)
        cycles = [(points[0], WholePeriods(start_s=k, end_s=k + 2.0, periods=1)) for k in (2.0, 4.0, 6.0)]
        rows = Recording(t=t, u=u, y=y)
        estimate_sweep(rows, cycles, start_s=1.0, end_s=8.0, omega_rad_s=[points[0].omega_rad_s], phases_rad=[-2.0])
    spare_collections()
    sys.setswitchinterval(SWITCH_S)
