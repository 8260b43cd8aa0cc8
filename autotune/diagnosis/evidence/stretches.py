"""What predicts: errors on stretches of recordings that were left out, and how they speak for one model or another.

Where the model's own error and not noise is what remains, rows are no independent witnesses and a likelihood of white
noise is far too sure of itself. Stretches are: the recordings are cut into a few, the numbers are fitted to all but
one, and the free run through that one is judged. Two models are compared stretch by stretch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.descent import Iterate, Problem, eliminate, step_of, try_point
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.long_windows import spread_of

#: Stretches that are left out, one after the other.
STRETCHES = 8
#: Rows of every window that tell its start state and are never judged; of many short windows a share of each.
LEAST_HEAD, LARGE_HEAD = 8, 0.35
#: Steps of the numbers that each left-out stretch is worth, with the derivatives of the fit to all.
STEPS = 3
#: Spreads of y that an error counts as at most: where a simulation runs away, how far does not matter.
FAR_OFF = 10.0


def cuttings_of(data: Data) -> list[list[IntArray]]:
    """Return the number of the stretch that every row belongs to, per recording; -1 for what is never judged.

    Several times, as :func:`cuttings_in` does.
    """
    readings = [np.where(good, r.y, np.nan) for r, good in zip(data.recordings, data.good, strict=True)]
    return cuttings_in(readings, data.starts, data.stops)


def cuttings_in(
    readings: Sequence[FloatArray], firsts: Sequence[IntArray], ends: Sequence[IntArray]
) -> list[list[IntArray]]:
    """Return the same from the readings of each recording and its windows: first rows, and rows before which they end.

    Where windows are many a stretch is some of them. Else the rows are cut twice: into stretches of as many rows each,
    and into those that tell as much each, see :func:`weights_of_rows`.
    """
    judged = _beyond_heads([y.size for y in readings], firsts, ends)
    if sum(len(a) for a in firsts) < STRETCHES:
        return [_cut(judged, [np.ones(y.size) for y in readings]), _cut(judged, [weights_of_rows(y) for y in readings])]
    labels = []
    of_each = _shares([float(len(a)) for a in firsts])
    for rows, starts, stops, (first, count) in zip(judged, firsts, ends, of_each, strict=True):
        label = np.full(rows.size, -1, dtype=np.int64)
        for number, (a, b) in enumerate(zip(starts, stops, strict=True)):
            label[a:b] = np.where(rows[a:b], first + number * count // len(starts), -1)
        labels.append(label)
    return [labels]


def _beyond_heads(rows: Sequence[int], firsts: Sequence[IntArray], ends: Sequence[IntArray]) -> list[BoolArray]:
    """Return which rows are judged, per recording: those of each window behind its head."""
    share, judged = LARGE_HEAD if sum(len(a) for a in firsts) >= STRETCHES else 0.0, []
    for count, starts, stops in zip(rows, firsts, ends, strict=True):
        mask = np.zeros(count, dtype=bool)
        for a, b in zip(starts, stops, strict=True):
            mask[a + max(LEAST_HEAD, int(share * (b - a))) : b] = True
        judged.append(mask)
    return judged


def _cut(judged: Sequence[BoolArray], weights: Sequence[FloatArray]) -> list[IntArray]:
    """Return the stretch of every row that is judged, those of one recording with as much weight each; -1 of others."""
    of_each = _shares([float(w[rows].sum()) for rows, w in zip(judged, weights, strict=True)])
    labels = []
    for rows, w, (first, count) in zip(judged, weights, of_each, strict=True):
        label = np.full(rows.size, -1, dtype=np.int64)
        told = np.cumsum(w[rows])
        if told.size:
            label[rows] = first + np.minimum((told - 0.5 * w[rows]) / told[-1] * count, count - 1).astype(np.int64)
        labels.append(label)
    return labels


def _shares(weights: Sequence[float]) -> list[tuple[int, int]]:
    """Return the first stretch of each recording and how many it is cut into.

    No stretch is of two recordings, so that none hangs on the order in which they are given; only where recordings are
    more than stretches several share one.
    """
    if len(weights) > STRETCHES:
        return [(number * STRETCHES // len(weights), 1) for number in range(len(weights))]
    told = np.array(weights)
    counts = (told > 0.0).astype(np.int64)  # what has no row that is judged has no stretch
    while 0 < counts.sum() < STRETCHES:
        counts[np.argmax(told / np.maximum(counts, 1))] += 1
    return [(int(end - count), int(count)) for end, count in zip(np.cumsum(counts), counts, strict=True)]


def weights_of_rows(y: FloatArray) -> FloatArray:
    """Return how much each row of a recording tells, in rows: half as a row, half by how fast y moves there.

    Parameters
    ----------
    y : (N,) array
        Readings; NaN where there is none.

    Returns
    -------
    (N,) array
        Its mean is 1.

    Notes
    -----
    What a row tells of a delay L is the square of dy/dL, the speed of y; of a gain or a load each row tells about as
    much. The response to a step in a long record is a few rows of many: stretches of as many rows each would have one
    witness of it beside seven of what rests. The speed is that over a hundredth of the record, whose noise is small.
    """
    good = np.isfinite(y)
    rows = np.arange(y.size)
    if not good.any():
        return np.ones(y.size)
    filled = np.interp(rows, rows[good], y[good])
    apart = max(1, y.size // 100)
    ahead, behind = np.minimum(rows + apart, y.size - 1), np.maximum(rows - apart, 0)
    squares = ((filled[ahead] - filled[behind]) / (ahead - behind)) ** 2
    mean = float(squares.mean())
    return 0.5 + 0.5 * squares / mean if mean > 0.0 else np.ones(y.size)


def held_out_squares(result: Fit, data: Data) -> FloatArray:
    """Return the sum of squared errors on every stretch, with numbers fitted to the others.

    Parameters
    ----------
    result : Fit
        A fit to all rows of the data, whose noise is white.
    data : Data
        What it was fitted to.

    Returns
    -------
    (C, STRETCHES) array
        For each of the C ways in which rows are cut, in the reading's unit squared; as of errors of ten spreads of y
        where a simulation runs away.

    Notes
    -----
    Numbers and start states move by a few Gauss-Newton steps with the derivatives of the fit to all rows. What a
    window's first rows say of its start state is always known. With thresholds that is first order: a stretch on which
    a threshold alone was felt is judged a little too well. Under dry friction up to four steps in ten help nowhere, and
    what they were for is judged as it was fitted (docs/decisions/0055).
    """
    squares, good = [], np.concatenate(data.good)
    for out, there, _ in _left_out(result, data):
        most = float(np.sum(good & out)) * (FAR_OFF * spread_of(data)) ** 2
        squares.append(most if there is None else min(float(there.e[out] @ there.e[out]) * data.noise.sd**2, most))
    return np.reshape(squares, (-1, STRETCHES))


def error_beside_still(result: Fit, data: Data) -> float | None:
    """Return the error on left-out stretches as a share of what it is with commands that stand still there.

    Parameters
    ----------
    result, data
        As in :func:`held_out_squares`.

    Returns
    -------
    float or None
        Of the stretches in which a command moves, from a state that the rows before them tell; None where none does.
    """
    own = still = 0.0
    ends = np.cumsum([len(r) for r in data.recordings])[:-1]
    for out, there, problem in _left_out(result, data):
        pairs = enumerate(zip(data.driving, np.split(out, ends), strict=True))
        driving = [r.standing_still(data.in_driving(i, rows)) for i, (r, rows) in pairs]
        if there is None or all(one is r for one, r in zip(driving, data.driving, strict=True)):
            continue
        beside = try_point(Problem(problem.parametrisation, data.driven_by(driving)), there.theta, there.x0)
        own += float(there.e[out] @ there.e[out])
        still += math.inf if beside is None else float(beside.e[out] @ beside.e[out])
    return math.sqrt(own / still) if still > 0.0 else None


def _left_out(result: Fit, data: Data) -> Iterator[tuple[BoolArray, Iterate | None, Problem]]:
    """Yield each stretch's rows, and where a fit to the others goes; None where it runs away."""
    problem = Problem(result.parametrisation, data)
    problem.scales = data.state_sizes(result.sim)
    start = problem.iterate(result.theta, [x.copy() for x in result.x0])
    J, Jx = result.jacobian[0], problem.jacobian(start, np.zeros(result.theta.size, dtype=bool))[1]
    for labels in cuttings_of(data):
        number = np.concatenate(labels)
        for k in range(STRETCHES):
            yield number == k, _without(problem, start, (J, Jx), number == k), problem


def _without(
    problem: Problem, at: Iterate, derivatives: tuple[FloatArray, FloatArray], out: BoolArray
) -> Iterate | None:
    """Return where a fit goes when rows are left out."""
    kept = ~out
    J, Jx = (D * kept[:, None] for D in derivatives)
    may = np.any(J != 0.0, axis=0)

    def cost(there: Iterate) -> float:
        return problem.cost(there.e * kept, there.theta, prior)

    prior = problem.prior(at.e, may)
    for _ in range(STEPS):
        e_left, J_left, gain_e, gain_J = eliminate(problem, (J, Jx), at.e * kept)
        if not (np.all(np.isfinite(J_left)) and np.all(np.isfinite(e_left))):
            return None
        step = step_of(problem, at, J, (e_left, J_left), prior, may)
        moved = None
        for share in (1.0, 0.3):
            moves = problem.per_recording(problem.scales * (gain_e + gain_J @ (share * step)))
            trial = try_point(problem, at.theta + share * step, [x - m for x, m in zip(at.x0, moves, strict=True)])
            if trial is not None and cost(trial) < cost(at):
                moved = trial
                break
        if moved is None:
            break
        at = moved
    return at


def correlation_rows(result: Fit, data: Data) -> float:
    """Return how many rows of a residual count as one: its correlation length, at least 1.

    Notes
    -----
    1 + 2 sum of the autocorrelations up to their first sign change, all windows together.
    """
    summed = total = 0.0
    for e, starts, stops in zip(result.residuals, data.starts, data.stops, strict=True):
        for part in (e[a:b] for a, b in zip(starts, stops, strict=True)):
            spectrum = np.fft.rfft(part, 2 * part.size)
            c = np.fft.irfft(np.abs(spectrum) ** 2)[: part.size]
            if c[0] <= 0.0:
                continue
            negative = np.flatnonzero(c < 0.0)
            end = int(negative[0]) if negative.size else part.size
            summed += float(c[0] + 2.0 * c[1:end].sum())
            total += float(c[0])
    return max(1.0, summed / total) if total > 0.0 else 1.0


def rms(residuals: Sequence[FloatArray], good: Sequence[BoolArray]) -> float:
    """Return the root mean square of residuals over the rows that count."""
    squares = sum(float(np.sum(e[g] ** 2)) for e, g in zip(residuals, good, strict=True))
    return math.sqrt(squares / max(sum(int(g.sum()) for g in good), 1))


def judged_rows(data: Data) -> int:
    """Return how many rows are judged: as many whichever way they are cut."""
    judged = _beyond_heads([len(r) for r in data.recordings], data.starts, data.stops)
    return max(1, sum(int((mask & good).sum()) for mask, good in zip(judged, data.good, strict=True)))
