"""One free run through rows whose readings fitted no number: nominal, retuned and extended model side by side.

The stretch is left out of one recording, all numbers are fitted to the rest, and each model runs through it with the
recorded command alone. Which effects were chosen did see all rows; how large they are did not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.evidence.stretches import LARGE_HEAD, LEAST_HEAD
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit, states_of
from autotune.diagnosis.fitting.long_windows import lengths_of

#: Share of a stretch that tells its start state, where it is one run: nothing else does.
HEAD = 0.12
#: Share of the longest recording that is left out, and rows of it at most: a picture shows no more.
SHARE, MOST_ROWS = 4, 20_000
#: Share of the spread in the liveliest stretch below which the last one is passed over: little would be told there.
LIVELY = 0.5
#: Rows of a run at least; what of it tells its start state is as long as where stretches are judged.
LEAST_RUN = 24
#: Gauss-Newton steps of the numbers, and of the start states.
STEPS, STATE_STEPS = 6, 10
#: Rows that the numbers are fitted to, beyond which windows are left out evenly.
FITTED_ROWS = 40_000


@dataclass(frozen=True, kw_only=True, eq=False)
class UnseenRun:
    """A stretch of a recording with the free runs of models through it.

    Attributes
    ----------
    number : int
        The recording's position in the data.
    name, unit : str
        Where the recording came from, and the unit of its reading.
    t, y : (N,) array
        Stamps [s] and readings; NaN where a reading does not count.
    starts_s, heads_s : tuple of float
        When each free run begins, and until when its readings told its start state [s]: one run, but for plants that
        integrate or ring for long.
    runs : mapping of str to (N,) array
        Simulated readings by the model's name.
    errors : mapping of str to float
        Root mean square error after the heads as a share of the spread of y there.
    """

    number: int
    name: str
    unit: str
    t: FloatArray
    y: FloatArray
    starts_s: tuple[float, ...]
    heads_s: tuple[float, ...]
    runs: dict[str, FloatArray]
    errors: dict[str, float]


def unseen_run(nominal: Fit, retuned: Fit, chosen: Fit, data: Data) -> UnseenRun | None:
    """Run models freely through a stretch that their numbers were not fitted to.

    Parameters
    ----------
    nominal, retuned, chosen : Fit
        The given numbers (with the operating point where that was fitted), all numbers, and effects added; the last two
        the same object where nothing was added.
    data : Data
        What they were fitted to.

    Returns
    -------
    UnseenRun or None
        None where the longest recording is too short to leave a part of it out.

    Notes
    -----
    A quarter of the longest recording: its last one, unless y moves there by less than half of what it does in the
    liveliest. A model that runs away has an infinite error and no curve. Of many rows the fit takes windows evenly.
    """
    number = int(np.argmax([ok.sum() for ok in data.good]))
    first, last = _stretch(data, number)
    if last - first < LEAST_RUN:
        return None
    known = _without(data, number, first, last).thinned(FITTED_ROWS)
    heads = _heads(data, number, first, last, retuned)
    if known.rows < (last - first) or any(len(a) == 0 for a in known.starts):
        return None
    fits = {"nominal": nominal, "retuned": retuned} | ({} if chosen is retuned else {"extended": chosen})
    runs = {name: _free_run(one, known, heads, name == "nominal")[first:last] for name, one in fits.items()}
    r = data.recordings[number]
    y = np.where(data.good[number], r.y, math.nan)[first:last]
    judged = np.isfinite(y) & ~heads.good[0][first:last]
    if not judged.any():
        return None
    spread = float(np.std(y[judged])) or 1.0
    return UnseenRun(
        number=number,
        name=r.name,
        unit=retuned.parametrisation.model.output.unit,
        t=r.t[first:last],
        y=y,
        starts_s=tuple(float(s) for s in r.t[heads.starts[0]]),
        heads_s=tuple(float(s) for s in r.t[_head_ends(heads)]),
        runs={name: run for name, run in runs.items() if np.all(np.isfinite(run))},
        errors={name: _rms((y - run)[judged]) / spread for name, run in runs.items()},
    )


def _rms(e: FloatArray) -> float:
    return float(np.sqrt(np.mean(e**2))) if np.all(np.isfinite(e)) else math.inf


def _stretch(data: Data, number: int) -> tuple[int, int]:
    """Return the first row of the stretch and the row after its last."""
    y, ok = data.recordings[number].y, data.good[number]
    rows = np.flatnonzero(ok)
    if rows.size < SHARE * LEAST_RUN:
        return 0, 0
    begin, end = int(rows[0]), int(rows[-1]) + 1
    length = min((end - begin) // SHARE, MOST_ROWS)
    parts = [(end - (k + 1) * length, end - k * length) for k in range((end - begin) // length)]
    parts = [(a, b) for a, b in parts if ok[a:b].mean() > 0.5] or parts[:1]
    spreads = [float(np.std(y[a:b][ok[a:b]])) for a, b in parts]
    return parts[0] if spreads[0] >= LIVELY * max(spreads) else parts[int(np.argmax(spreads))]


def _without(data: Data, number: int, first: int, last: int) -> Data:
    """Return the data with a recording's windows cut where the stretch lies, and its rows not counted."""
    good, starts, stops = list(data.good), list(data.starts), list(data.stops)
    pairs = list(zip(starts[number], stops[number], strict=True))
    cut = [(a, min(b, first)) for a, b in pairs] + [(max(a, last), b) for a, b in pairs]
    kept = sorted({(int(a), int(b)) for a, b in cut if b - a >= LEAST_HEAD and good[number][a:b].any()})
    inside = np.zeros(good[number].size, dtype=bool)
    for a, b in kept:
        inside[a:b] = True
    good[number] = good[number] & inside
    starts[number] = np.array([a for a, _ in kept], dtype=np.int64)
    stops[number] = np.array([b for _, b in kept], dtype=np.int64)
    return replace(data, good=tuple(good), starts=tuple(starts), stops=tuple(stops))


def _heads(data: Data, number: int, first: int, last: int, retuned: Fit) -> Data:
    """Return the stretch alone, in free runs as long as the plant lets them, with the rows that tell start states."""
    r, ok = data.recordings[number], data.good[number]
    long = lengths_of(retuned.model, (r,), data.thresholds).long
    count = max(1, min(round((r.t[last - 1] - r.t[first]) / long), (last - first) // LEAST_RUN))
    edges = np.linspace(first, last, count + 1).round().astype(np.int64)
    told = np.zeros(ok.size, dtype=bool)
    for a, b in pairwise(edges):
        told[a : a + max(LEAST_HEAD, int((HEAD if count == 1 else LARGE_HEAD) * (b - a)))] = True
    return replace(
        data,
        recordings=(r,),
        good=(ok & told,),
        starts=(edges[:-1],),
        stops=(edges[1:],),
        numbers=(data.numbers[number] if data.numbers else number,),
    )


def _head_ends(heads: Data) -> IntArray:
    """Return the row after the last that told each run's start state."""
    told: BoolArray = heads.good[0]
    pairs = zip(heads.starts[0], heads.stops[0], strict=True)
    ends = [a + 1 + int(np.flatnonzero(told[a:b])[-1]) if told[a:b].any() else a for a, b in pairs]
    return np.minimum(np.array(ends, dtype=np.int64), heads.recordings[0].t.size - 1)


def _free_run(one: Fit, known: Data, heads: Data, given: bool) -> FloatArray:
    """Return a model's readings, numbers fitted to the known rows; NaN where it runs away.

    Of given numbers the operating point alone is fitted, where it was before.
    """
    p, theta = one.parametrisation, one.theta
    moved = one.theta != p.centre
    free = np.array([f.kind == "u_offset" for f in p.free]) & moved if given else None
    none = np.zeros(theta.size, dtype=bool)
    try:
        if free is None or free.any():
            theta = fit(p, known, theta, _states(one, known), STEPS, rounds=1, free=free).theta
        begun = fit(p, heads, theta, free=none, iterations=STATE_STEPS)
        # short heads alone: what they do not feel stays at rest
        return begun.signals[0][:, 0]
    except RUNAWAY:
        return np.full(heads.recordings[0].t.size, math.nan)


def _states(one: Fit, known: Data) -> tuple[FloatArray, ...] | None:
    """Return a fit's start states where the windows begin at rows that it had windows at."""
    if all(np.all(np.isin(a, b)) for a, b in zip(known.first_rows, one.starts, strict=True)):
        return tuple(states_of(one, known))
    return None
