"""Whether a simulation is nearer to the readings with what their samples show: only then is it named.

A reading that is spoiled is not seen by any fit, so what a simulation makes of it was not fitted. Every run of spoiled
rows is a witness of its own; how consistently they speak is the evidence, as for effects of the chain it is how
consistently stretches do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.evidence.readings import (
    CAUGHT_UP,
    ON_STEP,
    REGULAR,
    TINY,
    converter_step,
    runs_of,
    usual_change,
)
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.evidence.stretches import LEAST_HEAD, STRETCHES, rms
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.effects import kind_of

_ENDS = (("low", -1.0), ("high", 1.0))


def supported(effects: Sequence[SampleEffect], result: Fit, data: Data) -> list[SampleEffect]:
    """Return the effects of single samples that runs of a simulation speak for, with how much they do.

    Parameters
    ----------
    effects : sequence of SampleEffect
        What the samples show.
    result : Fit
        The simulation, in which they do not act.
    data : Data
        What that was fitted to: rows that an effect spoils do not count there.

    Notes
    -----
    Behind a limit the simulation goes on, beyond it. When lost readings are back, they have gone all the way that the
    simulation went meanwhile, in one row. A spike stands far out of what the simulation leaves elsewhere. A converter's
    step is found in one half of the readings and predicts the values of the other.
    """
    found = []
    for one in effects:
        speaks = _speaks(one, result, data)
        if speaks > 0.0:
            found.append(replace(one, speaks=speaks))
    return found


def _speaks(effect: SampleEffect, result: Fit, data: Data) -> float:
    if kind_of(effect.name).steps:
        return math.inf if _step_predicts(data) else -math.inf
    if not effect.rows or not any(rows.any() for rows in effect.rows):
        return math.inf
    match effect.name:
        case "sensor.saturation":
            return _beyond(effect, result, data)
        case "sensor.dropout":
            return _caught_up(effect, result, data)
        case _:
            return _stand_out(effect, result, data)


def _unspoiled(result: Fit, data: Data, rows: Sequence[BoolArray]) -> float:
    """Return the root mean square error of the rows that count and are not spoiled."""
    pairs = zip(data.recordings, result.signals, strict=True)
    left = [r.y - s[:, 0] for r, s in pairs]
    return rms(left, [g & ~m & np.isfinite(e) for g, m, e in zip(data.good, rows, left, strict=True)])


def _beyond(effect: SampleEffect, result: Fit, data: Data) -> float:
    """Return twice the log odds that the simulation is beyond the limits whenever readings stand at them.

    Readings that are merely large are so because of their noise and of the model's error, or because the plant came to
    rest there: then the simulation is within, or as near as its mean error over as many rows is elsewhere, or as half
    of the distance to the next reading that occurs.
    """
    beyond, lengths = [], []
    values = np.unique(np.concatenate([r.y[np.isfinite(r.y)] for r in data.recordings]))
    half_step = 0.5 * usual_change(values)
    for r, s, rows, told in zip(data.recordings, result.signals, effect.rows, _told(data), strict=True):
        for a, b in runs_of(rows):
            for key, sign in _ENDS:
                level = effect.parameters.get(key)
                past = s[a:b, 0][told[a:b] & np.isfinite(s[a:b, 0])]
                if level is not None and r.y[a] == level.value and past.size:
                    beyond.append(sign * float(np.mean(past - level.value)) - half_step)
                    lengths.append(b - a)
    if not beyond:
        return -math.inf
    usual = _usual_mean(result, data, effect.rows, max(1, int(np.median(lengths))))
    return _consistent(np.array(beyond) - usual, usual)


def _told(data: Data) -> list[BoolArray]:
    """Return the rows before which enough readings of their window count to tell its start state."""
    told = []
    for good, starts, stops in zip(data.good, data.starts, data.stops, strict=True):
        mark = np.zeros(good.size, dtype=bool)
        for a, b in zip(starts, stops, strict=True):
            mark[a:b] = np.cumsum(good[a:b]) >= LEAST_HEAD
        told.append(mark)
    return told


def _usual_mean(result: Fit, data: Data, rows: Sequence[BoolArray], length: int) -> float:
    """Return the root mean square of the mean error of so many rows that count and are not spoiled."""
    means = []
    for r, s, m, good in zip(data.recordings, result.signals, rows, data.good, strict=True):
        left = (r.y - s[:, 0])[good & ~m]
        left = left[np.isfinite(left)]
        means.append(left[: left.size // length * length].reshape(-1, length).mean(axis=1))
    every = np.concatenate(means)
    return float(np.sqrt(np.mean(every**2))) if every.size else _unspoiled(result, data, rows)


def _consistent(distances: FloatArray, usual: float) -> float:
    """Return K ln(1 + z^2) for K distances whose mean is z usual ones, with its sign; ``STRETCHES`` count at most."""
    distances = distances[np.isfinite(distances)]
    if not distances.size:
        return -math.inf
    z = float(np.mean(distances)) / max(usual, 1e-300)
    return math.copysign(min(distances.size, STRETCHES) * math.log1p(z * z), z)


def _caught_up(effect: SampleEffect, result: Fit, data: Data) -> float:
    """Return twice the log odds that readings that come back have gone on meanwhile, as the plant did.

    Without a loss they go on by what the simulation does in one row, and by no more than readings usually do: K losses
    that leave a share q of those squared errors when the simulation's whole way is counted give -K ln q. Losses at rest
    tell nothing.
    """
    jumps, squares = [], []
    for r, s, rows, good in zip(data.recordings, result.signals, effect.rows, data.good, strict=True):
        usual = CAUGHT_UP * usual_change(r.y)
        for a, b in runs_of(rows):
            if a == 0 or b >= len(r) - 1 or not good[b]:
                continue
            # a spike after rest jumps as well, but not for two rows
            jump = min(r.y[b] - r.y[b - 1], r.y[b + 1] - r.y[b - 1], key=abs)
            whole = s[b, 0] - s[a - 1, 0]
            if abs(jump) > usual or abs(whole) > usual:
                jumps.append(abs(jump) / usual - 1.0)
                squares.append(((jump - (s[b, 0] - s[b - 1, 0])) ** 2, (jump - whole) ** 2))
    pairs = np.array(squares, dtype=np.float64).reshape(-1, 2)
    without, beside = pairs[np.all(np.isfinite(pairs), axis=1)].sum(axis=0)
    simulated = min(len(pairs), STRETCHES) * math.log(without / beside) if without > 0.0 and beside > 0.0 else 0.0
    return simulated + _consistent(np.array(jumps), 1.0)


def _stand_out(effect: SampleEffect, result: Fit, data: Data) -> float:
    """Return twice the log odds that spikes stand out of the residual: what the simulation explains does not.

    Their distance from the mean of their neighbours counts beyond the least that is asked of it, over the usual one
    where nothing is spoiled; they must stand out of all that the simulation leaves as well.
    """
    limits, usual = data.thresholds, _unspoiled(result, data, effect.rows)
    residuals = [r.y - s[:, 0] for r, s in zip(data.recordings, result.signals, strict=True)]
    alone = [e[1:-1] - 0.5 * (e[:-2] + e[2:]) for e in residuals]
    inner = [rows[1:-1] for rows in effect.rows]
    others = np.concatenate([d[~rows] for d, rows in zip(alone, inner, strict=True)])
    heights = np.abs(np.concatenate([d[rows] for d, rows in zip(alone, inner, strict=True)]))
    spread = max(1.4826 * float(np.nanmedian(np.abs(others))), usual)
    return _consistent(heights - limits.least_outlier * spread, spread)


def is_material(effect: SampleEffect, result: Fit, data: Data) -> bool:
    """Whether a converter's rounding is a tenth of the variance that a free run leaves of a rig."""
    if not kind_of(effect.name).steps:
        return True
    step = effect.parameters["step"].value
    return step**2 / 12.0 > data.thresholds.material * rms(result.residuals, data.good) ** 2


def _step_predicts(data: Data) -> bool:
    """Whether the values of every half of the readings are apart by multiples of the step found in the other."""
    y = np.concatenate([r.y[np.isfinite(r.y)] for r in data.recordings])
    halves = y[: y.size // 2], y[y.size // 2 :]
    for known, unknown in (halves, halves[::-1]):
        step, gaps = converter_step(known), np.diff(np.unique(unknown))
        if step == 0.0 or not gaps.size:
            return False
        multiples = gaps[gaps > TINY * np.max(gaps)] / step
        if not float(np.mean(np.abs(multiples - np.round(multiples)) < ON_STEP)) > REGULAR:
            return False
    return True


def is_nearer(effect: SampleEffect, result: Fit, share: float) -> bool:
    """Whether a simulation with an effect leaves less than a share of the squared error; beside noise none does."""
    kind = kind_of(effect.name)
    if not kind.steps:
        return kind.is_simulated
    step = effect.parameters["step"].value
    pairs = zip([s[:, 0] for s in result.signals], result.residuals, strict=True)
    rounded = np.concatenate([s + e - step * np.round(s / step) for s, e in pairs])
    return float(np.nansum(rounded**2)) < share * float(np.nansum(np.concatenate(result.residuals) ** 2))
