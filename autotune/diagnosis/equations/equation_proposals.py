"""What a search among equations proposes: first order screens every effect at every place, and fits follow.

Where the best fit is far from the noise, the model may lie in a wrong minimum, from which no first order leads out:
then everything is looked at from short windows too, whose free start states keep simulations near the readings, and the
best go on to long ones.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.candidates import is_plainer, is_usual, key_of, plainer
from autotune.diagnosis.equations.dry_friction import select_minimum, sweep_levels, with_force
from autotune.diagnosis.equations.judged import JudgedEquations, judge, odds_of
from autotune.diagnosis.equations.scores import (
    attempt,
    is_noise,
    is_settled,
    least,
    noise_of,
    quick_score,
    variance_ratio,
)
from autotune.diagnosis.equations.screening import screen_effects
from autotune.diagnosis.selection.judged import rank
from autotune.diagnosis.selection.search import Found, Proposals, search
from autotune.errors import InputError
from autotune.progress import Progress, quiet

#: Iterations of a fit that shows whether more are worth it, of a first fit, of the best ones, and of the chosen one.
LOOK, FIRST, LAST, FINAL = 2, 4, 8, 30
#: Fits to short windows that go on to long ones.
CARRIED = 3


def search_equations(
    bench: Bench,
    without: Collection[str],
    progress: Progress = quiet,
    known: Sequence[JudgedEquations] | None = None,
) -> Found[JudgedEquations]:
    """Search for what is missing in equations, or in a closed model.

    Parameters
    ----------
    bench, without
        The model on its recordings, and effects that are left out.
    progress, known
        As in :func:`autotune.diagnosis.selection.search.search`.

    Raises
    ------
    InputError
        The nominal model runs away.
    """
    progress("retuning the model", 0.02)
    outcome = bench.retuned()
    retuned = judge(bench, outcome, len(outcome.effects))
    if retuned is None:
        raise InputError("the model runs away on left-out stretches", where="diagnose", remedy="check its numbers")
    nominal = replace(retuned, outcome=bench.as_it_is(outcome), tuned=False)
    return search(_EquationProposals(bench=bench, without=without, nominal=nominal, roots=(retuned,)), progress, known)


@dataclass(frozen=True, kw_only=True, eq=False)
class _EquationProposals(Proposals[JudgedEquations]):
    """Equations on recordings, some effects left out; fits are in units of the residual that each leaves."""

    bench: Bench
    without: Collection[str]
    nominal: JudgedEquations
    roots: tuple[JudgedEquations, ...]

    def larger(self, beam: Sequence[JudgedEquations], progress: Progress) -> list[JudgedEquations]:
        """Return hypotheses with one effect more than those of a beam, beside which more than noise is left."""
        found: list[JudgedEquations] = []
        for base in beam:
            if not base.leaves_noise:
                fits = _fit_larger(self.bench, base.outcome, self.without, progress, further=bool(base.names))
                found += self._judged(_select(self.bench, fits, base.own))
        return found

    def refitted(self, some: Sequence[JudgedEquations]) -> list[JudgedEquations]:
        """Return hypotheses of other rows fitted to these from their numbers, without those that run away."""
        self.bench.signals(self.roots[0].outcome)  # sizes of what effects act on, by which their numbers are sought
        fits = []
        for one in some:
            with suppress(InputError):
                fits.append(self.bench.refitted(one.outcome, FINAL))
        return self._judged(fits)

    def smaller(self, some: Sequence[JudgedEquations], known: Sequence[JudgedEquations]) -> list[JudgedEquations]:
        """Return hypotheses without each of their effects, or with a plainer one, as far as these are not known yet.

        Built one by one, an effect may have stood for another: a torque of free period for gravity and a bend.
        """
        seen, result = {one.identity for one in known}, []
        for one in some:
            effects = one.outcome.effects
            for i in range(one.own, len(effects)):
                less = plainer(effects[i])
                tried = [(*effects[:i], *([] if other is None else [other]), *effects[i + 1 :])
                         for other in ((None,) if less is None else (None, less))]  # fmt: skip
                new = [e for e in tried if frozenset(map(key_of, e[one.own :])) not in seen]
                result += self._judged(attempt(self.bench, e, one.outcome, LAST) for e in new)
            seen |= {other.identity for other in result}
        return result

    def finish_leading(self, found: Sequence[JudgedEquations]) -> list[JudgedEquations]:
        """Return the leading hypothesis fitted to the end."""
        return self._judged(_fit_to_end(self.bench, rank(found)[0], self.roots[0].outcome))

    def _judged(self, fits: Iterable[Outcome | None]) -> list[JudgedEquations]:
        """Return fits with their errors on left-out stretches, without those that ran away or are something else."""
        each = (judge(self.bench, one, self.roots[0].own) for one in fits if one is not None)
        return [one for one in each if one is not None]


def _select(bench: Bench, fits: Sequence[Outcome], own: int) -> list[Outcome]:
    """Return the fits to judge: of each hypothesis the best, and the effect that its last one comes down to."""
    if not fits:
        return []
    noise, limits = noise_of(bench, min(fits, key=lambda one: one.rss)), bench.limits

    def charged(one: Outcome) -> float:
        odds = sum(np.log(odds_of(e)) for e in one.effects[own:])
        return quick_score(one, noise) - 2.0 * limits.temperature * float(odds)

    once = {frozenset(map(key_of, one.effects)): one for one in sorted(fits, key=charged, reverse=True)}
    few = sorted(once.values(), key=charged)[: limits.tried]
    plain = [_fit_plainer(bench, one) for one in few[: limits.leading]]
    return [one for one in few if not is_plainer(one.effects[-1])] + [one for one in plain if one is not None]


def _fit_plainer(bench: Bench, one: Outcome) -> Outcome | None:
    """Return a fit with its last effect in its plainer form; nothing where it has none."""
    less = plainer(one.effects[-1])
    if less is None:
        return None
    first = attempt(bench, (*one.effects[:-1], less), one, FIRST)
    return first and (attempt(bench, first.effects, first, LAST) or first)


def _fit_to_end(bench: Bench, one: JudgedEquations, retuned: Outcome) -> list[Outcome]:
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
    return [select_minimum(bench, sweep_levels(bench, best), one.rows, variance_ratio(best, noise_of(bench, best)))]


def _fit_larger(
    bench: Bench, base: Outcome, without: Collection[str], progress: Progress, *, further: bool
) -> list[Outcome]:
    """Return fits with one more effect, sought on a part of the rows where there are many, fitted to all of them."""
    limits = bench.limits
    part = bench.part(base, limits.equation_rows)
    if part is None:
        return _fit_at_scales(bench, base, without, progress, further=further)
    small, there = part
    found = _fit_at_scales(small, there, without, progress, further=further)
    found.sort(key=lambda one: quick_score(one, noise_of(small, there)))
    once = {(*key_of(one.effects[-1]), len(one.effects)): one for one in reversed(found)}
    carried: list[Outcome] = []
    for one in sorted(once.values(), key=found.index)[: limits.leading]:
        if np.log(there.rss / one.rss) < limits.majority * np.log(there.rss / found[0].rss):
            continue
        progress(f"fitting {one.effects[-1].name} to all rows", 0.0)
        fits: list[Outcome | None] = []
        with suppress(InputError):
            fits.append(bench.carried(one, LAST if carried else 2 * LAST))
        if is_usual(one.effects[-1]):  # with start states that hold without it
            fits.append(attempt(bench, one.effects, base, LAST))
        best = least(fits)
        carried += [] if best is None else [_fit_elsewhere(bench, best)]
    return [*carried, *_fit_usual(bench, base, carried, without)]


def _fit_usual(bench: Bench, base: Outcome, found: Sequence[Outcome], without: Collection[str]) -> list[Outcome]:
    """Return fits to all rows with the usual effects that a part did not lead to, where more than noise is left.

    A part where a rig's own error is largest may say nothing of them.
    """
    if _is_near_noise(bench, min([base, *found], key=lambda one: one.rss)):
        return []
    have = {key_of(one.effects[-1]) for one in found}
    usual = [e for _, e in screen_effects(bench, base, without, quiet, is_usual) if key_of(e) not in have]
    fits = (attempt(bench, (*base.effects, effect), base, LAST) for effect in usual)
    return [_fit_elsewhere(bench, one) for one in fits if one is not None]


def _fit_elsewhere(bench: Bench, one: Outcome) -> Outcome:
    """Return a fit from wherever it ends best, where a usual effect makes many minima and more than noise is left."""
    if not is_usual(one.effects[-1]) or _is_near_noise(bench, one):
        return one
    return least(sweep_levels(bench, one)) or one


def _is_near_noise(bench: Bench, one: Outcome) -> bool:
    return is_noise(bench, one, bench.limits.clearly_more)


def _fit_at_scales(
    bench: Bench, base: Outcome, without: Collection[str], progress: Progress, *, further: bool
) -> list[Outcome]:
    """Look at every effect at every place, and fit the best: on long windows, and from short ones where those fail."""
    limits = bench.limits
    beside = further and not _is_near_noise(bench, base)
    found = _fit_best(bench, base, without, progress, limits.tried, beside)
    best = min(found, key=lambda one: one.rss, default=base)
    short = None if _is_near_noise(bench, best) else bench.shortened(base)
    if short is not None:
        # the base itself goes on as well: its effects may have been fitted in a wrong minimum
        again = [short] if further else []
        found += _lengthen(bench, [*again, *_fit_best(bench, short, without, progress, limits.tried, beside)])
    found.sort(key=lambda one: one.rss)
    for k, one in enumerate(found[:2]):
        if is_settled(bench, one, found[0]):
            break
        progress(f"fitting {one.effects[-1].name}", 0.0)
        found[k] = _fit_on(bench, one, LAST)
    return [one for one in found if not bench.is_stand_in(one)]


def _fit_on(bench: Bench, one: Outcome, iterations: int) -> Outcome:
    """Return a fit with more iterations, as it was where they lead to nothing better."""
    better = attempt(bench, one.effects, one, iterations)
    return better if better is not None and better.rss < one.rss else one


def _fit_best(
    bench: Bench, base: Outcome, without: Collection[str], progress: Progress, count: int, usual: bool
) -> list[Outcome]:
    """Return fits of a base with each of the effects that predict most, and with usual ones that predict anything.

    Beside a large effect whose own numbers are not right yet, what these leave looks like more than the next effect.
    They are fitted for a few steps, and further where they are not far behind one that leaves noise. Effects that come
    down to a plainer one come after it, and only where that leaves more than noise.
    """
    order = screen_effects(bench, base, without, progress)
    tried = [e for k, (_, e) in enumerate(order) if k < count or (usual and is_usual(e))]
    found: list[Outcome] = []
    for effect in sorted(tried, key=lambda one: plainer(one) is not None):
        less = plainer(effect)
        if less is not None and any(
            key_of(one.effects[-1]) == key_of(less) and is_noise(bench, one, bench.limits.adequate) for one in found
        ):
            continue
        progress(f"fitting {effect.name}", 0.0)
        outer = bench.is_sought_outside(effect)
        one = attempt(bench, (*base.effects, effect), base, FIRST if outer else LOOK)
        if one is None:
            continue
        best = min(found, key=lambda other: other.rss, default=one)
        if not outer and not is_settled(bench, one, best):
            one = _fit_on(bench, one, FIRST)
        found.append(_fit_elsewhere(bench, one))
    return found


def _lengthen(bench: Bench, fits: Sequence[Outcome]) -> list[Outcome]:
    """Return the best fits to short windows carried on to long ones, and those with usual effects beside others."""
    found: list[Outcome] = []
    order = sorted(fits, key=lambda one: one.rss)
    usual = (one for one in order[CARRIED:] if len(one.effects) > 1 and is_usual(one.effects[-1]))
    for one in (*order[:CARRIED], *usual):
        if found and is_settled(bench, one, order[0]) and is_noise(bench, found[0], bench.limits.white):
            continue
        with suppress(InputError):
            found.append(bench.lengthened(one))
    return found
