"""Jitter of a loop that acts when it reads: rows come early or late, and their commands with them.

A row that is late by d reads d dy/dt more, and its step of the command acts d later: an impulse of -d du on the plant,
which is felt long after. What is left is therefore slow, and goes with steps of the command; it looks like a lag, a
changing gain or a load, and no differential equation reproduces it, since every d is another one. Its likelihood is a
Kalman filter's: process noise where the command steps, measurement noise where the reading moves, one size of d for
both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import expm

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.evidence.adequacy import line_in
from autotune.diagnosis.evidence.samples import JITTER, SampleEffect
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.simulation import kernel
from autotune.models import Parameter

#: Correlations of the measurement noise from row to row that are tried; standard deviations of d in sample times.
CORRELATIONS, SIZES = (0.0, 0.3, 0.6, 0.85), np.geomspace(0.003, 0.6, 7)
#: Steps of that grid: of the correlation, and of the logarithm of the size; how it is made finer.
GRID, NEARER = (0.15, 0.9), (0.6, 0.35, 0.2, 0.1, 0.05)
#: Sizes of a load that is noise, as impulses of the command's mean step over a share of the sample time.
LOADS = np.geomspace(1e-4, 3.0, 12)
#: Rows apart at which innovations must not go together.
APART = 20


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rows:
    """A recording for the filter: chain over a row, what an impulse leaves at the row's end, and its signals."""

    F: FloatArray
    b: FloatArray
    C: FloatArray
    step: FloatArray
    slope: FloatArray
    e: FloatArray
    together: float
    counts: BoolArray
    begins: BoolArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Told:
    """What the filter says of a hypothesis: twice its log likelihood, innovations of variance 1, and the noise's sd.

    The latter in the reading's unit.
    """

    score: float
    innovations: tuple[FloatArray, ...]
    sd: float


def late_rows(retuned: Fit, data: Data) -> SampleEffect | None:
    """Return the jitter of rows whose commands are as late as their readings, where nothing else is left.

    Parameters
    ----------
    retuned : Fit
        The nominal structure with its numbers fitted.
    data : Data
        What it was fitted to.

    Returns
    -------
    SampleEffect or None
        Named ``timing.jitter``, where the size of d explains more than a load that is noise would, and innovations are
        white with it, without a line, and without one in the lateness that they tell.

    Notes
    -----
    First order in d. Where the dead time is shorter than a row the command's step and the reading are late together.
    The noise's variance is profiled, start states are free.

    References
    ----------
    Schweppe, IEEE Trans. Inf. Theory 11, 1965: likelihood from a filter's innovations.
    """
    sim, limits = retuned.sim, data.thresholds
    variance = data.noise.total_sd**2
    if not sim.is_linear or variance <= 0.0 or sim.linear_hold:
        return None
    recordings = [_rows(retuned, data, i) for i in range(len(data.recordings))]
    spread = data.state_sizes(sim)
    dt = data.sample_times[0]

    def told(correlation: float, jitter: float, load: float = 0.0) -> _Told:
        return _told(recordings, (correlation, (jitter * dt) ** 2 / variance, load), spread**2 / variance)

    usual = float(np.mean(np.concatenate([r.step for r in recordings]) ** 2))
    loads = (LOADS * dt) ** 2 * usual / variance
    plain, a = max((told(c, 0.0).score, c) for c in CORRELATIONS)
    late, c, size = max((told(c, size).score, c, size) for c in CORRELATIONS if c <= a for size in SIZES)
    for factor in NEARER:  # from the grid to the maximum
        near = [
            (c + i * factor * GRID[0], size * math.exp(k * factor * GRID[1])) for i in (-1, 0, 1) for k in (-1, 0, 1)
        ]
        late, c, size = max((told(c, size).score, c, size) for c, size in near if 0.0 <= c < 1.0)
    if late - plain < limits.beyond_chance:
        return None
    noisy = max(told(one, 0.0, load).score for one in {c, a} for load in loads)
    best = told(c, size)
    if late - noisy < limits.beyond_chance or not _white(best.innovations, recordings, limits.line):
        return None
    return SampleEffect(
        name=JITTER,
        equation="rows are read, and their commands act, at t + d, d random from row to row",
        parameters={"sd": Parameter(value=float(size * dt * best.sd / math.sqrt(variance)), unit="s")},
        evidence=late - plain,
    )


def _rows(retuned: Fit, data: Data, i: int) -> _Rows:
    chain, r, dt = retuned.sim.chain, data.driving[i], data.sample_times[i]
    later = int(chain.delay_s / dt + 1e-9)
    step = np.diff(r.u, prepend=r.u[0])
    step = np.concatenate([np.zeros(later), step[: step.size - later]]) if later else step
    slope = np.gradient(retuned.signals[i][:, 0], data.recordings[i].t)
    e = retuned.residuals[i]
    inside, begins = np.zeros(e.size, dtype=bool), np.zeros(e.size, dtype=bool)
    for a, b in zip(data.starts[i], data.stops[i], strict=True):
        inside[a:b] = True
    begins[data.starts[i]] = True
    if data.kept:
        step = step[data.kept[i]]
    return _Rows(
        F=expm(chain.A * dt),
        b=expm(chain.A * (dt - (chain.delay_s - later * dt))) @ chain.B[:, 0],
        C=chain.taps[kernel.OUTPUT].copy(),
        step=step,
        slope=np.nan_to_num(slope),
        e=np.nan_to_num(e),
        together=float(later == 0),
        counts=inside & data.good[i] & np.isfinite(e) & np.isfinite(slope),
        begins=begins,
    )


def _told(recordings: Sequence[_Rows], numbers: tuple[float, float, float], spread: FloatArray) -> _Told:
    """Return what the filter says: numbers are the noise's correlation, and variances of d and of a load."""
    logarithms, squares, count = 0.0, 0.0, 0
    out = []
    for one in recordings:
        e, part = _filtered(
            (one.F, one.b, one.C),
            (one.step, one.slope, one.e),
            (one.counts, one.begins),
            (*numbers, one.together),
            spread,
        )
        logarithms += part
        squares += float(e @ e)
        count += int(one.counts.sum())
        out.append(e)
    sd = math.sqrt(squares / max(count, 1))
    score = -(count * math.log(max(squares / max(count, 1), 1e-300)) + logarithms)
    return _Told(score=score, innovations=tuple(e / max(sd, 1e-300) for e in out), sd=sd)


@njit(cache=True, nogil=True)
def _filtered(
    chain: tuple[FloatArray, FloatArray, FloatArray],
    signals: tuple[FloatArray, FloatArray, FloatArray],
    where: tuple[BoolArray, BoolArray],
    numbers: tuple[float, float, float, float],
    spread: FloatArray,
) -> tuple[FloatArray, float]:
    """Return innovations over their standard deviation, and the sum of log variances.

    The last of the numbers is 1 where a row's d is that of its command in the same row, else 0: process and
    measurement noise of a row are then correlated.
    """
    F, b, C = chain
    step, slope, e = signals
    counts, begins = where
    correlation, late, load, together = numbers
    n = F.shape[0]
    m = n + 1
    x, moved, gain, PH = np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m)
    P, GP = np.zeros((m, m)), np.zeros((m, m))
    G, H = np.zeros((m, m)), np.zeros(m)
    G[:n, :n], G[n, n], H[:n], H[n] = F, correlation, C, 1.0
    out, total = np.zeros(e.size), 0.0
    for k in range(e.size):
        if begins[k]:
            x[:] = 0.0
            P[:, :] = 0.0
            for i in range(n):
                P[i, i] = spread[i]
            P[n, n] = 1.0
        S, innovation = late * slope[k] * slope[k], e[k]
        for i in range(m):
            PH[i] = 0.0
            for j in range(m):
                PH[i] += P[i, j] * H[j]
            S += H[i] * PH[i]
            innovation -= H[i] * x[i]
        # predictor with correlated noises: x+ = G x + gain e, P+ = G P G' + Q - gain S gain'
        for i in range(m):
            moved[i] = 0.0
            gain[i] = -together * late * slope[k] * step[k] * b[i] if i < n else 0.0
            for j in range(m):
                moved[i] += G[i, j] * x[j]
                gain[i] += G[i, j] * PH[j]
                GP[i, j] = 0.0
                for q in range(m):
                    GP[i, j] += G[i, q] * P[q, j]
        share = 1.0 / S if counts[k] else 0.0
        if counts[k]:
            total += math.log(S)
            out[k] = innovation / math.sqrt(S)
        driven = late * step[k] * step[k] + load
        for i in range(m):
            x[i] = moved[i] + gain[i] * innovation * share
            for j in range(m):
                P[i, j] = (driven * b[i] * b[j] if i < n and j < n else 0.0) - gain[i] * gain[j] * share
                for q in range(m):
                    P[i, j] += GP[i, q] * G[j, q]
        P[n, n] += 1.0 - correlation * correlation
    return out, total


def _white(innovations: Sequence[FloatArray], recordings: Sequence[_Rows], line: float) -> bool:
    """Whether innovations do not go together over some rows, and neither they nor the lateness they tell has a line."""
    chance = 4.0 / math.sqrt(sum(int(np.count_nonzero(e)) for e in innovations))
    power = sum(float(e @ e) for e in innovations)
    for lag in range(1, APART + 1):
        if abs(sum(float(e[lag:] @ e[:-lag]) for e in innovations)) > chance * power:
            return False
    told = [e * one.slope for e, one in zip(innovations, recordings, strict=True)]
    told += [e * np.append(0.0, one.step[:-1]) for e, one in zip(innovations, recordings, strict=True)]
    return line_in([*innovations, *told]) < line
