"""What a fit of equations leaves beside noise, and a criterion that ranks fits before they are judged."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.fitting.noise import Noise, noise_from_differences
from autotune.diagnosis.thresholds import Thresholds
from autotune.errors import InputError
from autotune.models import Effect

#: Blocks of a recording whose means are compared.
BLOCKS = 60


def quick_score(one: Outcome, noise: Noise) -> float:
    """Return rows log(mean square) and what each number pays: Schwarz's criterion with unknown noise."""
    rho = noise.ar[0] if noise.ar else 0.0
    rows = max(one.residual.size * (1.0 - rho) / (1.0 + rho), 20.0)
    return rows * math.log(max(one.rss / one.residual.size, 1e-300)) + one.count * math.log(rows)


def noise_of(bench: Bench, one: Outcome) -> Noise:
    """Return the noise that a residual's differences show, row by row of each recording."""
    residuals = [np.nan_to_num(r) for r in one.fitted.residuals]
    good = [np.isfinite(r) for r in one.fitted.residuals]
    found = noise_from_differences(residuals, good)
    spread = max(float(np.nanstd(r.y)) for r in bench.recordings)
    return found if found.sd > 1e-6 * spread else Noise(sd=max(1e-6 * spread, 1e-300))


def innovations_variance(one: Outcome, noise: Noise) -> float:
    """Return the mean square of what is left of a residual when its row before foretells what it can."""
    rho = noise.ar[0] if noise.ar else 0.0
    squares = [(e[1:] - rho * e[:-1]) ** 2 for e in one.fitted.residuals]
    found = float(np.nanmean(np.concatenate(squares)))
    return max(found, 1e-12 * noise.sd**2, 1e-300)


def variance_ratio(one: Outcome, noise: Noise) -> float:
    """Return a residual's variance in units of the noise's."""
    return one.rss / one.residual.size / max(noise.total_sd**2, 1e-300)


def is_noise(bench: Bench, one: Outcome, most: float) -> bool:
    """Whether a residual has a noise's variance; what goes on from row to row may be physics that is left out."""
    noise = noise_of(bench, one)
    return variance_ratio(one, noise) < most and not (noise.ar and noise.ar[0] > bench.limits.slow_noise)


def is_settled(bench: Bench, one: Outcome, best: Outcome) -> bool:
    """Whether a fit need not be finished: another one of the same rows leaves noise alone, and it is far behind."""
    if one is best or variance_ratio(best, noise_of(bench, best)) >= bench.limits.white:
        return False
    return one.residual.size * float(np.log(one.rss / max(best.rss, 1e-300))) > bench.limits.certain


def is_slow(one: Outcome, noise: Noise, limits: Thresholds) -> bool:
    """Whether block means of a residual vary by more than its noise says, and chance brings."""
    slow, chance = slow_power(one, noise)
    return slow > limits.white + 2.0 * chance


def slow_power(one: Outcome, noise: Noise) -> tuple[float, float]:
    """Return the variance of block means of a residual over what its noise says, and what chance brings to it."""
    ratios, blocks = [], 0
    rho = noise.ar[0] if noise.ar else 0.0
    for residual in one.fitted.residuals:
        e = residual[np.isfinite(residual)]
        width = max(10, e.size // BLOCKS)
        means = e[: e.size // width * width].reshape(-1, width).mean(axis=1)
        wanted = noise.total_sd**2 / width * (1.0 + rho) / (1.0 - rho)
        ratios.append(float(np.mean(means**2)) / max(wanted, 1e-300))
        blocks += means.size
    return float(np.mean(ratios)), math.sqrt(2.0 / blocks)


def attempt(bench: Bench, effects: Sequence[Effect], start: Outcome, iterations: int) -> Outcome | None:
    """Fit effects; nothing where the simulation runs away."""
    try:
        return bench.fitted(effects, start, iterations)
    except InputError:
        return None


def least(fits: Sequence[Outcome | None]) -> Outcome | None:
    """Return the fit that leaves least; nothing where all ran away."""
    return min((one for one in fits if one is not None), key=lambda one: one.rss, default=None)
