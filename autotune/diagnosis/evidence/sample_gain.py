"""Whether a simulation is nearer to the readings with what their samples show: only then is it named.

A reading that is spoiled is not seen by any fit, so what a simulation makes of it was not fitted. Every run of spoiled
rows is a witness of its own; how consistently they speak is the evidence, as for effects of the chain it is how
consistently stretches do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
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
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import kind_of
from autotune.recording import Recording

_ENDS = (("low", -1.0), ("high", 1.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedRows:
    """Recordings with a simulation through them, whatever the model is.

    Attributes
    ----------
    recordings : tuple of Recording
        What was measured.
    good : tuple of (N,) bool array
        Rows that count.
    starts, stops : tuple of (W,) int array
        Where the simulation's runs begin and end.
    simulated : tuple of (N,) array
        Readings.
    limits : Thresholds
        What decides between two findings.
    """

    recordings: tuple[Recording, ...]
    good: tuple[BoolArray, ...]
    starts: tuple[IntArray, ...]
    stops: tuple[IntArray, ...]
    simulated: tuple[FloatArray, ...]
    limits: Thresholds

    @property
    def residuals(self) -> list[FloatArray]:
        """Reading less simulation at every row."""
        return [r.y - y for r, y in zip(self.recordings, self.simulated, strict=True)]


def rows_of(result: Fit, data: Data) -> SimulatedRows:
    """Return the rows that a fit of a chain simulates."""
    return SimulatedRows(
        recordings=data.recordings, good=data.good, starts=data.starts, stops=data.stops,
        simulated=tuple(signals[:, 0] for signals in result.signals), limits=data.thresholds,
    )  # fmt: skip


def select_supported(effects: Sequence[SampleEffect], run: SimulatedRows) -> list[SampleEffect]:
    """Return the effects of single samples that runs of a simulation speak for, with how much they do.

    Parameters
    ----------
    effects : sequence of SampleEffect
        What the samples show.
    run : SimulatedRows
        A simulation in which they do not act; rows that an effect spoils do not count there.

    Notes
    -----
    Behind a limit the simulation goes on, beyond it. When lost readings are back, they have gone all the way that the
    simulation went meanwhile, in one row. A spike stands far out of what the simulation leaves elsewhere. A converter's
    step is found in one half of the readings and predicts the values of the other.
    """
    found = []
    for one in effects:
        speaks = _speaks(one, run)
        if speaks > 0.0:
            found.append(replace(one, speaks=speaks))
    return found


def _speaks(effect: SampleEffect, run: SimulatedRows) -> float:
    if kind_of(effect.name).steps:
        return math.inf if _step_predicts(run.recordings) else -math.inf
    if not effect.rows or not any(rows.any() for rows in effect.rows):
        return math.inf
    match effect.name:
        case "sensor.saturation":
            return _beyond(effect, run)
        case "sensor.dropout":
            return _caught_up(effect, run)
        case _:
            return _stand_out(effect, run)


def _unspoiled(run: SimulatedRows, rows: Sequence[BoolArray]) -> float:
    """Return the root mean square error of the rows that count and are not spoiled."""
    left = run.residuals
    return rms(left, [g & ~m & np.isfinite(e) for g, m, e in zip(run.good, rows, left, strict=True)])


def _beyond(effect: SampleEffect, run: SimulatedRows) -> float:
    """Return twice the log odds that the simulation is beyond the limits whenever readings stand at them.

    Readings that are merely large are so because of their noise and of the model's error, or because the plant came to
    rest there: then the simulation is within, or as near as its mean error over as many rows is elsewhere, or as half
    of the distance to the next reading that occurs.
    """
    beyond, lengths = [], []
    values = np.unique(np.concatenate([r.y[np.isfinite(r.y)] for r in run.recordings]))
    half_step = 0.5 * usual_change(values)
    for r, y, rows, told in zip(run.recordings, run.simulated, effect.rows, _told(run), strict=True):
        for a, b in runs_of(rows):
            for key, sign in _ENDS:
                level = effect.parameters.get(key)
                past = y[a:b][told[a:b] & np.isfinite(y[a:b])]
                if level is not None and r.y[a] == level.value and past.size:
                    beyond.append(sign * float(np.mean(past - level.value)) - half_step)
                    lengths.append(b - a)
    if not beyond:
        return -math.inf
    usual = _usual_mean(run, effect.rows, max(1, int(np.median(lengths))))
    return _consistent(np.array(beyond) - usual, usual)


def _told(run: SimulatedRows) -> list[BoolArray]:
    """Return the rows before which enough readings of their window count to tell its start state."""
    told = []
    for good, starts, stops in zip(run.good, run.starts, run.stops, strict=True):
        mark = np.zeros(good.size, dtype=bool)
        for a, b in zip(starts, stops, strict=True):
            mark[a:b] = np.cumsum(good[a:b]) >= LEAST_HEAD
        told.append(mark)
    return told


def _usual_mean(run: SimulatedRows, rows: Sequence[BoolArray], length: int) -> float:
    """Return the root mean square of the mean error of so many rows that count and are not spoiled."""
    means = []
    for residual, m, good in zip(run.residuals, rows, run.good, strict=True):
        left = residual[good & ~m]
        left = left[np.isfinite(left)]
        means.append(left[: left.size // length * length].reshape(-1, length).mean(axis=1))
    every = np.concatenate(means)
    return float(np.sqrt(np.mean(every**2))) if every.size else _unspoiled(run, rows)


def _consistent(distances: FloatArray, usual: float) -> float:
    """Return K ln(1 + z^2) for K distances whose mean is z usual ones, with its sign; ``STRETCHES`` count at most."""
    distances = distances[np.isfinite(distances)]
    if not distances.size:
        return -math.inf
    z = float(np.mean(distances)) / max(usual, 1e-300)
    return math.copysign(min(distances.size, STRETCHES) * math.log1p(z * z), z)


def _caught_up(effect: SampleEffect, run: SimulatedRows) -> float:
    """Return twice the log odds that readings that come back have gone on meanwhile, as the plant did.

    Without a loss they go on by what the simulation does in one row: K losses that leave a share q of those squared
    errors when the simulation's whole way is counted give -K ln q. Losses at rest tell nothing, and how far a reading
    jumps tells nothing where the simulation has not gone as far: two spikes after rest jump as well.
    """
    squares = []
    for r, y, rows, good in zip(run.recordings, run.simulated, effect.rows, run.good, strict=True):
        usual = CAUGHT_UP * usual_change(r.y)
        for a, b in runs_of(rows):
            if a == 0 or b >= len(r) - 1 or not good[b]:
                continue
            # a spike after rest jumps as well, but not for two rows
            jump = min(r.y[b] - r.y[b - 1], r.y[b + 1] - r.y[b - 1], key=abs)
            whole = y[b] - y[a - 1]
            if abs(jump) > usual or abs(whole) > usual:
                squares.append(((jump - (y[b] - y[b - 1])) ** 2, (jump - whole) ** 2))
    pairs = np.array(squares, dtype=np.float64).reshape(-1, 2)
    without, beside = np.maximum(pairs[np.all(np.isfinite(pairs), axis=1)].sum(axis=0), np.finfo(np.float64).tiny)
    return min(len(pairs), STRETCHES) * math.log(without / beside)


def _stand_out(effect: SampleEffect, run: SimulatedRows) -> float:
    """Return twice the log odds that spikes stand out of the residual: what the simulation explains does not.

    Their distance from the mean of their neighbours counts beyond the least that is asked of it, over the usual one
    where nothing is spoiled; they must stand out of all that the simulation leaves as well.
    """
    usual = _unspoiled(run, effect.rows)
    alone = [e[1:-1] - 0.5 * (e[:-2] + e[2:]) for e in run.residuals]
    inner = [rows[1:-1] for rows in effect.rows]
    others = np.concatenate([d[~rows] for d, rows in zip(alone, inner, strict=True)])
    heights = np.abs(np.concatenate([d[rows] for d, rows in zip(alone, inner, strict=True)]))
    spread = max(1.4826 * float(np.nanmedian(np.abs(others))), usual)
    return _consistent(heights - run.limits.least_outlier * spread, spread)


def is_material(effect: SampleEffect, run: SimulatedRows) -> bool:
    """Whether a converter's rounding is a tenth of the variance that a free run leaves of a rig."""
    if not kind_of(effect.name).steps:
        return True
    step = effect.parameters["step"].value
    return step**2 / 12.0 > run.limits.material * rms(run.residuals, run.good) ** 2


def _step_predicts(recordings: Sequence[Recording]) -> bool:
    """Whether the values of every half of the readings are apart by multiples of the step found in the other."""
    y = np.concatenate([r.y[np.isfinite(r.y)] for r in recordings])
    halves = y[: y.size // 2], y[y.size // 2 :]
    for known, unknown in (halves, halves[::-1]):
        step, gaps = converter_step(known), np.diff(np.unique(unknown))
        if step == 0.0 or not gaps.size:
            return False
        multiples = gaps[gaps > TINY * np.max(gaps)] / step
        if not float(np.mean(np.abs(multiples - np.round(multiples)) < ON_STEP)) > REGULAR:
            return False
    return True


def is_nearer(
    effect: SampleEffect, simulated: Sequence[FloatArray], residuals: Sequence[FloatArray], share: float
) -> bool:  # fmt: skip
    """Whether a simulation with an effect leaves less than a share of the squared error; beside noise none does."""
    kind = kind_of(effect.name)
    if not kind.steps:
        return kind.is_simulated
    step, y, left = effect.parameters["step"].value, np.concatenate(simulated), np.concatenate(residuals)
    rounded = y + left - step * np.round(y / step)
    return float(np.nansum(rounded**2)) < share * float(np.nansum(left**2))
