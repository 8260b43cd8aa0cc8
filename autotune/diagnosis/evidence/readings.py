"""What readings look like by themselves: steps of a converter, runs of equal values, spikes, end stops."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.thresholds import Thresholds
from autotune.recording import Recording

#: Distance from a level, in steps, at which a reading lies on it, and the share of readings that do.
ON_STEP, REGULAR = 0.05, 0.97
#: Distance of two values, as a share of the largest, that is how numbers are written.
TINY = 1e-4
#: Expected number of runs of equal readings in all rows that chance alone may make.
CHANCE = 0.05
#: Chance of a repeated reading up to which readings are as good as continuous; largest that is reckoned with.
CONTINUOUS, REPEATED = 0.1, 0.99
#: Distinct readings next to an extreme one that it is compared with, and how much oftener an end stop is taken.
NEXT, OFTENER = 5, 3.0
#: Usual changes of a reading by which it jumps, at least, after it was held while the plant went on.
CAUGHT_UP = 3.0


def converter_step(y: FloatArray) -> float:
    """Return the step of the converter that all readings are multiples of, 0 where there is none.

    Readings behind a converter take few different values whose distances are multiples of the smallest one; readings
    that were only rounded when they were written take many.
    """
    values = np.unique(y[np.isfinite(y)])
    if values.size < 3:
        return 0.0
    gaps = np.diff(values)
    gaps = gaps[gaps > TINY * np.max(gaps)]
    step = float(np.median(gaps[gaps <= 1.5 * np.min(gaps)]))
    multiples = gaps / step
    regular = float(np.mean(np.abs(multiples - np.round(multiples)) < ON_STEP)) > REGULAR
    return step if regular and step > 0.02 * jitter_of(y) else 0.0


def jitter_of(y: FloatArray) -> float:
    """Return a robust standard deviation of what changes from row to row beyond a straight line."""
    d = np.diff(y[np.isfinite(y)], 2)
    return float(np.sqrt(np.mean(np.minimum(d**2, np.quantile(d**2, 0.99))) / 6.0)) if d.size else 0.0


def frozen_rows(y: FloatArray, least_run: int = Thresholds.least_run) -> BoolArray:
    """Return the rows that repeat the reading before them in runs of at least so many equal readings."""
    frozen = np.zeros(y.size, dtype=bool)
    for first, last in runs_of(np.append([False], np.diff(y) == 0.0)):
        if last - first >= least_run - 1:
            frozen[first:last] = True
    return frozen


def chance_run(recordings: Sequence[Recording], least_run: int = Thresholds.least_run) -> tuple[int, float]:
    """Return the length from which on a run of equal readings is no chance, and the chance of one repeated reading.

    Notes
    -----
    Chance makes runs of geometric lengths: the chance q of one more equal reading is the number of runs of two over
    that of one, which readings that are lost for three rows or more leave alone. Of N rows, N q^(L - 1) runs are of L
    rows or more.
    """
    lengths = np.concatenate([_lengths(r.y) for r in recordings])
    ones, twos = int(np.sum(lengths == 1)), int(np.sum(lengths == 2))
    q = min(twos / ones, REPEATED) if ones else REPEATED
    if q == 0.0:
        return least_run, q
    rows = sum(len(r) for r in recordings)
    return max(least_run, 1 + math.ceil(math.log(CHANCE / rows) / math.log(q))), q


def held_share(recordings: Sequence[Recording]) -> float:
    """Return the share of all values that stay for more than one row: most of a slow converter's, few of dropouts'."""
    return float(np.mean(np.concatenate([_lengths(r.y) for r in recordings]) > 1))


def _lengths(y: FloatArray) -> IntArray:
    """Return how many rows every value stays."""
    return np.diff(np.flatnonzero(np.concatenate([[True], np.diff(y) != 0.0, [True]])))


def runs_of(mark: BoolArray) -> list[tuple[int, int]]:
    """Return the first row of every run of marked ones, and the row after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mark.astype(np.int64), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def usual_change(y: FloatArray) -> float:
    """Return the median change of a reading from row to row, rows that repeat the one before left out."""
    d = np.abs(np.diff(y[np.isfinite(y)]))
    return float(np.median(d[d > 0.0])) if np.any(d > 0.0) else 0.0


def spikes(y: FloatArray, good: BoolArray, sds: float = Thresholds.spike, least_spread: float = 0.0) -> BoolArray:
    """Return the rows that stand alone out of the mean of their neighbours by so many robust standard deviations.

    Parameters
    ----------
    y : (N,) array
        Readings, or what a simulation leaves of them.
    good : (N,) bool array
        Rows that count.
    sds : float
        Robust standard deviations.
    least_spread : float
        The standard deviation at least: behind a converter most readings do not differ from their neighbours at all.
    """
    found = np.zeros(y.size, dtype=bool)
    if y.size < 8 or good.sum() < 8:
        return found
    filled = np.interp(np.arange(y.size), np.flatnonzero(good), y[good])
    d = np.zeros(y.size)
    d[1:-1] = filled[1:-1] - 0.5 * (filled[:-2] + filled[2:])
    spread = max(1.4826 * float(np.median(np.abs(d[1:-1]))), least_spread)
    if spread == 0.0:
        return found
    # the neighbours of a spike of height A show -A/2: a spike is the largest of the three
    size = np.abs(d)
    peak = (size > sds * spread) & (size >= np.roll(size, 1)) & (size >= np.roll(size, -1))
    opposed = np.minimum(-np.roll(d, 1) * np.sign(d), -np.roll(d, -1) * np.sign(d)) > 0.2 * size
    found[peak & opposed & good] = True
    return found


def outlying_rows(residual: FloatArray, good: BoolArray, sds: float = Thresholds.spike) -> BoolArray:
    """Return the rows, one or two in a row, that stand out of the median of the seven around them.

    Lone spikes are found in the readings themselves; two spikes in neighbouring rows show only in a simulation's
    residual, since a corner of readings that move would stand out as well.

    Parameters
    ----------
    residual : (N,) array
        Reading less simulation.
    good : (N,) bool array
        Rows that count.
    sds : float
        Robust standard deviations.
    """
    found = np.zeros(residual.size, dtype=bool)
    if residual.size < 8 or good.sum() < 8:
        return found
    filled = np.interp(np.arange(residual.size), np.flatnonzero(good), residual[good])
    d = np.abs(filled - median_filter(filled, size=7, mode="nearest"))
    spread = 1.4826 * float(np.median(d))
    out = good & (d > sds * spread) if spread > 0.0 else found
    for a, b in runs_of(out):
        found[a:b] = b - a <= 2
    return found


def converter_spread(recordings: Sequence[Recording]) -> float:
    """Return the least spread of readings about their neighbours: half a usual change where many are equal, else 0."""
    if chance_run(recordings)[1] <= CONTINUOUS:
        return 0.0
    return 0.5 * usual_change(np.concatenate([r.y for r in recordings]))


def lost_rows(recordings: Sequence[Recording], limits: Thresholds) -> list[BoolArray]:
    """Return the rows whose reading was lost: runs of equal ones that are no chance.

    Where readings repeat by themselves - behind a converter, or at rest - the reading must also have gone on
    meanwhile: it jumps by several of its usual changes when it is back.
    """
    least, chance = chance_run(recordings, limits.least_run)
    if chance <= CONTINUOUS:
        if held_share(recordings) >= limits.majority:
            return [np.zeros(len(r), dtype=bool) for r in recordings]
        return [frozen_rows(r.y, least) for r in recordings]
    far = CAUGHT_UP * usual_change(np.concatenate([r.y for r in recordings]))
    lost = []
    for r in recordings:
        mark = np.zeros(len(r), dtype=bool)
        for first, last in runs_of(frozen_rows(r.y, least)):
            if last < len(r) and abs(r.y[last] - r.y[last - 1]) > far:
                mark[first:last] = True
        lost.append(mark)
    return lost


def clipped_rows(recordings: Sequence[Recording], limits: Thresholds) -> tuple[list[BoolArray], dict[str, float]]:
    """Return the rows that stand at the readings' largest or smallest value, where that value is an end stop.

    Continuous readings hardly ever take their extreme value twice; a converter's end takes it again and again, or once
    for a time while no reading is repeated anywhere else. All that lies beyond an end stop is read as it: behind a
    converter that value is taken far oftener than the ones next to it.
    """
    y = np.concatenate([r.y for r in recordings])
    values, counts = np.unique(y[np.isfinite(y)], return_counts=True)
    elsewhere = any(
        bool(np.any(frozen_rows(r.y, limits.least_run) & ~np.isin(r.y, values[[0, -1]]))) for r in recordings
    )
    rows = [np.zeros(len(r), dtype=bool) for r in recordings]
    levels: dict[str, float] = {}
    for key, level, count, beside in (
        ("low", values[0], counts[0], counts[1 : 1 + NEXT]),
        ("high", values[-1], counts[-1], counts[-1 - NEXT : -1]),
    ):
        at = [r.y == level for r in recordings]
        runs = sum(len(runs_of(a)) for a in at)
        if count > OFTENER * np.max(beside, initial=0) and (runs >= 2 or not elsewhere):
            levels[key] = float(level)
            rows = [a | b for a, b in zip(rows, at, strict=True)]
    return rows, levels
