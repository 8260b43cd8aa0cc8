"""From evidence to a verdict: one table, read from its first row to its last."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from autotune.diagnosis.evidence.adequacy import ResidualTests
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.evidence.operating_point import Offset
from autotune.diagnosis.evidence.own_noise import OwnNoise
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.result import Verdict
from autotune.diagnosis.selection.hypothesis import contradicted
from autotune.diagnosis.selection.judged_chain import Found
from autotune.diagnosis.selection.probability import Candidate, weighed
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
    found : Found, optional
        What a search found, where simulations do not run away and what is left is not noise of some rows.
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
    found: Found | None = None
    evened: bool = False
    own: OwnNoise | None = None

    @property
    def limits(self) -> Thresholds:
        """What decides between two findings."""
        return self.search.data.thresholds

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
        return odds_of_unknown(self.residual, self.limits)

    @cached_property
    def candidates(self) -> tuple[Candidate, ...]:
        """Every hypothesis with its probability, best first."""
        if self.found is not None:
            unknown = self.unknown_odds if self.residual.is_noise else self.limits.unknown_odds
            return self.found.candidates(unknown)
        return weighed({"none": 0.0}, 1.0, self.unknown_odds)

    @property
    def more_than_noise(self) -> bool:
        """Whether something was found, or the retuned model leaves more than noise."""
        return self.found is not None and (bool(self.found.chosen.names) or not self.residual.is_noise)

    @cached_property
    def contradicted(self) -> frozenset[str]:
        """Chosen effects by whose name readings do not behave; asked where the model's error and not noise decides."""
        if self.found is None or self.found.chosen.leaves_noise:
            return frozenset()
        return contradicted(self.search.chosen, self.search.data)

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
        limits, names = self.limits, set(self.search.chosen.names) - STRUCTURES.keys()
        # a clock that jitters disturbs commands too, which leaves something slow: what varies is weighed against it
        jitter = sum(s.evidence for s in self.samples if kind_of(s.name).sought == "residual")
        holds = {
            "follows": self.follows,
            "effects": self.predicts and bool(names - self.contradicted),
            "more than noise": self.more_than_noise,
            "varies more": self.found is not None and self.found.varies_more(limits),
            "late stamps": self.evened,
            "samples": bool(self.samples),
            "adequate": self.residual.is_noise,
            "constant": self.residual.is_constant,
            "offset": self.offset is not None,
            "missing": self.residual.is_missing,
            "jitter explains more": self.residual.varies.gain < limits.lesser_share * jitter,
            "wrong numbers": self.numbers > limits.numbers_decrease,
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


def verdict_of(facts: frozenset[str]) -> Verdict:
    """Return the verdict of the first row of the table that fits."""
    return next(verdict for holds, lacks, verdict in TABLE if holds <= facts and not lacks & facts)
