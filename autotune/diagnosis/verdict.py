"""From evidence to a verdict: one table, read from its first row to its last, for models of every kind.

What recordings show of a model is :class:`Evidence`. Chains and equations differ in how hypotheses are fitted, run and
handed out; each says so in a class of its own, and all that follows asks no further what the model is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self

from autotune.diagnosis.evidence.adequacy import ResidualTests
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.evidence.operating_point import Offset
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.result import FoundEffect, SearchResult, Verdict
from autotune.diagnosis.selection.judged import (
    Judged,
    each_best,
    errors_of,
    of_likely,
    predicts_best,
    probabilities,
    rank,
)
from autotune.diagnosis.selection.probability import Candidate, weighed
from autotune.diagnosis.selection.search import Found
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import KINDS, STRUCTURES, kind_of
from autotune.equations.files import AnyModel
from autotune.errors import InputError
from autotune.identification.answer import only_follows
from autotune.models import Effect
from autotune.recording import Recording

if TYPE_CHECKING:
    from autotune.diagnosis.evidence.description import Description

#: Held-out error, as a share of the spread of y, from which on a simulation follows nothing: 1 is y's mean.
ASTRAY = 0.9
#: What is said where effects were found that follow y whatever the command does, as a slow lag follows any walk.
UNHEEDED = (
    "Nothing is said of what is missing: on rows that were left out, what explains y best errs as much with commands "
    "that stand still there. Record again with commands that move y by more than it moves by itself; if they did, look "
    "whether the columns are u and y of this model."
)
#: What is said where effects were found in a loop that its own noise drives, with a model that is not of its plant.
UNDISTURBED = (
    "Nothing is said of what is missing: u does nothing but follow y, as a controller does that nobody disturbs, and "
    "the model hardly follows y, with or without effects. Look whether the columns are u and y of this model, and "
    "record a set-point or a dither that moves the loop."
)
#: The effect that every fit of a chain has as a free number.
OFFSET = "actuator.offset"


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence(ABC):
    """All that a verdict rests on.

    Attributes
    ----------
    model : Model, EquationModel or BlackBox
        The nominal model.
    free : frozenset of str
        Effects that every fit has as free numbers: they are never searched for.
    samples : tuple of SampleEffect
        What single samples, the residual's size over the slope, and the recomputed law show.
    residual : ResidualTests
        What the chosen model leaves.
    again : callable
        Returns what hypotheses of these recordings show on others, some samples' effects left out.
    found : Found, optional
        What a search found, where simulations do not run away and what is left is not noise of some rows.
    offset : Offset, optional
        Shift of the operating point that is far outside its uncertainty.
    evened : bool
        Whether stamps were late, so that everything runs at even times.
    """

    free: ClassVar[frozenset[str]] = frozenset()
    model: AnyModel
    samples: tuple[SampleEffect, ...]
    residual: ResidualTests
    again: Callable[[Sequence[Recording], Collection[str], Any], Evidence]
    found: Found[Any] | None = None
    offset: Offset | None = None
    evened: bool = False

    @property
    @abstractmethod
    def result(self) -> SearchResult:
        """What the search found, for pages and planning."""

    @property
    def limits(self) -> Thresholds:
        """What decides between two findings."""
        return self.result.limits

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was measured, as it was simulated."""
        return self.result.recordings

    @property
    def names(self) -> tuple[str, ...]:
        """Effects of the hypothesis to go on with."""
        return () if self.found is None else self.found.chosen.names

    @cached_property
    def candidates(self) -> tuple[Candidate, ...]:
        """Every hypothesis with its probability by all rows, best first."""
        if self.found is None:
            return weighed({"none": 0.0}, self.unknown_odds)
        unknown = self.unknown_odds if self.residual.is_noise else self.limits.unknown_odds
        return probabilities(self.found.judged, self.found.best, unknown)

    @property
    def more_than_noise(self) -> bool:
        """Whether something was found, or the retuned model leaves more than noise."""
        return self.found is not None and (bool(self.names) or not self.leaves_noise)

    @property
    def nominal_stands(self) -> bool:
        """Whether nothing was found and the nominal numbers predict about as well as those retuned."""
        share = 1.0 - self.limits.material_numbers
        return not self.names and self.more_than_noise and self.quality.retuned > share * self.quality.nominal

    @property
    @abstractmethod
    def numbers(self) -> float:
        """Decrease of chi-square that retuning brings beside the nominal numbers."""

    @property
    def leading(self) -> tuple[tuple[str, ...], ...]:
        """Effects of the leading hypotheses that have any, the best first."""
        return () if self.found is None or self.own_noise else tuple(one.names for one in self.found.others)

    def keeping(self, names: Collection[str]) -> Self:
        """Return the evidence with no other effects than those named: the hypothesis of them that was fitted."""
        samples = tuple(s for s in self.samples if s.name in names)
        kept = replace(self, samples=samples, offset=self.offset if OFFSET in names else None)
        if self.found is None or self.own_noise:
            return kept
        best = of_likely(self.found.judged, names)
        return kept if best.names == self.found.chosen.names else kept.going_on(best)

    @property
    def errors(self) -> Mapping[frozenset[object], float]:
        """Errors of the hypotheses on left-out stretches, the logarithm of their squares."""
        return {} if self.found is None else errors_of(each_best(self.found.judged))

    def predicting(self, parts: Sequence[Mapping[frozenset[object], float]]) -> Self:
        """Return the evidence with the hypothesis to simulate with: its effects, and those that predict beside them.

        Parameters
        ----------
        parts : sequence of mapping of frozenset to float
            Errors of the hypotheses on parts of the recordings; none where no simulation runs.
        """
        if self.found is None or self.own_noise or not self.names:
            return self
        best = predicts_best(self.found.chosen, self.found.judged, parts)
        return self if best is self.found.chosen else self.going_on(best)

    @abstractmethod
    def going_on(self, best: Any) -> Self:
        """Return the evidence with another hypothesis to go on with."""

    def on(self, part: Sequence[Recording]) -> tuple[Evidence | None, Collection[str]]:
        """Return what a part of the recordings shows: the hypotheses of all of them, fitted and judged there.

        Beside it stand effects that the part cannot tell; nothing where no simulation runs there.
        """
        seen = {s.name for s in self.samples} | self.free
        best = None if self.found is None else self.found.chosen
        known = [] if self.found is None else each_best([one for one in self.found.judged if one.names])
        untold = self.untold(part)
        try:
            there = self.again(part, [name for name in KINDS if name not in seen], known)
            if best is not None and there.found is not None:
                asked = ((there.found.without(effect.name, best.names), effect) for effect in best.added)
                untold = untold.union(*(others.unfelt([effect]) for others, effect in asked))
        except InputError:  # nothing runs there
            return None, ()
        return there, untold

    def untold(self, part: Sequence[Recording]) -> frozenset[str]:
        """Return the effects that are not told from others on a part of the recordings, whatever they do there."""
        return frozenset()

    @abstractmethod
    def described(self) -> list[tuple[float, FoundEffect]]:
        """Return the effects to go on with as people read them, each with what is lost without it."""

    @abstractmethod
    def misread_columns(self) -> str:
        """Say what is wrong with the columns, where the model then explains the recordings; else nothing."""

    def unheeded_commands(self) -> str:
        """Say that y is not seen to follow commands, where an offset or effects were found; else nothing.

        What explains y best may follow none. And commands may be nothing but what a controller makes of y: y follows
        them then by that controller's inverse, which effects imitate where the numbers of a model do not reach it. So
        there either the model without effects follows y, or effects leave the smaller part of it.
        """
        if self.found is None or not (self.names or self.offset):
            return ""
        best: Judged = rank(self.found.judged)[0]
        if not best.heeds_commands:
            return UNHEEDED
        fit = self.quality
        told = fit.retuned < ASTRAY or fit.extended < self.limits.majority
        return "" if told or not only_follows(self.recordings) else UNDISTURBED

    @abstractmethod
    def handed_out(self, verdict: Verdict) -> tuple[AnyModel, AnyModel]:
        """Return the model to go on with, which is no danger beside the nominal one, and the one that was wanted."""

    def description(self) -> Description | None:
        """Return what is left as a function of the signals, where no effect explains it and that can be told."""
        return None

    @property
    @abstractmethod
    def quality(self) -> FitQuality:
        """Errors on rows that were not fitted; they may take fits, and are asked for where a verdict is."""

    @property
    def everywhere(self) -> tuple[tuple[int, float, float], ...]:
        """All recordings from their first row to their last."""
        return tuple((i, float(r.t[0]), float(r.t[-1])) for i, r in enumerate(self.recordings))

    def acting(self, effect: Effect) -> tuple[tuple[int, float, float], ...]:
        """Return when an effect acts: everywhere, or in a recording from a time on."""
        kind = kind_of(effect.name)
        if kind.acts_in is None:
            return self.everywhere
        number, after = kind.acts_in({"recording": -1.0, **effect.values})
        pairs = [(i, r) for i, r in enumerate(self.recordings) if number in (-1, i)]
        return tuple((i, float(r.t[0] + after), float(r.t[-1])) for i, r in pairs)

    def places(self, name: str) -> tuple[str, ...]:
        """Return where an effect may sit, and where one like it does that these rows leave open."""
        kind, odds = kind_of(name), (1.0 - self.limits.decided) / self.limits.decided
        own = max((c.probability for c in self.candidates if name in c.name.split("+")), default=1.0)
        open_ = {n for c in self.candidates if c.probability > odds * own for n in c.name.split("+")}
        places = dict.fromkeys(kind.may_sit)
        for other in (*kind.same, *kind.like):
            places |= dict.fromkeys(kind_of(other).may_sit) if other in open_ else {}
        return tuple(places)

    @property
    def leaves_noise(self) -> bool:
        """Whether what the chosen model leaves is noise."""
        return self.residual.is_noise

    @property
    def is_clean(self) -> bool:
        """Whether nothing larger than noise is left, where it was fitted or where it was not."""
        return self.leaves_noise or self.quality.comes_down_to_noise

    @property
    def follows(self) -> bool:
        """Whether the simulation follows y at all: its mean alone errs by the whole spread."""
        return self.quality.extended < ASTRAY

    @property
    def predicts(self) -> bool:
        """Whether the chosen effects leave held-out rows no farther off than the model without them was."""
        return self.quality.extended <= max(self.quality.nominal, self.quality.retuned)

    @property
    def unknown_odds(self) -> float:
        """Prior odds of a cause outside the catalogue, beside 1 of all hypotheses together."""
        return odds_of_unknown(self.residual, self.limits)

    @property
    def varies_more(self) -> bool:
        """Whether what varies beside chosen effects that leave noise explains more than it may where they are true."""
        return False

    @property
    def jitter_explains_more(self) -> bool:
        """Whether a clock that jitters explains more than what varies."""
        return False

    @property
    def contradicted(self) -> frozenset[str]:
        """Chosen effects by whose name readings do not behave."""
        return frozenset()

    @property
    def own_noise(self) -> str:
        """What is said of a residual that is noise of its own colour."""
        return ""

    @property
    def unsaid(self) -> str:
        """What the model does not say of itself, so that some effects were not looked for."""
        return ""

    @cached_property
    def facts(self) -> frozenset[str]:
        """What holds, in the words of the table."""
        holds = {
            "follows": self.follows,
            "effects": self.predicts and bool(set(self.names) - STRUCTURES.keys() - self.contradicted),
            "more than noise": self.more_than_noise,
            "varies more": self.varies_more,
            "late stamps": self.evened,
            "samples": bool(self.samples),
            "adequate": self.leaves_noise,
            "constant": self.residual.is_constant,
            "offset": self.offset is not None,
            "missing": self.residual.is_missing,
            "jitter explains more": self.jitter_explains_more,
            "wrong numbers": self.numbers > self.limits.beyond_chance,
        }
        return frozenset(name for name, one in holds.items() if one)


def odds_of_unknown(residual: ResidualTests, limits: Thresholds) -> float:
    """Return the prior odds of a cause outside the catalogue, beside 1 of all hypotheses together.

    Small where what is left is noise, and the larger the nearer its variance comes to the bound of adequacy; beyond it
    the two weigh the same.
    """
    if not residual.is_noise:
        return 1.0
    excess = min(max(residual.reduced_chi2 - 1.0, 0.0) / (residual.allowed - 1.0), 1.0)
    return limits.unknown_odds + (1.0 - limits.unknown_odds) * excess**4


#: Each row: what must hold, what must not, and the verdict. The first row that fits decides.
TABLE: tuple[tuple[set[str], set[str], Verdict], ...] = (
    ({"effects"}, {"follows"}, "unexplained"),
    ({"effects"}, {"varies more"}, "effect"),
    ({"more than noise", "late stamps"}, set(), "effect"),
    ({"more than noise"}, {"jitter explains more"}, "unexplained"),
    ({"jitter explains more"}, set(), "effect"),
    (set(), {"constant"}, "unexplained"),
    ({"missing"}, {"adequate"}, "unexplained"),
    ({"samples"}, set(), "effect"),
    ({"offset", "adequate", "follows"}, set(), "effect"),
    ({"wrong numbers"}, {"follows"}, "unexplained"),
    ({"wrong numbers"}, set(), "parameters"),
    (set(), set(), "none"),
)


def judged(evidence: Evidence) -> Verdict:
    """Return the verdict on evidence."""
    return verdict_of(evidence.facts)


def verdict_of(facts: Collection[str]) -> Verdict:
    """Return the verdict of the first row of the table that fits."""
    known = set(facts)
    return next(verdict for holds, lacks, verdict in TABLE if holds <= known and not lacks & known)
