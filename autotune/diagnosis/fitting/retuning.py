"""The nominal structure retuned, the noise that it leaves, and how far a residual is from noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit
from autotune.diagnosis.fitting.noise import Noise, autoregressive_up_to, noise_from_differences
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.fitting.restarts import renew_start_states
from autotune.diagnosis.fitting.windows import known_from_s, model_lag_s, window_rows
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.models import Model
from autotune.recording import Recording

#: Blocks of a window whose means show slow power.
BLOCKS = 24


def at_nominal(base: Fit, data: Data) -> Fit:
    """Fit the start states alone at a retuned model's nominal numbers.

    Numbers that run away have no error that could be told: the retuned model stands for them.
    """
    held = np.zeros(base.theta.size, dtype=bool)
    try:
        return fit(base.parametrisation, data, x0=base.x0, free=held)
    except RUNAWAY:
        return base


def prepare(
    model: Model,
    recordings: Sequence[Recording],
    good: Sequence[BoolArray],
    thresholds: Thresholds = IN_USE,
) -> tuple[Data, Fit]:
    """Retune the nominal structure, and estimate the noise from what it leaves.

    Parameters
    ----------
    model : Model
        Nominal model without effects.
    recordings : sequence of Recording
        What was measured.
    good : sequence of (N,) bool array
        Rows whose reading counts.
    thresholds : Thresholds
        What decides between two findings.

    Returns
    -------
    data, retuned
        Data with windows and noise, and the fit. Of long recordings windows are left out evenly.
    """
    length = thresholds.lags_per_window * model_lag_s(model)
    noise = floor_noise(noise_from_differences([r.y for r in recordings], good), recordings)
    windows = [window_rows(r, length, known_from_s(model, r, thresholds), thresholds) for r in recordings]
    data = Data(
        recordings=tuple(recordings),
        good=tuple(g & (np.arange(g.size) >= starts[0]) for g, (starts, _) in zip(good, windows, strict=True)),
        starts=tuple(starts for starts, _ in windows),
        stops=tuple(stops for _, stops in windows),
        noise=noise,
        thresholds=thresholds,
    ).thinned(thresholds.searched_rows)
    size = float(np.std(np.concatenate([r.u for r in recordings]))) or 1.0
    p = parametrise(model, [], size, recordings[0].sample_time_s, thresholds.prior_spread)
    result = fit(p, data)
    for _ in range(2):
        coarse = reduced_chi2(result, data) > thresholds.coarse
        noise = noise_from_differences(result.residuals, data.good)
        if coarse:
            noise = Noise(sd=float(np.sqrt(np.mean(np.concatenate(result.residuals) ** 2))))
        data = replace(data, noise=floor_noise(noise, recordings))
        result = fit(p, data, result.theta, result.x0, iterations=20)
    return data, _straightened(result, data) if far_from_prior(result, thresholds.far_from_prior) else result


def _straightened(result: Fit, data: Data) -> Fit:
    """Free a chain far from its prior of start states that stayed behind while its numbers were wrong."""
    try:
        return renew_start_states(result, data)
    except RUNAWAY:
        return result


def under_noise(result: Fit, data: Data) -> Data:
    """Return data with the noise that the row-to-row jitter of a fit's residual shows."""
    return replace(data, noise=floor_noise(noise_from_differences(result.residuals, data.good), data.recordings))


def is_unfelt(result: Fit, change: FloatArray, data: Data) -> bool:
    """Whether a fit could do without what changes its residual: by less than one row's noise beyond start states.

    A lag of nanoseconds frees the first reading of every window, and does nothing else.

    Parameters
    ----------
    result, data
        A fit, and what it was fitted to.
    change : (N,) array
        Of the whitened residual, at the same numbers.
    """
    left, least = result.without_states(change), under_noise(result, data).noise.total_sd / data.noise.sd
    return float(left @ left) < least**2


def far_from_prior(result: Fit, sds: float) -> bool:
    """Whether retuning moved a gain or lag by more than some of its prior's standard deviations."""
    away = np.abs(result.theta - result.parametrisation.centre) / result.parametrisation.spreads
    return bool(np.max(away, initial=0.0) > sds)


def floor_noise(noise: Noise, recordings: Sequence[Recording]) -> Noise:
    """Return the noise, at least a millionth of the signal's spread: recordings without noise must not divide by 0."""
    spread = max(float(np.nanstd(r.y)) for r in recordings)
    least = 1e-6 * spread or 1e-300
    return noise if noise.sd >= least else Noise(sd=least)


def reduced_chi2(result: Fit, data: Data) -> float:
    """Return the residual's variance in units of the noise that its own row-to-row jitter shows."""
    e = np.concatenate(under_noise(result, data).whitened(list(result.residuals)))
    freedom = max(data.rows - result.free_states - result.theta.size, 1)
    return float(e @ e / freedom)


def whiteness(result: Fit, data: Data) -> float:
    """Return the residual's slow power in units of what noise has, after an AR(2) has taken its share."""
    noise = floor_noise(autoregressive_up_to(result.residuals, data.good, 2)[-1], data.recordings)
    slow = expected = 0.0
    whitened = replace(data, noise=noise).whitened(list(result.residuals))
    for e, starts, stops in zip(whitened, data.starts, data.stops, strict=True):
        for part in (e[a:b] for a, b in zip(starts, stops, strict=True)):
            width = max(4, part.size // BLOCKS)
            count = part.size // width
            means = part[: count * width].reshape(count, width).mean(axis=1) * np.sqrt(width)
            slow += float(means @ means)
            expected += count
    return float(slow / max(expected, 1.0))
