"""Whether a loop oscillates, whether its phase lasts, and how the loop answers steps of its set-point.

Where set-point and load rest, a linear controller ties u to y exactly: at the frequency of an oscillation y/u is -1/C,
whoever began it, and a plant fitted from u to y always looks as if it stood at the limit of stability there. Two things
still tell. An oscillation that noise rings out of a badly damped loop forgets its phase after 1/(2 pi zeta) periods;
one that comes from a source outside keeps it. And where the set-point moves, the loop shows its damping by itself.

References
----------
Thornhill, Huang and Zhang, Detection of multiple oscillations in control loops, J. Process Control 13, 2003.
Ljung, System Identification, 2nd ed. 1999, section 13.4: what feedback leaves unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from autotune.arrays import FloatArray
from autotune.diagnosis.routine.operation import Operation, without_trend

_CROSSINGS = 10
#: Damping ratios that are tried, and periods of a loop's answer: the shortest [rows], and how many up to half a record.
DAMPINGS = (0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7)
_SHORTEST, _PERIODS = 4.0, 75


def regularity(x: FloatArray) -> float:
    """Return the regularity of a signal: over 1 it oscillates (Thornhill et al. 2003, eq. 2).

    A third of the mean over the standard deviation of the intervals between the first zero crossings of the
    autocovariance; 0 where fewer than five crossings lie in the first half of the lags.
    """
    n = x.size
    covariance = np.fft.irfft(np.abs(np.fft.rfft(without_trend(x), 2 * n)) ** 2)[: n // 2]
    crossings = np.flatnonzero(np.diff(np.signbit(covariance)))[: _CROSSINGS + 1]
    if crossings.size < 5:
        return 0.0
    before, after = covariance[crossings], covariance[crossings + 1]
    intervals = np.diff(crossings + before / (before - after))
    return float(np.mean(intervals) / max(3.0 * float(np.std(intervals, ddof=1)), 1e-9 * float(np.mean(intervals))))


def line_share(at: Operation) -> float:
    """Return the share of y's variance within an eighth of the dominant frequency, without a slow trend; 0 to 1."""
    if not math.isfinite(at.period_rows):
        return 0.0
    within, total = 0.0, 0.0
    for number in range(at.starts.size):
        y = _filled(at.y[at.rows_of(number)])
        power = np.abs(np.fft.rfft(np.hanning(y.size) * without_trend(y))) ** 2
        frequency = np.arange(power.size) * at.period_rows / y.size
        near = np.abs(frequency - 1.0) < np.maximum(0.125, 2.0 * at.period_rows / y.size)
        within += float(power[near].sum())
        total += float(power.sum())
    return within / max(total, 1e-300)


def _filled(y: FloatArray) -> FloatArray:
    return np.where(np.isfinite(y), y, np.nanmean(y))


def phase_kept(at: Operation) -> tuple[float, float]:
    """Return how much of y one sine predicts on stretches left out, as a share of its variance, and its periods.

    The longest recording is looked at; in each window a constant and a slope are free. Below 0 the sine predicts
    nothing. The second value is how many periods the sine ran through.
    """
    if not math.isfinite(at.period_rows):
        return 0.0, 0.0
    part = max((at.rows_of(i) for i in range(at.starts.size)), key=lambda rows: rows.stop - rows.start)
    inside = [(w, s) for w, s in zip(at.windows, at.stretch_of, strict=True) if part.start <= w[0] < part.stop]
    y = _filled(at.y)
    rows = np.concatenate([np.arange(first, end) for (first, end), _ in inside])
    stretch = np.concatenate([np.full(end - first, s) for (first, end), s in inside])
    n = part.stop - part.start
    # a quarter of a turn over the record is the finest step that matters
    shares = 1.0 + np.arange(-24, 25) * 0.25 * at.period_rows / n
    tables = []
    for share in shares[shares > 0.5]:
        angle = 2.0 * np.pi * rows / (at.period_rows / share)
        tables.append(np.column_stack([np.cos(angle), np.sin(angle)]))
    free = [_detrended(column, inside) for column in (y[rows], *(c for table in tables for c in table.T))]
    target, columns = free[0], [np.column_stack(free[1 + 2 * i : 3 + 2 * i]) for i in range(len(tables))]
    wrong = 0.0
    for number in np.unique(stretch):
        kept = stretch != number
        fits = [np.linalg.lstsq(table[kept], target[kept], rcond=None)[0] for table in columns]
        errors = [float(np.sum((target[kept] - t[kept] @ f) ** 2)) for t, f in zip(columns, fits, strict=True)]
        best = int(np.argmin(errors))
        wrong += float(np.sum((target[~kept] - columns[best][~kept] @ fits[best]) ** 2))
    return 1.0 - wrong / max(float(target @ target), 1e-300), n / at.period_rows


def _detrended(x: FloatArray, inside: list[tuple[FloatArray, int]]) -> FloatArray:
    """Return rows of windows, each without its mean and slope."""
    left, first = np.empty_like(x), 0
    for (begin, end), _ in inside:
        size = int(end - begin)
        t = np.linspace(-1.0, 1.0, size)
        part = x[first : first + size] - x[first : first + size].mean()
        left[first : first + size] = part - t * (t @ part) / (t @ t)
        first += size
    return left


@dataclass(frozen=True, kw_only=True)
class SetpointAnswer:
    """How y follows the set-point.

    Attributes
    ----------
    damping : float
        Damping ratio of the least damped oscillation in it.
    period_s : float
        Its period [s].
    explained : float
        Share of y's variance on stretches left out that is predicted from the set-point alone.
    ratios : (M,) array
        Logarithm of the squared error of well damped answers over that of all, stretch by stretch, fitted to the
        others.
    dampings : (M,) array
        The damping ratio, fitted without each stretch.
    """

    damping: float
    period_s: float
    explained: float
    ratios: FloatArray
    dampings: FloatArray


def setpoint_answer(at: Operation, badly_damped: float) -> SetpointAnswer | None:
    """Return how y answers the set-point, None where it does not move.

    ``y = c + k r_lag + a decaying oscillation of free phase after every change of r``; period and damping ratio are
    searched on a grid, the rest is linear. Dead time is part of the free phase.

    Parameters
    ----------
    at : Operation
        The recordings.
    badly_damped : float
        Damping ratio up to which a loop counts as badly damped.
    """
    if at.r is None or float(np.ptp(at.r)) <= 1e-9 * max(float(np.max(np.abs(at.r))), 1e-300):
        return None
    longest = 0.5 * max(at.rows_of(i).stop - at.rows_of(i).start for i in range(at.starts.size))
    shapes = [(zeta, float(p)) for zeta in DAMPINGS for p in np.geomspace(_SHORTEST, longest, _PERIODS)]
    moments = np.stack([_moments(at, zeta, period) for zeta, period in shapes])  # (G, M, 5, 5)
    damped = np.array([zeta > 2.0 * badly_damped for zeta, _ in shapes])
    stretches = moments.shape[1]
    ratios, chosen, wrong, total = np.empty(stretches), np.empty(stretches), 0.0, 0.0
    for number in range(stretches):
        fits, errors = _fits(moments.sum(1) - moments[:, number])
        best, calm = int(np.argmin(errors)), int(np.argmin(np.where(damped, errors, np.inf)))
        left = [_error(moments[i, number], fits[i]) for i in (best, calm)]
        ratios[number] = math.log(max(left[1], 1e-300) / max(left[0], 1e-300))
        chosen[number] = shapes[best][0]
        wrong, total = wrong + left[0], total + moments[best, number, -1, -1]
    best = int(np.argmin(_fits(moments.sum(1))[1]))
    return SetpointAnswer(
        damping=shapes[best][0], period_s=shapes[best][1] * at.dt_s, explained=1.0 - wrong / max(total, 1e-300),
        ratios=ratios, dampings=chosen,
    )  # fmt: skip


def _fits(moments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return for every shape the coefficients that fit y best, (G, 4), and the squared error left, (G,)."""
    own, y, total = moments[:, :-1, :-1], moments[:, :-1, -1], moments[:, -1, -1]
    fits = np.linalg.solve(own + 1e-9 * np.eye(own.shape[1]) * total[:, None, None], y[..., None])[..., 0]
    return np.asarray(fits, dtype=np.float64), np.asarray(total - np.einsum("gi,gi->g", fits, y))


def _error(moments: FloatArray, fit: FloatArray) -> float:
    size = fit.size
    return float(moments[size, size] - 2.0 * fit @ moments[:size, size] + fit @ moments[:size, :size] @ fit)


def _moments(at: Operation, zeta: float, period: float) -> FloatArray:
    """Return products of the answers and y over every stretch, each window without its mean, (M, 5, 5) array."""
    assert at.r is not None
    pole = np.exp((-zeta + 1j * math.sqrt(1.0 - zeta**2)) * 2.0 * np.pi / period)
    columns = np.empty((5, at.u.size))
    for number in range(at.starts.size):
        part = at.rows_of(number)
        r = at.r[part] - at.r[part][0]
        turning = lfilter([1.0], [1.0, -pole], np.diff(r, prepend=r[0]))
        # the answer without an oscillation of its own settles within half a period
        columns[:4, part] = r, lfilter([1.0 - abs(pole) ** 2], [1.0, -(abs(pole) ** 2)], r), turning.real, turning.imag
        columns[4, part] = _filled(at.y[part])
    moments = np.zeros((at.stretches, 5, 5))
    for (first, end), number in zip(at.windows, at.stretch_of, strict=True):
        free = columns[:, first:end] - columns[:, first:end].mean(1, keepdims=True)
        moments[number] += free @ free.T
    return moments
