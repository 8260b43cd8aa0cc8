"""Limit cycles in windows that are known: those an experiment noted in its recording. The same on the rig and later."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.frequency.limit_cycle import WholePeriods
from autotune.identification.frequency.limit_cycle_points import LimitCycle, limit_cycle_points
from autotune.points import FrequencyPoint
from autotune.recording import Recording

#: harmonics of a first look; the estimate that is kept is made with all of them
FEW_HARMONICS = 7
ALL_HARMONICS = 9

#: t [s], u, y of a whole recording
Rows: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, kw_only=True, eq=False)
class Windowed:
    """A limit cycle: where it was recorded, and its window of whole periods.

    Attributes
    ----------
    rows : ((N,) array, (N,) array, (N,) array)
        t [s], u, y of the whole recording.
    window : WholePeriods
        Beginning anywhere in the cycle.
    sample_time_s : float
        Control period [s].
    """

    rows: Rows
    window: WholePeriods
    sample_time_s: float

    def estimate(self, known: Sequence[FrequencyPoint], highest: int = FEW_HARMONICS) -> LimitCycle:
        """Return the cycle's estimate.

        Parameters
        ----------
        known : sequence of FrequencyPoint
            Points of other cycles: they make the rough model of the plant better, and enter the estimate no further.
        highest : int
            Highest harmonic that is fitted.

        Raises
        ------
        IdentificationError
            No response above the noise, or too few samples per period.
        """
        t, u, y = self.rows
        # a row later, the safe command may follow already
        kept = (t >= self.window.start_s - 1e-9) & (t <= self.window.end_s + 0.5 * self.sample_time_s)
        return limit_cycle_points(t[kept], u[kept], y[kept], window=self.window, known=known, highest_harmonic=highest)


def estimate_cycles(cycles: Sequence[Windowed]) -> tuple[LimitCycle, ...]:
    """Return every cycle's estimate, the others' points making its rough model: a function of the recorded rows alone.

    Parameters
    ----------
    cycles : sequence of Windowed
        In the order in which they were measured.

    Raises
    ------
    IdentificationError
        One of them has no response above the noise, or too few samples per period.
    """
    first: list[LimitCycle] = []
    for cycle in cycles:
        first.append(cycle.estimate([one.points[0] for one in first]))
    found = list(first)
    for i, cycle in enumerate(cycles):
        others = [one.points[0] for k, one in enumerate(first) if k != i]
        with contextlib.suppress(IdentificationError):  # no response above the noise, beside so many harmonics
            found[i] = cycle.estimate(others, ALL_HARMONICS)
    return tuple(found)


def read_noted_windows(recording: Recording) -> tuple[Windowed, ...]:
    """Return the limit cycles that an experiment noted in the recording's sidecar; none where it noted none."""
    tables = recording.metadata.get("relay")
    if not isinstance(tables, list):
        return ()
    sample_time_s = recording.stated_sample_time_s
    rows = recording.t, recording.u, recording.y
    try:
        windows = [
            WholePeriods(start_s=float(one["start_s"]), end_s=float(one["end_s"]), periods=int(one["periods"]))
            for one in tables
        ]
    except (KeyError, TypeError, ValueError):  # somebody's own table of that name
        return ()
    last_s = float(recording.t[-1]) + sample_time_s
    return tuple(
        Windowed(rows=rows, window=window, sample_time_s=sample_time_s)
        for window in windows
        if recording.t[0] <= window.start_s + 1e-9 and window.end_s <= last_s and window.periods >= 1
    )
