"""First order screens every effect at every place, fits decide, one effect after the other.

The steps of one search: the file is a little longer than others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import (
    is_free_load,
    is_plainer,
    is_usual,
    key_of,
    plainer,
)
from autotune.diagnosis.equations.dry_friction import settled_among, swept, with_force
from autotune.diagnosis.equations.scores import (
    attempt,
    independent_rows,
    is_noise,
    is_settled,
    is_slow,
    is_worth,
    least,
    noise_of,
    penalised,
    variance_ratio,
)
from autotune.diagnosis.equations.screening import screened
from autotune.diagnosis.evidence.stretches import advantage
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.errors import InputError
from autotune.models import Effect
from autotune.progress import Progress, quiet

#: Iterations of a fit that shows whether more are worth it, of a first fit, of the best ones, and of the chosen one.
LOOK, FIRST, LAST, FINAL = 2, 4, 8, 30
#: Fits to short windows that go on to long ones.
CARRIED = 3


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
    limits : Thresholds
        What decided.
    """

    nominal: Outcome
    retuned: Outcome
    chosen: Outcome
    tried: tuple[Outcome, ...]
    noise: Noise
    rows: float
    limits: Thresholds

    def score(self, one: Outcome) -> float:
        """Return the penalised chi-square of a hypothesis, up to a constant."""
        return penalised(one, self.rows, self.limits)

    def variance_ratio(self, one: Outcome) -> float:
        """Return the residual's variance in units of the noise's."""
        return variance_ratio(one, self.noise)


def search(bench: Bench, without: Sequence[str], progress: Progress, limits: Thresholds = IN_USE) -> Searched:
    """Search for what is missing.

    Parameters
    ----------
    bench : Bench
        The model on its recordings.
    without : sequence of str
        Effects that are left out.
    progress : callable
        Told what is being done and the share done.
    limits : Thresholds
        What decides between two findings.

    Notes
    -----
    Every effect at every place is looked at to first order, the best are fitted, and one is added after the other; what
    the last ones make needless is dropped. Where the best fit is far from the noise, the retuned model may lie in a
    wrong minimum, from which no first order leads out: then everything is looked at from short windows too, whose free
    start states keep simulations near the readings, and the best go on to long ones.
    """
    progress("retuning the model", 0.02)
    retuned = bench.retuned()
    nominal = bench.as_it_is(retuned)
    noise = noise_of(bench, retuned)
    rows = independent_rows(retuned, noise)
    tried: list[Outcome] = []
    chosen = retuned
    while len(chosen.effects) - len(retuned.effects) < limits.equation_effects:
        if is_noise(bench, chosen, limits.equation_noise, limits) and not is_slow(bench, chosen, limits):
            break
        new = _leading(bench, chosen, without, progress, limits, chosen is not retuned)
        tried += new
        noise = noise_of(bench, min([chosen, *new], key=lambda one: one.rss))
        rows = independent_rows(retuned, noise)
        larger = _larger(bench, chosen, new, tried, len(retuned.effects), rows, limits)
        if larger is None:
            break
        chosen = _simplified(bench, larger, retuned, tried, rows, limits)
    chosen = _pruned(bench, chosen, len(retuned.effects), tried, rows, limits)
    if chosen is not retuned and not is_noise(bench, chosen, limits.equation_noise, limits):
        chosen = _finished(bench, chosen, retuned, rows)
        tried.append(chosen)
    return Searched(
        nominal=nominal, retuned=retuned, chosen=chosen, tried=tuple(tried), noise=noise, rows=rows, limits=limits
    )


def _simplified(
    bench: Bench, one: Outcome, retuned: Outcome, tried: list[Outcome], rows: float, limits: Thresholds
) -> Outcome:
    """Return a hypothesis with the effects before its last one in their plainest form where more is not worth it.

    A torque of free period and phase may have stood for gravity and a bend: beside the bend gravity is enough.
    """
    for i in range(len(retuned.effects), len(one.effects) - 1):
        less = plainer(one.effects[i])
        if less is None:
            continue
        effects = [*one.effects[:i], less, *one.effects[i + 1 :]]
        fits = [attempt(bench, effects, one, LAST)]
        if less.name == one.effects[i].name:  # what a bent torque moved away from is far from where gravity leaves it
            fits.append(attempt(bench, effects, retuned, FINAL))
        simple = least(fits)
        if simple is not None:
            tried.append(simple)
            one = one if is_worth(simple, one, rows, limits) else simple
    return one


def _finished(bench: Bench, chosen: Outcome, retuned: Outcome, rows: float) -> Outcome:
    """Return a fit to its end: from where it is, from the numbers without effects, and with start states found anew.

    Where dry friction held the plant while numbers were still wrong, start states stay behind, and hold numbers back:
    from the numbers without effects it begins at half of what was found.
    """
    fits = [chosen, attempt(bench, chosen.effects, chosen, FINAL)]
    fits.append(attempt(bench, [with_force(effect, 0.5) for effect in chosen.effects], retuned, FINAL))
    with suppress(InputError):
        fits.append(bench.carried(chosen, FINAL))
    best = least(fits) or chosen
    return settled_among(bench, swept(bench, best), rows, variance_ratio(best, noise_of(bench, best)))


def _larger(
    bench: Bench, parent: Outcome, new: list[Outcome], tried: list[Outcome], own: int, rows: float, limits: Thresholds
) -> Outcome | None:
    """Return the best hypothesis with one more effect in its plainest form; nothing where none is needed."""
    new.sort(key=_first(bench, rows, limits))
    best = next((one for one in new if is_worth(parent, one, rows, limits)), new[0] if new else None)
    best = best and _plainest(bench, best, tried, rows, limits)
    if best is not None and _is_needed(bench, parent, best, own, rows, limits):
        return best
    usual = (one for one in new if is_usual(one.effects[-1]))
    return next((one for one in usual if _is_usual(bench, parent, one, rows, limits)), None)


def _is_usual(bench: Bench, before: Outcome, after: Outcome, rows: float, limits: Thresholds) -> bool:
    """Whether a usual effect pays for its number and predicts what was left out, if only a little.

    It was expected, not the best of a hundred: where more than noise is left it need not take a large share away.
    """
    if is_noise(bench, before, limits.equation_astray, limits):
        return False
    if penalised(after, rows, limits) >= penalised(before, rows, limits):
        return False
    speaks = advantage(bench.left_out_squares(before), bench.left_out_squares(after)) > 0.0
    return speaks and bench.held_out_error(after, True) < bench.held_out_error(before, True)


def _first(bench: Bench, rows: float, limits: Thresholds) -> Callable[[Outcome], tuple[bool, float]]:
    """Return the key by which the best hypothesis comes first.

    A load of free timing explains a part of everything: others come first unless it leaves noise alone.
    """
    return lambda one: (_is_partial_load(bench, one, limits), penalised(one, rows, limits))


def _leading(
    bench: Bench, base: Outcome, without: Sequence[str], progress: Progress, limits: Thresholds, further: bool
) -> list[Outcome]:
    """Return fits with one more effect, sought on a part of the rows where there are many, fitted to all of them."""
    part = bench.part(base, limits.equation_rows)
    if part is None:
        return _round(bench, base, without, progress, limits, further)
    small, there = part
    found = _round(small, there, without, progress, limits, further)
    rows = independent_rows(there, noise_of(small, there))
    found.sort(key=_first(small, rows, limits))
    once = {(*key_of(one.effects[-1]), len(one.effects)): one for one in reversed(found)}
    carried: list[Outcome] = []
    for one in sorted(once.values(), key=found.index)[: limits.confirmed]:
        if np.log(there.rss / one.rss) < limits.equation_near * np.log(there.rss / found[0].rss):
            continue
        progress(f"fitting {one.effects[-1].name} to all rows", 0.85 if further else 0.45)
        fits: list[Outcome | None] = []
        with suppress(InputError):
            fits.append(bench.carried(one, LAST if carried else 2 * LAST))
        if is_usual(one.effects[-1]):  # with start states that hold without it
            fits.append(attempt(bench, one.effects, base, LAST))
        best = least(fits)
        carried += [] if best is None else [_elsewhere(bench, best, limits)]
    return [*carried, *_usual_beside(bench, base, carried, without, limits)]


def _usual_beside(
    bench: Bench, base: Outcome, found: Sequence[Outcome], without: Sequence[str], limits: Thresholds
) -> list[Outcome]:
    """Return fits to all rows with the usual effects that a part did not lead to, where more than noise is left.

    A part where a rig's own error is largest may say nothing of them.
    """
    if is_noise(bench, min([base, *found], key=lambda one: one.rss), limits.equation_astray, limits):
        return []
    have = {key_of(one.effects[-1]) for one in found}
    usual = [e for _, e in screened(bench, base, without, quiet, limits, is_usual) if key_of(e) not in have]
    fits = (attempt(bench, (*base.effects, effect), base, LAST) for effect in usual)
    return [_elsewhere(bench, one, limits) for one in fits if one is not None]


def _elsewhere(bench: Bench, one: Outcome, limits: Thresholds) -> Outcome:
    """Return a fit from wherever it ends best, where a usual effect makes many minima and more than noise is left."""
    if not is_usual(one.effects[-1]) or is_noise(bench, one, limits.equation_astray, limits):
        return one
    return least(swept(bench, one)) or one


def _round(
    bench: Bench, base: Outcome, without: Sequence[str], progress: Progress, limits: Thresholds, further: bool
) -> list[Outcome]:
    """Look at every effect at every place, and fit the best: on long windows, and from short ones where those fail."""
    share, count = (0.5, limits.equation_further) if further else (0.1, limits.equation_fitted)

    def told(what: str, done: float) -> None:
        progress(what, share + 0.35 * done)

    beside = further and not is_noise(bench, base, limits.equation_astray, limits)
    found = _grown(bench, base, without, told, limits, count, beside)
    best = min(found, key=lambda one: one.rss, default=base)
    if not is_noise(bench, best, limits.equation_astray, limits):
        short = bench.shortened(base)
        if short is not None:
            # the base itself goes on as well: its effects may have been fitted in a wrong minimum
            again = [short] if further else []
            fits = [*again, *_grown(bench, short, without, told, limits, count, beside)]
            found += _lengthened(bench, fits, limits)
    found.sort(key=lambda one: one.rss)
    for k, one in enumerate(found[:2]):
        if is_settled(bench, one, found[0], limits):
            break
        progress(f"fitting {one.effects[-1].name}", share + 0.35 + 0.04 * k)
        better = attempt(bench, one.effects, one, LAST)
        found[k] = better if better is not None and better.rss < one.rss else one
    return [one for one in found if not bench.is_stand_in(one)]


def _grown(
    bench: Bench, base: Outcome, without: Sequence[str], told: Progress, limits: Thresholds, count: int, usual: bool
) -> list[Outcome]:
    """Return fits of a base with each of the effects that predict most, and with usual ones that predict anything.

    Beside a large effect whose own numbers are not right yet, what these leave looks like more than the next effect.
    """
    ranked = screened(bench, base, without, lambda what, done: told(what, 0.4 * done), limits)
    tried = [e for k, (_, e) in enumerate(ranked) if k < count or (usual and is_usual(e))]
    return _fitted(bench, base, tried, lambda what: told(what, 0.6), limits)


def _pruned(
    bench: Bench, chosen: Outcome, own: int, tried: list[Outcome], rows: float, limits: Thresholds
) -> Outcome:  # fmt: skip
    """Drop added effects that buy nothing once the others have their numbers, or predict nothing.

    What is fitted so joins those tried.
    """
    while len(chosen.effects) - own > 1:
        smaller = []
        for i in range(own, len(chosen.effects)):
            one = attempt(bench, (*chosen.effects[:i], *chosen.effects[i + 1 :]), chosen, LAST)
            smaller += [] if one is None else [one]
        tried += smaller
        smaller.sort(key=lambda one: penalised(one, rows, limits))
        whole = bench.held_out_error(chosen, True)
        less = next((one for one in smaller if not ((_predicts(bench, one, whole, limits)
                     and _is_needed(bench, one, chosen, own, rows, limits))
                     or (_lacks_usual(one, chosen) and _is_usual(bench, one, chosen, rows, limits)))),
                    None)  # fmt: skip
        if less is None:
            break
        chosen = less
    return chosen


def _lacks_usual(smaller: Outcome, larger: Outcome) -> bool:
    """Whether what a hypothesis has beyond another one is a usual effect."""
    have = {key_of(e) for e in smaller.effects}
    return any(is_usual(e) and key_of(e) not in have for e in larger.effects)


def _is_needed(bench: Bench, before: Outcome, after: Outcome, own: int, rows: float, limits: Thresholds) -> bool:
    """Whether the larger of two hypotheses is worth its numbers; beside other effects left-out stretches must agree.

    A second effect may make up for a first one that is not quite the right one, or not quite fitted: on rows that were
    fitted something is always gained. A load of free timing explains a part of everything: beside other effects it must
    leave noise alone. Where the model's error and not noise is left, rows are no witnesses and stretches decide alone.
    """
    worth = is_worth(before, after, rows, limits)
    if len(before.effects) <= own and (worth or is_noise(bench, after, limits.equation_astray, limits)):
        return worth
    had = {key_of(e) for e in before.effects}
    loads = any(is_free_load(e) and key_of(e) not in had for e in after.effects)
    if loads and before.effects[own:] and not is_noise(bench, after, limits.equation_noise, limits):
        return False
    if not worth and variance_ratio(after, noise_of(bench, after)) < limits.equation_astray:
        return False
    return _is_earned(bench, before, after, limits)


def _predicts(bench: Bench, smaller: Outcome, error: float, limits: Thresholds) -> bool:
    """Whether a held-out error of a free run is less than a smaller hypothesis's by a share that matters.

    Stretches are short, and the rows about them tell their states: what bends them a little may predict nothing.
    """
    before = bench.held_out_error(smaller, True)
    return not np.isfinite(before) or error < (1.0 - limits.material) * before


def _is_partial_load(bench: Bench, one: Outcome, limits: Thresholds) -> bool:
    """Whether the last effect is a load, and more than noise is left beside it."""
    return is_free_load(one.effects[-1]) and not is_noise(bench, one, limits.equation_noise, limits)


def _is_earned(bench: Bench, before: Outcome, after: Outcome, limits: Thresholds) -> bool:
    """Whether left-out stretches speak for the larger of two hypotheses, and it takes a share of their error away."""
    squares, fewer = bench.left_out_squares(before), bench.left_out_squares(after)
    if not np.all(np.isfinite(squares)):
        return bool(np.all(np.isfinite(fewer)))
    left = float(np.sqrt(fewer.sum() / max(float(squares.sum()), 1e-300)))
    return left < 1.0 - limits.material and advantage(squares, fewer) > 0.0


def _plainest(bench: Bench, best: Outcome, tried: list[Outcome], rows: float, limits: Thresholds) -> Outcome:
    """Return a hypothesis with its last effect in its plainest form, unless more numbers are worth it."""
    last = best.effects[-1]
    less = plainer(last)
    if less is None:
        return best
    one = attempt(bench, (*best.effects[:-1], less), best, FIRST)
    if one is not None and not is_settled(bench, one, best, limits):
        one = attempt(bench, one.effects, one, LAST) or one
    if one is None:
        return best
    tried.append(one)
    if is_plainer(last):
        tried[:] = [other for other in tried if not (other.effects and is_plainer(other.effects[-1]))]
        return one
    if variance_ratio(best, noise_of(bench, best)) < limits.equation_noise:
        # two forms of one effect: noise alone is left, so that rows are witnesses, and it is not the best of many
        return best if penalised(best, rows, limits) < penalised(one, rows, limits) else one
    return best if is_worth(one, best, rows, limits) and _is_earned(bench, one, best, limits) else one


def _fitted(
    bench: Bench, base: Outcome, effects: Sequence[Effect], told: Callable[[str], None], limits: Thresholds
) -> list[Outcome]:
    """Fit single effects for a few steps, and go on with those that are not far behind one that leaves noise.

    Effects that come down to a plainer one come after it, and only where that leaves more than noise.
    """
    found: list[Outcome] = []
    for effect in sorted(effects, key=lambda one: plainer(one) is not None):
        less = plainer(effect)
        if less is not None and any(_leaves_nothing(bench, one, less, limits) for one in found):
            continue
        told(f"fitting {effect.name}")
        whole = (*base.effects, effect)
        outer = bench.is_sought_outside(effect)
        one = attempt(bench, whole, base, FIRST if outer else LOOK)
        if one is None:
            continue
        best = min(found, key=lambda other: other.rss, default=one)
        if not outer and not is_settled(bench, one, best, limits):
            further = attempt(bench, one.effects, one, FIRST)
            one = further if further is not None and further.rss < one.rss else one
        found.append(_elsewhere(bench, one, limits))
    return found


def _leaves_nothing(bench: Bench, one: Outcome, effect: Effect, limits: Thresholds) -> bool:
    """Whether an outcome's last effect is a given one and leaves less beside noise than an effect must bring."""
    last = one.effects[-1]
    if key_of(last) != key_of(effect):
        return False
    return (1.0 - limits.equation_share) * variance_ratio(one, noise_of(bench, one)) < 1.0


def _ends_usual(one: Outcome) -> bool:
    """Whether the last effect is a usual one beside others."""
    return len(one.effects) > 1 and is_usual(one.effects[-1])


def _lengthened(bench: Bench, fits: Sequence[Outcome], limits: Thresholds) -> list[Outcome]:
    """Return the best fits to short windows carried on to long ones, and those with usual effects."""
    found: list[Outcome] = []
    ranked = sorted(fits, key=lambda one: one.rss)
    for one in [*ranked[:CARRIED], *(one for one in ranked[CARRIED:] if _ends_usual(one))]:
        if is_settled(bench, one, ranked[0], limits) and is_noise(bench, found[0], limits.equation_noise, limits):
            continue
        try:
            found.append(bench.lengthened(one))
        except InputError:
            continue
    return found
