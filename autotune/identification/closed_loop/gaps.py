"""Short gaps of a record: samples that were lost here and there are bridged, so that all of it is used together.

The command is known over a gap, it was held; only the measurement is missing. A few missing values among many are put
in between their neighbours, which is an error of the size of the noise in those rows and in no other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from autotune.recording import Recording

IntArray: TypeAlias = NDArray[np.intp]

#: longest gap that is bridged, in samples, and the largest share of rows that may be put in
LONGEST, SHARE = 3, 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Bridged:
    """A record with its short gaps bridged.

    Attributes
    ----------
    recording : Recording
        Equidistant over the gaps that were bridged.
    gaps, rows : int
        How many were, and how many measurements were put in.
    """

    recording: Recording
    gaps: int
    rows: int


def bridged(recording: Recording, jitter: float) -> Bridged:
    """Return the record with up to three missing samples in a row put in, where they are few.

    Parameters
    ----------
    recording : Recording
        With gaps of its stamps.
    jitter : float
        How far a stamp may stray from the grid, as a share of the sample time; a row that strays further came late and
        counts as missing, its command acts from its time on.

    Returns
    -------
    Bridged
        The record as it was where there are no such gaps, or so many that what is put in would speak for the plant.

    Notes
    -----
    ``u`` is the mean of the command over each sample time, exactly; ``y`` is interpolated linearly, further columns are
    held. The error of an interpolated value is about the noise and the movement of y within the gap: with 5 % of such
    rows the estimate's noise grows by as much, and what is said of its accuracy stays within that.
    """
    kept, slots = _on_grid(recording, jitter)
    lengths = np.diff(slots)
    short = (lengths > 1) & (lengths <= LONGEST + 1)
    put_in = int(np.sum(lengths[short] - 1))
    if put_in == 0 or put_in > SHARE * len(recording):
        return Bridged(recording=recording, gaps=0, rows=0)
    whole = _filled(recording, kept, np.where(short, lengths, 1))
    return Bridged(recording=whole, gaps=int(short.sum()), rows=put_in)


def _on_grid(recording: Recording, jitter: float) -> tuple[IntArray, IntArray]:
    """Return the rows that stand on the grid of their predecessor, and their numbers on it."""
    T_s = recording.sample_time_s
    t = recording.t
    steps = np.diff(t) / T_s
    if np.all(np.abs(steps - 1.0) <= jitter):
        return np.arange(t.size), np.arange(t.size)
    kept, slots = [0], [0]
    for row in range(1, t.size):
        step = (t[row] - t[kept[-1]]) / T_s
        whole = round(step)
        is_near = whole <= LONGEST + 1
        if is_near and (abs(step - whole) > jitter or whole == 0):
            continue  # it came late, or twice: missing on the grid
        kept.append(row)
        slots.append(slots[-1] + (whole if is_near else LONGEST + 2))  # a long gap stays one
    return np.array(kept), np.array(slots)


def _filled(recording: Recording, kept: IntArray, lengths: IntArray) -> Recording:
    t, T_s = recording.t, recording.sample_time_s
    first = np.concatenate(([0], np.cumsum(lengths)))
    rows = np.arange(int(first[-1]) + 1)
    put_in = np.ones(rows.size, dtype=bool)
    put_in[first] = False
    at = np.interp(rows, first, t[kept])
    source = kept[np.searchsorted(first, rows, side="right") - 1]
    y, u = recording.y[source].copy(), recording.u[source].copy()
    usable = ~put_in & np.isfinite(y)
    y[put_in] = np.interp(at[put_in], at[usable], y[usable])
    # the mean of what was held, where a row was put in and where one that came late was left out
    area = np.concatenate(([0.0], np.cumsum(recording.u[:-1] * np.diff(t))))
    late = np.setdiff1d(np.arange(t.size), kept)
    changed = put_in.copy()
    changed[np.searchsorted(at, t[late], side="right") - 1] = True
    changed[-1] = False
    start, end = at[changed], np.minimum(at[changed] + T_s, t[-1])
    u[changed] = (np.interp(end, t, area) - np.interp(start, t, area)) / (end - start)
    extra = {name: values[source] for name, values in recording.extra.items()}
    return replace(recording, t=at, u=u, y=y, extra=MappingProxyType(extra))
