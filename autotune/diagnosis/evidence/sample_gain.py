"""Whether a simulation is nearer to the readings with what their samples show: only then is it named."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.effects import kind_of
from autotune.diagnosis.evidence.samples import ON_STEP, REGULAR, TINY, SampleEffect, converter_step
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.thresholds import Thresholds

_ENDS = (("low", -np.inf), ("high", np.inf))


def is_material(effect: SampleEffect, result: Fit, data: Data) -> bool:
    """Whether what single samples show matters beside what a free run leaves of a rig.

    A converter's step does where its rounding is a tenth of the residual's variance, a spoiled reading where it is far
    farther from the simulation than others: a plant at rest repeats its reading as well, and a slow converter does.
    """
    good = [g & np.isfinite(e) for g, e in zip(data.good, result.residuals, strict=True)]
    squares = [np.square(r.y - s[:, 0]) for r, s in zip(data.recordings, result.signals, strict=True)]
    usual = float(np.mean(np.concatenate([q[g] for q, g in zip(squares, good, strict=True)])))
    if kind_of(effect.name).steps:
        return effect.parameters["step"].value ** 2 / 12.0 > data.thresholds.material * usual
    if not effect.rows or not any(rows.any() for rows in effect.rows):
        return True
    spoiled = np.concatenate([q[rows] for q, rows in zip(squares, effect.rows, strict=True)])
    spoiled = spoiled[np.isfinite(spoiled)]
    return bool(spoiled.size) and float(np.mean(spoiled)) > data.thresholds.spoiled * usual


def improves(effect: SampleEffect, result: Fit, data: Data) -> bool:
    """Whether a simulation is nearer to readings that were not fitted with what their samples show.

    Parameters
    ----------
    effect : SampleEffect
        What the samples show.
    result : Fit
        The simulation, in which it does not act.
    data : Data
        What that was fitted to: rows that the effect spoils do not count there.

    Notes
    -----
    A reading that is repeated is the one before it, exactly. A clipped one is its limit. A spike stands out of
    the residual too: the simulation does not explain it. A converter's step is found in one half
    of the readings and predicts the values of the other.
    """
    limits, kind = data.thresholds, kind_of(effect.name)
    simulated = [s[:, 0] for s in result.signals]
    if kind.steps:
        return _step_predicts(data)
    if not effect.rows or not any(rows.any() for rows in effect.rows):
        return True
    left = [r.y[rows] - s[rows] for r, s, rows in zip(data.recordings, simulated, effect.rows, strict=True)]
    off = np.concatenate(left)
    off = off[np.isfinite(off)]
    if kind.is_simulated:  # limits: the simulation goes beyond them, or noise does
        low, high = (effect.parameters[key].value if key in effect.parameters else bound for key, bound in _ENDS)
        ends = [np.clip(s[rows], low, high) for s, rows in zip(simulated, effect.rows, strict=True)]
        clipped = np.concatenate([r.y[rows] - e for r, e, rows in zip(data.recordings, ends, effect.rows, strict=True)])
        return float(np.nansum(clipped**2)) <= float(np.sum(off**2))
    if kind.uneven:
        return _stand_out(effect, [r.y - s for r, s in zip(data.recordings, simulated, strict=True)], limits)
    return float(np.sum(off**2)) > 0.0


def _stand_out(effect: SampleEffect, residuals: Sequence[FloatArray], limits: Thresholds) -> bool:
    """Whether spikes stand out of the residual too, beside their neighbours: what the simulation explains does not."""
    alone = [e[1:-1] - 0.5 * (e[:-2] + e[2:]) for e in residuals]
    usual = np.concatenate([d[~rows[1:-1]] for d, rows in zip(alone, effect.rows, strict=True)])
    spikes_of = np.concatenate([d[rows[1:-1]] for d, rows in zip(alone, effect.rows, strict=True)])
    spread = 1.4826 * float(np.nanmedian(np.abs(usual)))
    return bool(np.nanmedian(np.abs(spikes_of)) > limits.least_outlier * spread)


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
