"""Errors on windows that were not fitted: the nominal, the retuned and the extended model."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit, states_of
from autotune.diagnosis.fitting.long_windows import spread_of
from autotune.diagnosis.fitting.noise import noise_from_differences


@dataclass(frozen=True, kw_only=True)
class FitQuality:
    """Errors on rows that were not fitted, divided by the spread of y."""

    nominal: float
    retuned: float
    extended: float
    noise_floor: float

    @property
    def is_better(self) -> bool:
        """Whether the extended model is at least as good as the retuned one where neither was fitted."""
        return self.extended <= self.retuned

    @property
    def comes_down_to_noise(self) -> bool:
        """Whether nothing larger than the noise is left where the extended model was not fitted."""
        return self.extended <= self.noise_floor


def held_out(retuned: Fit, data: Data) -> FitQuality:
    """Return errors on windows that were not fitted, of a nominal structure to which nothing was added."""
    nominal, tuned = (held_out_error(retuned, data, tune=tune) for tune in (False, True))
    return FitQuality(nominal=nominal, retuned=tuned, extended=tuned, noise_floor=noise_floor(retuned, data))


def held_out_error(retuned: Fit, data: Data, *, tune: bool) -> float:
    """Return the error on windows with numbers fitted to the others, as a share of the spread of y.

    Every second window is left out, then the others: each half is tried with the numbers of the other one.

    Parameters
    ----------
    retuned : Fit
        The nominal structure, to which nothing was added.
    data : Data
        What it was fitted to.
    tune : bool
        Whether numbers are fitted to the other half; else the nominal ones are tried.
    """
    halves = _half(data, 0), _half(data, 1)
    with ThreadPoolExecutor(2) as pool:
        fits = list(pool.map(lambda pair: _tested(retuned, tune, *pair), (halves, halves[::-1])))
    squares = sum(float(e @ e) for f in fits for e in f.residuals)
    freedom = sum(f.rows - f.free_states for f in fits)
    return math.sqrt(squares / max(freedom, 1)) / spread_of(data)


def noise_floor(retuned: Fit, data: Data) -> float:
    """Return the noise that a residual shows from row to row, as a share of the spread of y."""
    return noise_from_differences(retuned.residuals, data.good).total_sd / spread_of(data)


def _tested(result: Fit, tune: bool, known: Data, unknown: Data) -> Fit:
    """Return a fit's start states on windows that its numbers, tuned to others or nominal, were not fitted to."""
    p, none = result.parametrisation, np.zeros(result.theta.size, dtype=bool)
    theta = result.theta if tune else p.centre
    try:
        if tune:
            theta = fit(p, known, theta, states_of(result, known), iterations=6, rounds=1).theta
        return fit(p, unknown, theta, states_of(result, unknown), free=none, iterations=8)
    except RUNAWAY:
        # numbers from half the windows can run away on the other half: then those of all windows count
        return result


def _half(data: Data, which: int) -> Data:
    """Return every second window of the data, or block of windows where there are few."""
    chosen = []
    for a in data.starts:
        # few windows may go by direction one and one: then blocks of them are taken
        block = 1 if len(a) >= 8 else max(1, len(a) // 2)
        keep = (np.arange(len(a)) // block) % 2 == which % 2
        chosen.append(keep if keep.any() else np.ones(len(a), dtype=bool))
    return data.only(chosen)
