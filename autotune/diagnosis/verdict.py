"""From evidence to a verdict: one table, read from its first row to its last."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from autotune.diagnosis.evidence.adequacy import ResidualTests
from autotune.diagnosis.evidence.held_out import FitQuality, dominates
from autotune.diagnosis.evidence.operating_point import Offset
from autotune.diagnosis.evidence.own_noise import OwnNoise
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.result import Verdict
from autotune.diagnosis.selection.hypothesis import contradicted, penalised
from autotune.diagnosis.selection.judged import RigSearch
from autotune.diagnosis.selection.parsimony import worth_adding
from autotune.diagnosis.selection.probability import Candidate, candidates_of
from autotune.diagnosis.selection.searched import Search
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import STRUCTURES, kind_of

#: Held-out error, as a share of the spread of y, from which on a simulation follows nothing: 1 is y's mean.
ASTRAY = 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """All that a verdict rests on.

    Attributes
    ----------
    search : Search
        Hypotheses with their fits.
    samples : tuple of SampleEffect
        What single samples, the residual's size over the slope, and the recomputed law show.
    residual : ResidualTests
        What the chosen model leaves.
    quality : FitQuality
        Errors on rows that were not fitted.
    offset : Offset, optional
        Shift of the operating point that is far outside its uncertainty.
    rig : RigSearch, optional
        What stretches that were left out say, where the model's error and not noise decides.
    evened : bool
        Whether stamps were late, so that everything runs at even times.
    own : OwnNoise, optional
        What is left, where it is noise of its own colour.
    """

    search: Search
    samples: tuple[SampleEffect, ...]
    residual: ResidualTests
    quality: FitQuality
    offset: Offset | None
    rig: RigSearch | None = None
    evened: bool = False
    own: OwnNoise | None = None

    @property
    def limits(self) -> Thresholds:
        """What decides between two findings."""
        return self.search.data.thresholds

    @cached_property
    def explains_most(self) -> bool:
        """Whether the chosen effects explain most of a residual that nothing explains whole.

        A load of free timing explains a part of everything: that part is not enough.
        """
        loads = all(kind_of(name).place == "environment" for name in self.search.chosen.names)
        return dominates(self.quality, self.limits) and self.residual.is_lesser and not loads

    @property
    def follows(self) -> bool:
        """Whether the simulation follows y at all: its mean alone errs by the whole spread."""
        return self.quality.extended < ASTRAY

    @property
    def predicts(self) -> bool:
        """Whether the chosen effects leave held-out rows no farther off than the model without them was."""
        return self.quality.extended <= max(self.quality.nominal, self.quality.retuned)

    @cached_property
    def unknown_odds(self) -> float:
        """Prior odds of a cause outside the catalogue, beside 1 of all hypotheses together."""
        return odds_of_unknown(self.residual, self.explains_most, self.limits)

    @cached_property
    def candidates(self) -> tuple[Candidate, ...]:
        """Every hypothesis with its probability, best first."""
        if self.rig is not None:
            return self.rig.candidates(self.limits)
        return candidates_of(self.search, self.unknown_odds)

    @cached_property
    def contradicted(self) -> frozenset[str]:
        """Chosen effects by whose name readings do not behave; asked where the model's error and not noise decides."""
        return frozenset() if self.rig is None else contradicted(self.search.chosen, self.search.data)

    @property
    def numbers(self) -> float:
        """Decrease of chi-square that retuning brings beside the nominal numbers."""
        if self.own is not None:
            return self.own.numbers
        retuned = self.search.retuned.fit
        return self.search.nominal.chi2 - retuned.chi2 - retuned.penalty

    @cached_property
    def facts(self) -> frozenset[str]:
        """What holds, in the words of the table."""
        found = self.search
        best, limits = min(found.all, key=penalised), self.limits
        # a clock that jitters disturbs commands too, which leaves something slow: what varies is weighed against it
        jitter = sum(s.evidence for s in self.samples if kind_of(s.name).sought == "residual")
        holds = {
            "follows": self.follows,
            "effects": self.predicts and bool(set(found.chosen.names) - self.contradicted),
            "rig": self.rig is not None,
            "varies more": self.rig is not None and self.rig.varies_more(limits.varies_more),
            "late stamps": self.evened,
            "samples": bool(self.samples),
            "adequate": self.residual.is_noise or self.explains_most,
            "constant": self.residual.is_constant,
            "another structure": self.own is None
            and bool(STRUCTURES.keys() & set(best.names))
            and worth_adding(found.retuned, best, limits),
            "offset": self.offset is not None,
            "missing": self.residual.is_missing,
            "jitter explains more": self.residual.varies.gain < limits.lesser_share * jitter,
            "wrong numbers": self.numbers > limits.numbers_decrease,
        }
        return frozenset(name for name, one in holds.items() if one)


def odds_of_unknown(residual: ResidualTests, explains_most: bool, limits: Thresholds) -> float:
    """Return the prior odds of a cause outside the catalogue, beside 1 of all hypotheses together.

    Small where what is left is noise, and the larger the nearer its variance comes to the bound of adequacy; beyond it
    the two weigh the same, but for effects that explain most of what retuning leaves.
    """
    if residual.is_noise:
        excess = min(max(residual.reduced_chi2 - 1.0, 0.0) / (residual.allowed - 1.0), 1.0)
        return limits.unknown_odds + (1.0 - limits.unknown_odds) * excess**4
    return limits.half_explained_odds if explains_most else 1.0


#: Each row: what must hold, what must not, and the verdict. The first row that fits decides.
TABLE: tuple[tuple[set[str], set[str], Verdict], ...] = (
    ({"effects"}, {"follows"}, "unexplained"),
    ({"rig", "effects"}, {"varies more"}, "effect"),
    ({"rig", "late stamps"}, set(), "effect"),
    ({"rig"}, {"jitter explains more"}, "unexplained"),
    ({"effects", "adequate"}, set(), "effect"),
    ({"effects"}, set(), "unexplained"),
    ({"another structure"}, set(), "unexplained"),
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


def verdict_of(facts: frozenset[str]) -> Verdict:
    """Return the verdict of the first row of the table that fits."""
    return next(verdict for holds, lacks, verdict in TABLE if holds <= facts and not lacks & facts)
