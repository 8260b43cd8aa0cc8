"""First order screens every effect at every place, fits decide, one effect after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.equations.bench import Bench, Outcome, scaled
from autotune.diagnosis.equations.candidates import Trial, place_of, trials
from autotune.diagnosis.fitting.noise import Noise, noise_from_differences
from autotune.errors import InputError
from autotune.models import Effect
from autotune.progress import Progress

#: What a number pays beyond Schwarz's criterion: of two explanations as good as each other the simpler is taken.
LEAD = 6.0
#: Effects that are fitted after the first look, of the first and of a further effect; and how many are sought.
FITTED, FITTED_FURTHER, MOST_EFFECTS = 6, 4, 2
#: Penalised decrease that an effect must bring, and the share of the residual's sum of squares.
WORTH, SHARE = 30.0, 0.02
#: Residual variance, of the noise's that its differences show, up to which it is noise.
NOISE_ALONE = 1.08
#: Iterations of a first fit, and of the best ones.
FIRST, LAST = 6, 12
#: Of the best predicted decrease: what is less is not fitted.
FAINT = 0.02


@dataclass(frozen=True, kw_only=True, eq=False)
class Searched:
    """What a search found.

    Attributes
    ----------
    nominal, retuned, chosen : Outcome
        The model as it is, with its own numbers retuned, and with the effects that are worth it.
    tried : tuple of Outcome
        All hypotheses that were fitted.
    noise : Noise
        What differences of the chosen residual show.
    rows : float
        Rows that count, as many as independent noise would make.
    """

    nominal: Outcome
    retuned: Outcome
    chosen: Outcome
    tried: tuple[Outcome, ...]
    noise: Noise
    rows: float

    def score(self, one: Outcome) -> float:
        """Return the penalised chi-square of a hypothesis, up to a constant."""
        return penalised(one, self.rows)

    def variance_ratio(self, one: Outcome) -> float:
        """Return the residual's variance in units of the noise's."""
        return one.rss / one.residual.size / max(self.noise.total_sd**2, 1e-300)


def penalised(one: Outcome, rows: float) -> float:
    """Return rows log(mean square) and what each number pays: Schwarz's criterion with unknown noise, and a lead."""
    return rows * float(np.log(max(one.rss / one.residual.size, 1e-300))) + one.count * (float(np.log(rows)) + LEAD)


def search(bench: Bench, without: Sequence[str], progress: Progress) -> Searched:
    """Search for what is missing.

    Parameters
    ----------
    bench : Bench
        The model on its recordings.
    without : sequence of str
        Effects that are left out.
    progress : callable
        Told what is being done and the share done.
    """
    progress("retuning the model", 0.02)
    retuned = bench.retuned()
    nominal = bench.as_it_is(retuned)
    noise = _noise(bench, retuned)
    rows = _independent(retuned, noise)
    tried: list[Outcome] = []
    chosen = retuned
    while len(chosen.effects) - len(retuned.effects) < MOST_EFFECTS:
        if _ratio(chosen, _noise(bench, chosen)) < NOISE_ALONE and not _is_slow(bench, chosen):
            break
        further = chosen is not retuned
        new = _round(bench, chosen, without, progress, further)
        tried += new
        noise = _noise(bench, min([chosen, *new], key=lambda one: one.rss))
        rows = _independent(retuned, noise)
        best = min(new, key=lambda one: penalised(one, rows), default=None)
        if best is None or not _worth(chosen, best, rows):
            break
        chosen = best
    return Searched(nominal=nominal, retuned=retuned, chosen=chosen, tried=tuple(tried), noise=noise, rows=rows)


def _worth(before: Outcome, after: Outcome, rows: float) -> bool:
    return penalised(before, rows) - penalised(after, rows) > WORTH and after.rss < (1.0 - SHARE) * before.rss


def _noise(bench: Bench, one: Outcome) -> Noise:
    """Return the noise that a residual's differences show, row by row of each recording."""
    residuals = [np.nan_to_num(r) for r in one.fitted.residuals]
    good = [np.isfinite(r) for r in one.fitted.residuals]
    found = noise_from_differences(residuals, good)
    spread = max(float(np.nanstd(r.y)) for r in bench.recordings)
    return found if found.sd > 1e-6 * spread else Noise(sd=max(1e-6 * spread, 1e-300))


def _independent(one: Outcome, noise: Noise) -> float:
    rho = noise.ar[0] if noise.ar else 0.0
    return max(one.residual.size * (1.0 - rho) / (1.0 + rho), 20.0)


def _ratio(one: Outcome, noise: Noise) -> float:
    return one.rss / one.residual.size / max(noise.total_sd**2, 1e-300)


def _is_slow(bench: Bench, one: Outcome) -> bool:
    """Whether block means of a residual vary by more than its noise says."""
    noise, ratios = _noise(bench, one), []
    rho = noise.ar[0] if noise.ar else 0.0
    for residual in one.fitted.residuals:
        e = residual[np.isfinite(residual)]
        width = max(10, e.size // 60)
        means = e[: e.size // width * width].reshape(-1, width).mean(axis=1)
        wanted = noise.total_sd**2 / width * (1.0 + rho) / (1.0 - rho)
        ratios.append(float(np.mean(means**2)) / max(wanted, 1e-300))
    return bool(np.mean(ratios) > 1.6)


def _round(bench: Bench, base: Outcome, without: Sequence[str], progress: Progress, further: bool) -> list[Outcome]:
    """Look at every effect at every place, and fit the best."""
    share = 0.5 if further else 0.1
    ranked = screened(bench, base, without, lambda what, s: progress(what, share + 0.15 * s))
    count = FITTED_FURTHER if further else FITTED
    found = []
    for k, (_, effect) in enumerate(ranked[:count]):
        progress(f"fitting {effect.name}", share + 0.15 + 0.2 * k / count)
        try:
            found.append(bench.fitted((*base.effects, effect), base, FIRST))
        except InputError:
            continue
    found.sort(key=lambda one: one.rss)
    for k, one in enumerate(found[:2]):
        progress(f"fitting {one.effects[-1].name}", share + 0.35 + 0.04 * k)
        try:
            better = bench.fitted(one.effects, one, LAST)
        except InputError:
            continue
        found[k] = better if better.rss < one.rss else one
    return found


def screened(bench: Bench, base: Outcome, without: Sequence[str], progress: Progress) -> list[tuple[float, Effect]]:
    """Return for every effect and place the decrease that first order predicts, with the values that bring it.

    Returns
    -------
    list of (decrease of the sum of squares, effect)
        The best first; an effect at a place stands once.
    """
    signals = bench.signals(base)
    present = {(effect.name, place_of(effect)) for effect in base.effects}
    tried = trials(bench.model, signals, without, bench.is_closed)
    tried += bench.periodic(base, signals) if "environment.periodic_load" not in without else []
    all_trials = [one for one in tried if (one.effect.name, one.place) not in present]
    basis, e = bench.explained(base), bench.without_starts(base, base.residual)
    e = e - basis @ (basis.T @ e)
    best: dict[tuple[str, str], tuple[float, Effect]] = {}
    for k, trial in enumerate(all_trials):
        progress("trying every effect", k / len(all_trials))
        d = _direction(bench, base, trial, basis)
        if d is None:
            continue
        gain, factor = predicted(e, d, trial)
        key = (trial.effect.name, trial.place)
        if gain > 0.0 and (key not in best or gain > best[key][0]):
            best[key] = (gain, scaled(trial, factor))
    ranked = sorted(best.values(), key=lambda pair: -pair[0])
    least = FAINT * ranked[0][0] if ranked else 0.0
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
