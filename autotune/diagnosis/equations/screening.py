"""First order: what every effect at every place would take away beside a fit, and with which values."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import Trial, is_signed, key_of, plainer, trials
from autotune.diagnosis.equations.sought import scale_trial
from autotune.errors import InputError
from autotune.models import Effect
from autotune.progress import Progress

#: Cosine from which on two changes of the readings are one.
PARALLEL = 1.0 - 1e-6


def screen_effects(
    bench: Bench, base: Outcome, without: Collection[str], progress: Progress,
    only: Callable[[Effect], bool] = lambda effect: True,
) -> list[tuple[float, Effect]]:  # fmt: skip
    """Return for every effect and place the decrease that first order predicts, with the values that bring it.

    Parameters
    ----------
    bench, base : Bench, Outcome
        The model on its recordings, and the fit beside which effects are tried.
    without : collection of str
        Effects that are left out.
    progress : callable
        Told what is being done and the share done.
    only : callable
        Whether an effect is tried; by default all are.

    Returns
    -------
    list of (decrease of the sum of squares, effect)
        The best first; an effect at a place stands once, and once more in its plainer form.
    """
    signals = bench.signals(base)
    present = {key_of(effect) for effect in base.effects}
    tried = trials(bench.model, signals, without, bench.is_closed)
    all_trials = [one for one in tried if only(one.effect) and key_of(one.effect) not in present]
    basis, e = bench.explained(base), bench.without_starts(base, base.residual)
    e = e - basis @ (basis.T @ e)
    best: dict[tuple[str, str, str, bool], tuple[float, Effect, FloatArray]] = {}
    directions = bench.each(lambda trial: _direction(bench, base, trial, basis), all_trials)
    for k, (trial, d) in enumerate(zip(all_trials, directions, strict=True)):
        progress("trying every effect", k / len(all_trials))
        if d is None:
            continue
        gain, factor = predict_decrease(e, d, trial)
        key = (*key_of(trial.effect), plainer(trial.effect) is None)
        if gain > 0.0 and (key not in best or gain > best[key][0]):
            best[key] = (gain, scale_trial(trial, factor), d)
    return sorted(_apart(best.values()), key=lambda pair: -pair[0])


def _apart(found: Iterable[tuple[float, Effect, FloatArray]]) -> list[tuple[float, Effect]]:
    """Return effects and what they predict, without those that are another one at another place, the first one kept.

    A signal that is added to a command which drives one state alone is the same as one that drives that state.
    """
    kept: list[tuple[float, Effect, FloatArray]] = []
    for gain, effect, d in found:
        same = (other for _, one, other in kept if (one.name, one.column) == (effect.name, effect.column))
        if not any(abs(float(d @ e)) > PARALLEL * float(np.linalg.norm(d)) * float(np.linalg.norm(e)) for e in same):
            kept.append((gain, effect, d))
    return [(gain, effect) for gain, effect, _ in kept]


def _direction(bench: Bench, base: Outcome, trial: Trial, basis: FloatArray) -> FloatArray | None:
    """Return how readings change with a trial beyond what numbers and starts explain."""
    for shrink in (1.0, 0.1):
        one = trial if shrink == 1.0 else replace(trial, effect=scale_trial(trial, shrink))
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


def predict_decrease(e: FloatArray, d: FloatArray, trial: Trial) -> tuple[float, float]:
    """Return the decrease predicted along a direction, and the factor of its amplitude, or of the whole of it."""
    size = float(d @ d)
    if size <= 1e-12 * float(e @ e):
        return 0.0, 1.0
    factor = float(e @ d) / size
    if trial.scaled:
        if factor <= 0.0 and not any(is_signed(trial.effect, key) for key in trial.scaled):
            return 0.0, 1.0
        factor = float(np.clip(factor, -60.0, 60.0))
        return 2.0 * factor * float(e @ d) - factor**2 * size, factor
    factor = float(np.clip(factor, 0.0, 1.5))
    return 2.0 * factor * float(e @ d) - factor**2 * size, 1.0
