"""Whether what is left is noise of its own colour: a disturbance that goes with no signal of the rig.

A plant that is stirred, heated by the sun or fed by a pump that surges is not where its command alone puts it. That
difference is slow, as missing physics is, but nothing of the command's is in it. It is taken for what it may be, an
autoregressive noise of any order that the recordings bear, the numbers are fitted under it, and the same score tests as
everywhere ask for what swings, bends or goes past the chain: under the right noise they are chi-square again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.evidence.adequacy import ResidualTests, line_in, residual_tests, strongest_line
from autotune.diagnosis.evidence.constancy import linear_gain
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit, fit
from autotune.diagnosis.fitting.noise import Noise, autoregressive_up_to
from autotune.diagnosis.thresholds import Thresholds

#: Highest order of the noise that is tried, times that noise and numbers are fitted in turn, and Gauss-Newton steps.
ORDERS, TURNS, STEPS = 20, 2, 15
#: Parts of a record whose innovations are compared; a part counts with rows enough.
PARTS, LEAST_PART = 8, 40


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnNoise:
    """A residual that is noise of its own colour.

    Attributes
    ----------
    fit : Fit
        The retuned model, fitted under that noise.
    residual : ResidualTests
        What is left under it.
    numbers : float
        Decrease of chi-square that retuning brings under it.
    memory_s : float
        Time over which it is correlated [s].
    """

    fit: Fit
    residual: ResidualTests
    numbers: float
    memory_s: float

    @property
    def sentence(self) -> str:
        """What a reader is told."""
        return (
            f"What is left is correlated over about {self.memory_s:.2g} s and goes with no signal of the rig: it is"
            " noise, or a disturbance of its own."
        )


def own_noise(retuned: Fit, data: Data) -> OwnNoise | None:
    """Return the noise of its own that a retuned model leaves; nothing where signals of the rig are in it.

    Parameters
    ----------
    retuned : Fit
        The nominal structure with its numbers fitted.
    data : Data
        What it was fitted to.

    Notes
    -----
    The order is chosen by Schwarz's criterion. A line of the spectrum, innovations whose size changes along the record,
    or a slow part that no such noise whitens speak against it. Under feedback the command answers the disturbance: with
    a strong one the position then goes with what is left, and the test says nothing.

    References
    ----------
    Ljung, System Identification, 2nd ed., sec. 16.6: residual analysis; Rao, Proc. Cambridge Phil. Soc. 44, 1948.
    """
    limits = data.thresholds
    coloured, result = data, retuned
    for _ in range(TURNS):
        noise = coloured_noise(result.residuals, coloured.good)
        if not noise.sd > 0.0:
            return None
        coloured = replace(coloured, noise=noise)
        result = fit(result.parametrisation, coloured, result.theta, result.x0, iterations=STEPS)
    left = residual_tests(result, coloured)
    innovations = coloured.whitened(list(result.residuals))
    shown = left.varies.gain > limits.beyond_chance or linear_gain(result, coloured) > limits.beyond_chance
    rings = strongest_line(result, coloured) > limits.line
    if shown or rings or not left.is_slowly_white or not _is_steady(innovations, limits):
        return None
    offset = np.array([f.kind == "u_offset" for f in result.parametrisation.free])
    start = np.where(offset, result.theta, result.parametrisation.centre)
    nominal = fit(result.parametrisation, coloured, start, result.x0, iterations=STEPS, free=offset)
    return OwnNoise(
        fit=result,
        residual=replace(left, accounted=True),
        numbers=nominal.chi2 - result.chi2 - result.penalty,
        memory_s=_memory_rows(noise) * data.sample_times[0],
    )


def coloured_noise(residuals: Sequence[FloatArray], good: Sequence[BoolArray]) -> Noise:
    """Return the autoregressive noise, of the order that Schwarz's criterion chooses, that a residual may be."""
    rows = sum(int(g.sum()) for g in good)
    found = [n for n in autoregressive_up_to(residuals, good, min(ORDERS, rows // 20)) if n.sd > 0.0]
    return min(
        found,
        key=lambda noise: rows * math.log(noise.sd**2) + len(noise.ar) * math.log(rows),
        default=Noise(sd=0.0),
    )


def _memory_rows(noise: Noise) -> float:
    """Return over how many rows noise is correlated: those of one row with its variance and spectrum at 0."""
    total = noise.total_sd
    slow = noise.sd / max(abs(1.0 - sum(noise.ar)), 1e-6)
    return max((slow / total) ** 2, 1.0) if total > 0.0 else 1.0


def _is_steady(innovations: Sequence[FloatArray], limits: Thresholds) -> bool:
    """Whether innovations are as large everywhere in the recordings, and no line stands in a part of them.

    A load that sweeps has a line at every moment, and none in the whole.
    """
    parts = [part for e in innovations for part in np.array_split(e[e != 0.0], PARTS) if part.size >= LEAST_PART]
    if line_in(parts) > limits.line + math.log(max(len(parts), 1)):
        return False
    # single rows far off are no louder part: the middle of the sizes is taken
    sizes = [float(np.median(np.abs(part))) ** 2 for part in parts]
    return not sizes or max(sizes) < limits.uneven_noise * min(sizes)
