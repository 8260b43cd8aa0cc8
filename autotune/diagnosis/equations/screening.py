"""First order: what every effect at every place would take away beside a fit, and with which values."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import Trial, place_of, plainer, trials
from autotune.diagnosis.equations.sought import scaled
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.errors import InputError
from autotune.models import Effect
from autotune.progress import Progress


def screened(
    bench: Bench, base: Outcome, without: Sequence[str], progress: Progress, limits: Thresholds = IN_USE,
    only: Set[str] = frozenset(),
) -> list[tuple[float, Effect]]:  # fmt: skip
    """Return for every effect and place the decrease that first order predicts, with the values that bring it.

    Parameters
    ----------
    bench, base : Bench, Outcome
        The model on its recordings, and the fit beside which effects are tried.
    without : sequence of str
        Effects that are left out.
    progress : callable
        Told what is being done and the share done.
    limits : Thresholds
        What decides.
    only : set of str
        Effects that are tried; all where it is empty.

    Returns
    -------
    list of (decrease of the sum of squares, effect)
        The best first; an effect at a place stands once, and once more in its plainer form.
    """
    signals = bench.signals(base)
    present = {(effect.name, place_of(effect)) for effect in base.effects}
    tried = trials(bench.model, signals, without, bench.is_closed)
    tried += bench.periodic(base, signals) if "environment.periodic_load" not in without else []
    tried = [one for one in tried if not only or one.effect.name in only]
    all_trials = [one for one in tried if (one.effect.name, one.place) not in present]
    basis, e = bench.explained(base), bench.without_starts(base, base.residual)
    e = e - basis @ (basis.T @ e)
    best: dict[tuple[str, str, bool], tuple[float, Effect]] = {}
    directions = bench.each(lambda trial: _direction(bench, base, trial, basis), all_trials)
    for k, (trial, d) in enumerate(zip(all_trials, directions, strict=True)):
        progress("trying every effect", k / len(all_trials))
        if d is None:
            continue
        gain, factor = predicted(e, d, trial)
        key = (trial.effect.name, trial.place, plainer(trial.effect) is None)
        if gain > 0.0 and (key not in best or gain > best[key][0]):
            best[key] = (gain, scaled(trial, factor))
    ranked = sorted(best.values(), key=lambda pair: -pair[0])
    least = limits.equation_faint * ranked[0][0] if ranked else 0.0
    return [pair for pair in ranked if pair[0] >= least]


def _direction(bench: Bench, base: Outcome, trial: Trial, basis: FloatArray) -> FloatArray | None:
    """Return how readings change with a trial beyond what numbers and starts explain."""
    for shrink in (1.0, 0.1):
        one = trial if shrink == 1.0 else replace(trial, effect=scaled(trial, shrink))
        try:
            d = bench.with_trial(base, one.effect)
        except InputError:
            return None
        if d is not None:
            d = bench.without_starts(base, d) / shrink
            return np.asarray(d - basis @ (basis.T @ d))
        if not trial.scaled:
            return None
    return None


def predicted(e: FloatArray, d: FloatArray, trial: Trial) -> tuple[float, float]:
    """Return the decrease predicted along a direction, and the factor of its amplitude, or of the whole of it."""
    size = float(d @ d)
    if size <= 1e-12 * float(e @ e):
        return 0.0, 1.0
    factor = float(e @ d) / size
    if trial.scaled:
        name = trial.effect.name
        signed = name.startswith(("environment", "actuator", "sensor")) or name in (
            "plant.sine_torque", "plant.cubic_stiffness", "plant.leak",
        )  # fmt: skip
        if factor <= 0.0 and not signed:
            return 0.0, 1.0
        factor = float(np.clip(factor, -60.0, 60.0))
        return 2.0 * factor * float(e @ d) - factor**2 * size, factor
    factor = float(np.clip(factor, 0.0, 1.5))
    return 2.0 * factor * float(e @ d) - factor**2 * size, 1.0
