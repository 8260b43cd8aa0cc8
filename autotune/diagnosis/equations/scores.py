"""How hypotheses of a search in equations compare: what they leave beside noise, and what an effect is worth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.fitting.noise import Noise, noise_from_differences
from autotune.diagnosis.thresholds import Thresholds
from autotune.errors import InputError
from autotune.models import Effect


def penalised(one: Outcome, rows: float, limits: Thresholds) -> float:
    """Return rows log(mean square) and what each number pays: Schwarz's criterion with unknown noise, and a lead."""
    each = float(np.log(rows)) + limits.equation_lead
    return rows * float(np.log(max(one.rss / one.residual.size, 1e-300))) + one.count * each


def is_worth(before: Outcome, after: Outcome, rows: float, limits: Thresholds) -> bool:
    """Whether the larger of two hypotheses pays for its numbers, and for having been the best of many."""
    more = penalised(before, rows, limits) - penalised(after, rows, limits) > limits.equation_decrease
    return more and after.rss < (1.0 - limits.equation_share) * before.rss


def noise_of(bench: Bench, one: Outcome) -> Noise:
    """Return the noise that a residual's differences show, row by row of each recording."""
    residuals = [np.nan_to_num(r) for r in one.fitted.residuals]
    good = [np.isfinite(r) for r in one.fitted.residuals]
    found = noise_from_differences(residuals, good)
    spread = max(float(np.nanstd(r.y)) for r in bench.recordings)
    return found if found.sd > 1e-6 * spread else Noise(sd=max(1e-6 * spread, 1e-300))


def independent_rows(one: Outcome, noise: Noise) -> float:
    """Return as how many rows with independent errors those of a fit count: by the correlation from row to row."""
    rho = noise.ar[0] if noise.ar else 0.0
    return max(one.residual.size * (1.0 - rho) / (1.0 + rho), 20.0)


def variance_ratio(one: Outcome, noise: Noise) -> float:
    """Return a residual's variance in units of the noise's."""
    return one.rss / one.residual.size / max(noise.total_sd**2, 1e-300)


def is_noise(bench: Bench, one: Outcome, most: float, limits: Thresholds) -> bool:
    """Whether a residual has a noise's variance; what goes on from row to row may be physics that is left out."""
    noise = noise_of(bench, one)
    return variance_ratio(one, noise) < most and not (noise.ar and noise.ar[0] > limits.slow_noise)


def is_settled(bench: Bench, one: Outcome, best: Outcome, limits: Thresholds) -> bool:
    """Whether a fit need not be finished: another one of the same rows leaves noise alone, and it is far behind."""
    if one is best or variance_ratio(best, noise_of(bench, best)) >= limits.equation_noise:
        return False
    return one.residual.size * float(np.log(one.rss / max(best.rss, 1e-300))) > limits.equation_behind


def is_slow(bench: Bench, one: Outcome, limits: Thresholds) -> bool:
    """Whether block means of a residual vary by more than its noise says."""
    noise, ratios = noise_of(bench, one), []
    rho = noise.ar[0] if noise.ar else 0.0
    for residual in one.fitted.residuals:
        e = residual[np.isfinite(residual)]
        width = max(10, e.size // 60)
        means = e[: e.size // width * width].reshape(-1, width).mean(axis=1)
        wanted = noise.total_sd**2 / width * (1.0 + rho) / (1.0 - rho)
        ratios.append(float(np.mean(means**2)) / max(wanted, 1e-300))
    return bool(np.mean(ratios) > limits.equation_slow)


def attempt(bench: Bench, effects: Sequence[Effect], start: Outcome, iterations: int) -> Outcome | None:
    """Fit effects; nothing where the simulation runs away."""
    try:
        return bench.fitted(effects, start, iterations)
    except InputError:
        return None


def least(fits: Sequence[Outcome | None]) -> Outcome | None:
    """Return the fit that leaves least; nothing where all ran away."""
    return min((one for one in fits if one is not None), key=lambda one: one.rss, default=None)
