"""Which physics is missing: effects added one by one, judged by what they leave. One search for models of every kind.

What is usual in a rig of its kind needs less evidence than what is rare. What is fitted and proposed is a chain's or
that of equations (:class:`Proposals`); the search knows neither.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.selection.judged import Judged, built_on, each_best, rank
from autotune.progress import Progress, quiet

_J = TypeVar("_J", bound=Judged)


class Proposals(ABC, Generic[_J]):
    """A model on its recordings, as a search asks for it: hypotheses that are fitted and judged.

    Attributes
    ----------
    nominal : Judged
        The model with its nominal numbers.
    roots : tuple of Judged
        What effects are added to first: the retuned model, and others beside it.
    """

    nominal: _J
    roots: tuple[_J, ...]

    @abstractmethod
    def larger(self, beam: Sequence[_J], progress: Progress) -> list[_J]:
        """Return hypotheses with one effect more than those of a beam, the most promising ones.

        Parameters
        ----------
        beam, progress
            Hypotheses that effects are added to; told what is being done.
        """

    def beside(self, best: _J) -> Proposals[_J]:
        """Return what proposes beside a hypothesis; a chain does it in units of the residual that this leaves."""
        return self

    def again(self, one: _J) -> _J:
        """Return a hypothesis fitted again, where fits are in units of the residual that the best one leaves."""
        return one

    @abstractmethod
    def refitted(self, some: Sequence[_J]) -> list[_J]:
        """Return hypotheses of other rows fitted to these from their numbers, without those that run away."""

    @abstractmethod
    def smaller(self, some: Sequence[_J], known: Sequence[_J]) -> list[_J]:
        """Return what hypotheses become when one of their effects is left out.

        Parameters
        ----------
        some, known
            Hypotheses of several effects; all that are known, which need not be fitted again.
        """

    @abstractmethod
    def finish_leading(self, found: Sequence[_J]) -> list[_J]:
        """Return the leading hypotheses fitted to the end: a search leaves them before."""

    def settle_numbers(self, best: _J, found: Sequence[_J]) -> _J:
        """Return a hypothesis with the numbers that are handed out, of all fits of it that were found."""
        return best


@dataclass(frozen=True, kw_only=True, eq=False)
class Found(Generic[_J]):
    """What a search found.

    Attributes
    ----------
    nominal, retuned : Judged
        The nominal structure with its own numbers, and with numbers fitted.
    judged : tuple of Judged
        All that were judged, the retuned one first.
    best : Judged
        The one that predicts best, for what it is.
    chosen : Judged
        The one to go on with: the best one, or what is left of it where parts of the recordings do not agree.
    """

    nominal: _J
    retuned: _J
    judged: tuple[_J, ...]
    best: _J
    chosen: _J

    @property
    def others(self) -> tuple[_J, ...]:
        """All hypotheses with effects, first the one that the least speaks against."""
        return tuple(sorted((j for j in self.judged if j.names), key=lambda j: j.behind(self.chosen)))

    def without(self, name: str, names: Sequence[str]) -> _J:
        """Return the hypothesis of the other ones of some effects, the retuned model where there is none.

        What an effect does shows beside the others: a lag of the sensor where a stop makes the motion fast.

        Parameters
        ----------
        name : str
            The effect that is left out.
        names : sequence of str
            All of them.
        """
        others = {*names} - {name}
        able = rank([one for one in self.others if {*one.names} == others])
        return able[0] if able else self.retuned

    def quality(self, noise_floor: float) -> FitQuality:
        """Return errors on rows that were not fitted, beside the noise as a share of the spread of y."""
        nominal, retuned, extended = (one.error for one in (self.nominal, self.retuned, self.chosen))
        return FitQuality(nominal=nominal, retuned=retuned, extended=extended, noise_floor=noise_floor)


def search(proposals: Proposals[_J], progress: Progress = quiet, known: Sequence[_J] | None = None) -> Found[_J]:
    """Search for the physics that is missing, or judge what a search of more rows came to.

    Parameters
    ----------
    proposals : Proposals
        The model on its recordings.
    progress : callable
        Told what is being done and the share done, 0 to 1.
    known : sequence of Judged, optional
        Hypotheses of more rows of these recordings: they are judged, each from the numbers that it had there, and
        nothing is searched.

    Returns
    -------
    Found
        What was judged, and what predicts best.

    Notes
    -----
    Forward search with a beam, then what is not needed is dropped. An effect must be usual in a rig of its kind or the
    evidence outweigh that it is not. Where the model's error decides, it takes away a tenth of the held-out error, and
    stretches agree on it: what is excited in no stretch but one is found with less power.
    """
    if known is not None:
        found = [proposals.roots[0], *proposals.refitted(known)]
        chosen = rank(found)[0]
    else:
        at, found = _grow(proposals, progress)
        found = _prune(at, found)
        found += at.finish_leading(found)
        chosen = at.settle_numbers(rank(found)[0], found)
    retuned = chosen if not chosen.names else rank([one for one in found if not one.names])[0]
    nominal, retuned, chosen = (one.spread_out() for one in (proposals.nominal, retuned, chosen))
    return Found(nominal=nominal, retuned=retuned, judged=tuple(found), best=chosen, chosen=chosen)


def _grow(at: Proposals[_J], progress: Progress) -> tuple[Proposals[_J], list[_J]]:
    """Add effects one by one while one of them makes the free run better; return all that was judged."""
    beam, best = list(at.roots), at.roots[0]
    limits = best.limits
    found = [best]
    for size in range(limits.rig_effects):
        done = 0.1 + 0.8 * size / limits.rig_effects
        progress("effects one by one", done)
        larger = at.larger(beam, lambda what, _, done=done: progress(what, done))
        if not larger:
            break
        found += larger
        ranked = rank((best, *larger))
        leads = ranked[0] is not best
        ranked.remove(best)
        beam = built_on(ranked, limits.followed)
        if leads and ranked[0].is_better(best):
            best = ranked[0]
            at = at.beside(best)
            beam = [at.again(j) for j in beam if j.leaves_noise or not best.leaves_noise]
        elif size > 0:
            break
    return at, found


def _prune(at: Proposals[_J], found: Sequence[_J]) -> list[_J]:
    """Return hypotheses with those that the leading ones become when an effect is left out, and again of these.

    What a search came to, effect by effect, may have one that stood for another, or only led out of a local minimum.
    """
    result, done, limits = list(found), set[int](), found[0].limits
    for _ in range(limits.rig_effects):
        fresh = [one for one in each_best(result)[: limits.leading] if len(one.names) > 1 and id(one) not in done]
        if not fresh:
            break
        done |= {id(one) for one in fresh}
        result += at.smaller(fresh, result)
    return result
