"""What is found, for people: effects with probabilities, places, sentences. The same for models of every kind."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from autotune.diagnosis.evidence.description import Description
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.result import FoundEffect, Verdict
from autotune.diagnosis.selection.probability import Candidate, probability_of
from autotune.diagnosis.verdict import Evidence, judged
from autotune.effects import KINDS, STRUCTURES, counted_as, kind_of
from autotune.equations.identifiability import undetermined

#: Rounds in which probabilities of hypotheses are brought to those of the effects, and how near that ends.
ROUNDS, NEAR = 200, 1e-6
#: Probability of a hypothesis that all rows give next to none, and below which one is not listed.
TINY, LEAST = 1e-6, 1e-4


def found_effects(evidence: Evidence, verdict: Verdict) -> tuple[FoundEffect, ...]:
    """Return the effects that are named, the most important first; where none explains all, what samples show alone."""
    samples = [(s.evidence, _of_samples(s, evidence)) for s in evidence.samples]
    if verdict != "effect":
        return tuple(effect for _, effect in samples)
    # what is surer comes first; about as sure ones by how much they explain
    ranked = sorted([*evidence.described(), *samples], key=lambda pair: (-round(pair[1].probability, 1), -pair[0]))
    return tuple(effect for _, effect in ranked)


def said_by(evidence: Evidence) -> dict[str, float]:
    """Return the probabilities of all effects that are in a hypothesis, and of those that samples show."""
    candidates = evidence.candidates
    names = {name for c in candidates for name in c.name.split("+") if name in KINDS}
    names |= {smaller for name in names for smaller in KINDS[name].includes}
    allowed = names - evidence.contradicted - STRUCTURES.keys()
    shown = {s.name: _of_samples(s, evidence).probability for s in evidence.samples}
    if evidence.offset is not None and judged(evidence) == "effect":
        shown |= {e.name: e.probability for _, e in evidence.described() if e.name not in allowed}
    # rows that leave too much open for a verdict still weigh what it may be
    return {name: probability_of(name, candidates) for name in sorted(allowed)} | shown


def _of_samples(s: SampleEffect, evidence: Evidence) -> FoundEffect:
    return FoundEffect(
        name=s.name,
        probability=1.0 / (1.0 + evidence.limits.unknown_odds + math.exp(-0.5 * s.speaks)),
        places=(kind_of(s.name).place,),
        parameters=MappingProxyType(s.parameters),
        equation=s.equation,
        windows=s.windows or evidence.everywhere,
    )


def alike(name: str, said: Mapping[str, float], least: float) -> tuple[str, ...]:
    """Return the effects that do nearly the same as one and are not ruled out.

    Parameters
    ----------
    name : str
        The effect.
    said : mapping of str to float
        Probabilities of all effects, each with its own share of those like it.
    least : float
        Probability below which an effect is ruled out.

    Returns
    -------
    tuple of str
        What command and reading cannot tell apart at all stands there once.
    """
    found: list[str] = []
    for other in kind_of(name).like:
        if said.get(other, 0.0) >= least and not set(found) & set(kind_of(other).same):
            found.append(other)
    return tuple(found)


def consistent(
    candidates: Sequence[Candidate], effects: Mapping[str, float], chosen: Sequence[str]
) -> tuple[Candidate, ...]:
    """Return hypotheses with probabilities that add up to those of the effects: one probability for one thing.

    Parameters
    ----------
    candidates : sequence of Candidate
        Hypotheses by what all rows say; together 1.
    effects : mapping of str to float
        Probabilities of effects, each over all hypotheses that have it.
    chosen : sequence of str
        Effects of the hypothesis to go on with, which may be none of the likeliest ones by all rows.

    Notes
    -----
    Of all distributions with those sums it is the one nearest to the given one (minimum discrimination information,
    Csiszar 1975), found by fitting one sum after the other. Parts of the recordings may ask for sums that no
    distribution over these hypotheses has; the likelier effect's then holds, for it is fitted last.
    """
    # effects in another order are the same hypothesis
    names = {frozenset(c.name.split("+")): c.name for c in reversed(candidates)}
    names = {frozenset({"none"}): "none", frozenset(chosen or ("none",)): "+".join(chosen) or "none"} | names
    weights = dict.fromkeys(names, TINY)
    for c in candidates:
        weights[frozenset(c.name.split("+"))] += c.probability
    having = {name: {h for h in weights if counted_as(name) & h} for name in effects}
    for _ in range(ROUNDS):
        most = 0.0
        for name, p in sorted(effects.items(), key=lambda one: (one[1], one[0])):
            inside = sum(weights[h] for h in having[name])
            outside = sum(weights.values()) - inside
            if inside <= 0.0 or outside <= 0.0:
                continue
            most = max(most, abs(inside - p))
            for h in weights:
                weights[h] *= p / inside if h in having[name] else (1.0 - p) / outside
        if most < NEAR:
            break
    total = sum(weights.values())
    ranked = sorted(weights.items(), key=lambda item: -item[1])
    return tuple(Candidate(name=names[h], probability=w / total) for h, w in ranked if w > LEAST * total)


def places_of(evidence: Evidence, effects: Sequence[FoundEffect], description: Description | None) -> tuple[str, ...]:
    """Return where the mismatch sits: where its effects may, else where what is missing shows."""
    if judged(evidence) != "unexplained":
        return tuple(dict.fromkeys(place for e in effects for place in e.places))
    known: dict[str, None] = {description.place: None} if description is not None and description.terms else {}
    if not evidence.residual.is_constant and description is not None:
        informative = known if description.explained > evidence.limits.majority else {}
        return tuple(dict.fromkeys(evidence.residual.varies.places) | informative)
    places: dict[str, None] = dict(known)
    for names in evidence.leading[:3]:
        for name in names:
            places |= dict.fromkeys(kind_of(name).may_sit)
    return tuple(places) or ("plant",)


def beside(effects: Sequence[FoundEffect], evidence: Evidence) -> str:
    """Return what is said of effects that predict and are not named: readings contradict them, or they are not sure."""
    unnamed = set(evidence.names) - {e.name for e in effects}
    said = {
        "must be something else: readings scatter on where it would hold them still": unnamed & evidence.contradicted,
        "is not sure enough to be called missing": unnamed - evidence.contradicted,
    }
    return "".join(
        f" The extended model predicts with {' and '.join(sorted(names))} as well, which {what}."
        for what, names in said.items()
        if names
    )


def left_open(effects: Sequence[FoundEffect], evidence: Evidence, said: Mapping[str, float]) -> tuple[str, ...]:
    """Return what is said of effects that are not named and that the recordings do not rule out."""
    named = {n for e in effects for n in (*counted_as(e.name) - {*kind_of(e.name).like}, *kind_of(e.name).includes)}
    able = {n: p for n, p in said.items() if n not in named and p >= 1.0 - evidence.limits.decided}
    likeliest = sorted(able, key=lambda name: -able[name])[: evidence.limits.leading]
    told = ", ".join(f"{name} ({able[name]:.2f})" for name in likeliest)
    return (f"Not ruled out, nor agreed on by parts of the recordings: {told}.",) if told else ()


def sentences_of(
    verdict: Verdict,
    effects: Sequence[FoundEffect],
    evidence: Evidence,
    places: Sequence[str],
    said: Mapping[str, float] | None = None,
) -> tuple[str, ...]:
    """Return the finding in words.

    Parameters
    ----------
    verdict, effects, evidence, places
        What was found.
    said : mapping of str to float, optional
        Probabilities of all effects, those that are not named too; what all rows say by default.
    """
    possible = left_open(effects, evidence, said_by(evidence) if said is None else said)
    sentences = [_first(verdict, effects, evidence, places, open_=bool(possible)), *possible]
    if evidence.own_noise:
        sentences.append(evidence.own_noise)
    elif not evidence.residual.is_constant:
        sentences.append(evidence.residual.varies.sentence)
    loose = (one.sentence for one in undetermined(evidence.result.combinations()))
    q = evidence.quality
    return (
        *sentences,
        *(f"{one[0].upper()}{one[1:]}." for one in loose),
        f"Held-out error, as a share of the spread of y: nominal {q.nominal:.3g}, retuned {q.retuned:.3g}, "
        f"extended {q.extended:.3g}, noise {q.noise_floor:.3g}.",
    )


def _first(
    verdict: Verdict, effects: Sequence[FoundEffect], evidence: Evidence, places: Sequence[str], *, open_: bool
) -> str:  # fmt: skip
    match verdict:
        case "none" if not evidence.follows:
            return "Nothing contradicts the simulation, and nothing bears it out: these recordings show noise alone."
        case "none":
            return "The simulation explains the recordings to within noise."
        case "parameters" if evidence.is_clean:
            structure = "The numbers are not right" if open_ else "The structure is right, its numbers are not"
            return f"{structure}: retuned, the simulation explains the recordings."
        case "parameters":
            return (
                "The numbers are not right: retuned, the simulation is nearer to the recordings, but not down to noise."
            )
        case "effect":
            names = " and ".join(f"{e.name}{f' at {e.at}' if e.at else ''} ({e.in_odds})" for e in effects)
            rest = "" if evidence.is_clean else " What is left is not noise: something else is missing as well."
            return f"Physics was left out: {names}.{beside(effects, evidence)}{rest}"
        case _ if not evidence.follows:
            return (
                "The simulation follows nothing of these recordings: on rows that were left out it errs by as much as "
                "y varies. Look whether the columns are u and y of this model, and whether anything but noise moved y."
            )
        case _:
            return (
                f"Something is missing that no candidate explains to within noise; it shows at the {', '.join(places)}."
            )
