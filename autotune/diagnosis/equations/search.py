"""First order screens every effect at every place, fits follow, and what they leave decides, as it does for chains."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress

import numpy as np

from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import is_plainer, is_usual, key_of, plainer
from autotune.diagnosis.equations.dry_friction import settled_among, swept, with_force
from autotune.diagnosis.equations.judged import JudgedEquations, Searched, judged, odds_of
from autotune.diagnosis.equations.scores import (
    attempt,
    is_noise,
    is_settled,
    least,
    noise_of,
    quick_score,
    variance_ratio,
)
from autotune.diagnosis.equations.screening import screened
from autotune.diagnosis.selection.judged import leading, ranked
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.errors import InputError
from autotune.models import Effect
from autotune.progress import Progress, quiet

#: Iterations of a fit that shows whether more are worth it, of a first fit, of the best ones, and of the chosen one.
LOOK, FIRST, LAST, FINAL = 2, 4, 8, 30
#: Fits to short windows that go on to long ones.
CARRIED = 3


def search(
    bench: Bench,
    without: Collection[str],
    progress: Progress,
    limits: Thresholds = IN_USE,
    begun: Outcome | None = None,
) -> Searched:
    """Search for what is missing.

    Parameters
    ----------
    bench : Bench
        The model on its recordings.
    without : collection of str
        Effects that are left out.
    progress : callable
        Told what is being done and the share done.
    limits : Thresholds
        What decides between two findings.
    begun : Outcome, optional
        What predicted best on more rows of these recordings: it is judged as well, from the numbers that it had there.

    Notes
    -----
    Every effect at every place is looked at to first order, the best are fitted, and one is added after the other; what
    the last ones make needless is dropped. Where the best fit is far from the noise, the retuned model may lie in a
    wrong minimum, from which no first order leads out: then everything is looked at from short windows too, whose free
    start states keep simulations near the readings, and the best go on to long ones.
    """
    progress("retuning the model", 0.02)
    retuned = bench.retuned()
    own = len(retuned.effects)

    def all_judged(fits: Sequence[Outcome | None]) -> list[JudgedEquations]:
        each = (judged(bench, one, own, limits) for one in fits if one is not None)
        return [one for one in each if one is not None]

    found = all_judged([retuned])
    if not found:
        raise InputError("the model runs away on left-out stretches", where="diagnose", remedy="check its numbers")
    best = found[0]
    while len(best.names) < limits.rig_effects and not best.leaves_noise:
        fits = _leading(bench, best.outcome, without, progress, limits, bool(best.names))
        larger = all_judged(_promising(bench, fits, own, limits))
        found += larger
        first = ranked([best, *larger])[0]
        if first is best or not first.is_better(best, limits.material):
            break
        best = first
    if begun is not None:
        found += all_judged([attempt(bench, begun.effects, retuned, FINAL)])
    found = _pruned(bench, found, all_judged, limits)
    found += all_judged(_finished(bench, ranked(found)[0], retuned, limits))
    chosen = ranked(found)[0]
    return Searched(nominal=bench.as_it_is(retuned), judged=tuple(found), best=chosen, taken=chosen)


def _promising(bench: Bench, fits: Sequence[Outcome], own: int, limits: Thresholds) -> list[Outcome]:
    """Return the fits to judge: of each hypothesis the best, and the effect that its last one comes down to."""
    if not fits:
        return []
    noise = noise_of(bench, min(fits, key=lambda one: one.rss))

    def charged(one: Outcome) -> float:
        odds = sum(np.log(odds_of(e)) for e in one.effects[own:])
        return quick_score(one, noise) - 2.0 * limits.temperature * float(odds)

    once = {frozenset(map(key_of, one.effects)): one for one in sorted(fits, key=charged, reverse=True)}
    few = sorted(once.values(), key=charged)[: limits.rig_tried]
    plain = [_plainest(bench, one) for one in few[: limits.confirmed]]
    return [one for one in few if not is_plainer(one.effects[-1])] + [one for one in plain if one is not None]


def _plainest(bench: Bench, one: Outcome) -> Outcome | None:
    """Return a fit with its last effect in its plainest form; nothing where it has none."""
    less = plainer(one.effects[-1])
    if less is None:
        return None
    first = attempt(bench, (*one.effects[:-1], less), one, FIRST)
    return first and (attempt(bench, first.effects, first, LAST) or first)


def _pruned(
    bench: Bench,
    found: Sequence[JudgedEquations],
    all_judged: Callable[[Sequence[Outcome | None]], list[JudgedEquations]],
    limits: Thresholds,
) -> list[JudgedEquations]:
    """Return hypotheses with those that leading ones become without each of their effects, or with a plainer one.

    Built one by one, an effect may have stood for another: a torque of free period for gravity and a bend.
    """
    result, done = list(found), set()
    for _ in range(limits.rig_effects):
        fresh = [one for one in leading(result, limits.confirmed) if len(one.names) > 1]
        fresh = [one for one in fresh if one.identity not in done]
        if not fresh:
            break
        for one in {one.identity: one for one in fresh}.values():
            done.add(one.identity)
            known = {other.identity for other in result}
            effects = one.outcome.effects
            for i in range(one.own, len(effects)):
                less = plainer(effects[i])
                smaller = [(*effects[:i], *effects[i + 1 :])]
                smaller += [] if less is None else [(*effects[:i], less, *effects[i + 1 :])]
                new = [e for e in smaller if frozenset(map(key_of, e[one.own :])) not in known]
                result += all_judged([attempt(bench, e, one.outcome, LAST) for e in new])
    return result


def _finished(bench: Bench, one: JudgedEquations, retuned: Outcome, limits: Thresholds) -> list[Outcome]:
    """Return a fit to its end: from where it is, from the numbers without effects, and with start states found anew.

    Where dry friction held the plant while numbers were still wrong, start states stay behind, and hold numbers back:
    from the numbers without effects it begins at half of what was found.
    """
    if not one.names or one.leaves_noise:
        return []
    chosen = one.outcome
    fits = [chosen, attempt(bench, chosen.effects, chosen, FINAL)]
    fits.append(attempt(bench, [with_force(effect, 0.5) for effect in chosen.effects], retuned, FINAL))
    with suppress(InputError):
        fits.append(bench.carried(chosen, FINAL))
    best = least(fits) or chosen
    return [settled_among(bench, swept(bench, best), one.rows, variance_ratio(best, noise_of(bench, best)))]


def _leading(
    bench: Bench, base: Outcome, without: Collection[str], progress: Progress, limits: Thresholds, further: bool
) -> list[Outcome]:
    """Return fits with one more effect, sought on a part of the rows where there are many, fitted to all of them."""
    part = bench.part(base, limits.equation_rows)
    if part is None:
        return _round(bench, base, without, progress, limits, further)
    small, there = part
    found = _round(small, there, without, progress, limits, further)
    found.sort(key=lambda one: quick_score(one, noise_of(small, there)))
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
    bench: Bench, base: Outcome, found: Sequence[Outcome], without: Collection[str], limits: Thresholds
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
    bench: Bench, base: Outcome, without: Collection[str], progress: Progress, limits: Thresholds, further: bool
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
    bench: Bench, base: Outcome, without: Collection[str], told: Progress, limits: Thresholds, count: int, usual: bool
) -> list[Outcome]:
    """Return fits of a base with each of the effects that predict most, and with usual ones that predict anything.

    Beside a large effect whose own numbers are not right yet, what these leave looks like more than the next effect.
    """
    ranked = screened(bench, base, without, lambda what, done: told(what, 0.4 * done), limits)
    tried = [e for k, (_, e) in enumerate(ranked) if k < count or (usual and is_usual(e))]
    return _fitted(bench, base, tried, lambda what: told(what, 0.6), limits)


def _fitted(
    bench: Bench, base: Outcome, effects: Sequence[Effect], told: Callable[[str], None], limits: Thresholds
) -> list[Outcome]:
    """Fit single effects for a few steps, and go on with those that are not far behind one that leaves noise.

    Effects that come down to a plainer one come after it, and only where that leaves more than noise.
    """
    found: list[Outcome] = []
    for effect in sorted(effects, key=lambda one: plainer(one) is not None):
        less = plainer(effect)
        if less is not None and any(
            key_of(one.effects[-1]) == key_of(less) and is_noise(bench, one, limits.adequate, limits) for one in found
        ):
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


def _ends_usual(one: Outcome) -> bool:
    """Whether the last effect is a usual one beside others."""
    return len(one.effects) > 1 and is_usual(one.effects[-1])


def _lengthened(bench: Bench, fits: Sequence[Outcome], limits: Thresholds) -> list[Outcome]:
    """Return the best fits to short windows carried on to long ones, and those with usual effects."""
    found: list[Outcome] = []
    ranked = sorted(fits, key=lambda one: one.rss)
    for one in [*ranked[:CARRIED], *(one for one in ranked[CARRIED:] if _ends_usual(one))]:
        if is_settled(bench, one, ranked[0], limits) and is_noise(bench, found[0], limits.adequate_quick, limits):
            continue
        try:
            found.append(bench.lengthened(one))
        except InputError:
            continue
    return found
