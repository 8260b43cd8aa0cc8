"""What a diagnosis says in sentences: verdict, answers, and what speaks against it. Nothing here decides anything."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from autotune.diagnosis.evidence.missing_law import MissingLaw
from autotune.diagnosis.evidence.unseen_run import UnseenRun
from autotune.diagnosis.result import Diagnosis, FoundEffect, NextExperiment
from autotune.diagnosis.selection.probability import Candidate
from autotune.diagnosis.verdict import OFFSET
from autotune.effects import kind_of
from autotune.report.effect_words import clause, in_short, of_candidate
from autotune.report.writing import join_clauses, sentence, unit_of, with_spread

#: Probability from which a statement is called sure, likely, and what is below that a guess.
_SURE, _LIKELY = 0.9, 0.6
#: Share of the bins that may leave a law before that is said against it.
_BINS_OFF = 0.25
#: Difference of two probabilities that a page shows as different.
_APART = 0.01


def verdict_of(found: Diagnosis) -> str:
    """Return the verdict in a sentence, effects in words with their names in brackets."""
    if found.verdict != "effect" or not found.effects:
        return found.sentences[0]
    said = join_clauses([f"{clause(e.name)} ({_name_of(e)}, {e.in_odds})" for e in found.effects])
    rest = "" if found.is_clean else " Something smaller is missing as well: what is left is not noise."
    return f"The model leaves physics out: {said}.{rest}"


def _name_of(effect: FoundEffect) -> str:
    return f"{effect.name} at {effect.at}" if effect.at else effect.name


def places_of(found: Diagnosis) -> tuple[dict[str, list[str]], tuple[str, ...]]:
    """Return what is missing by its place, in a few words each, and the places where it may be as well."""
    named: dict[str, list[str]] = {}
    possible: dict[str, None] = dict.fromkeys(found.places)
    for effect in found.effects:
        place = kind_of(effect.name).place
        named.setdefault(place, []).append(in_short(effect.name))
        possible |= dict.fromkeys(effect.places)
    if found.verdict == "unexplained" and len(found.places) == 1:
        named.setdefault(found.places[0], []).append("cause not known")
    return named, tuple(place for place in possible if place not in named)


def answers(found: Diagnosis) -> tuple[tuple[str, str], ...]:
    """Return what was found, how sure that is, and what to do.

    Parameters
    ----------
    found : Diagnosis
        The result.
    """
    return (("What was found", _finding_text(found)), ("How sure", _sure(found)), ("What to do", _to_do(found)))


def _finding_text(found: Diagnosis) -> str:
    if found.verdict == "unexplained" and not found.places:
        return found.sentences[0]
    if not found.effects:
        return {
            "none": "Nothing: neither the structure nor the numbers need a change.",
            "parameters": "Other numbers, no other structure: they are below, by block.",
        }.get(
            found.verdict,
            f"Something at the {join_clauses(list(found.places))} that no effect of the catalogue describes.",
        )
    said = []
    for effect in found.effects:
        values = [f"{key.replace('_', ' ')} {with_spread(p, 3)}" for key, p in effect.parameters.items()]
        said.append(
            f"{in_short(effect.name).capitalize()}: {', '.join(values)}." if values else sentence(clause(effect.name))
        )
    return " ".join(said)


def _sure(found: Diagnosis) -> str:
    said = [
        f"{' or '.join([in_short(e.name).capitalize(), *map(in_short, e.alike)])}: {_word(p)}"
        f" ({100 * p:.0f} in 100{f', {100 * e.probability:.0f} for the first' if e.alike else ''})."
        for e in found.effects
        for p in [e.together if e.alike else e.probability]
    ]
    if found.verdict == "none":
        p = next((c.probability for c in found.candidates if c.name == "none"), math.nan)
        said += [f"That nothing is missing: {_word(p)} ({100 * p:.0f} in 100)."] if math.isfinite(p) else []
    q = found.fit
    errors = {"nominal": q.nominal, "retuned": q.retuned}
    errors |= {"extended": q.extended} if found.search.has_effects else {}
    steps = ", ".join(f"{name} {_percent(error)}" for name, error in errors.items())
    said.append(f"Error of free runs through rows that were not fitted: {steps} of the spread of y.")
    said.append(f"Noise alone would leave {_percent(q.noise_floor)}.")
    return " ".join(said)


def _word(probability: float) -> str:
    return "sure" if probability >= _SURE else "likely" if probability >= _LIKELY else "a guess"


def _percent(share: float) -> str:
    return (
        f"{100 * share:.2g} %"
        if math.isfinite(share) and share < 1.0
        else f"{100 * share:.0f} %"
        if math.isfinite(share)
        else "without bound"
    )


def _to_do(found: Diagnosis) -> str:
    following = found.next_experiment
    if found.verdict == "unexplained" and not found.places:
        return "Put the columns, or the sign, right and diagnose again."
    first = found.withheld or {
        "none": "Go on with the model as it is.",
        "parameters": "Go on with extended_model.toml, which has the new numbers.",
        "effect": "Go on with extended_model.toml, within the range below.",
    }.get(found.verdict, "Look at the rig where the diagram is lit.")
    if following is None:
        return first
    return f"{first} {next_in_words(following)}"


def next_in_words(following: NextExperiment) -> str:
    """Return what to record next, what for, and what it would show."""
    settings = "; ".join(_setting(key, value) for key, value in following.settings.items())
    return (
        f"To {following.purpose}, record next: {following.kind} ({settings}). "
        f"Expected: {following.expected.rstrip('.')}."
    )


def _plain(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_plain(one) for one in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _setting(key: str, value: object) -> str:
    name, _, unit = key.rpartition("_")
    return (
        f"{name.replace('_', ' ')} {_plain(value)} {unit}"
        if unit in ("s", "hz")
        else f"{key.replace('_', ' ')} {_plain(value)}"
    )


def in_the_model(found: Diagnosis) -> str:
    """Say what the extended model has that is not named, or that what is named is not in it."""
    within = [e.name for e in found.extended_model.effects]
    named = {e.name for e in found.effects}
    more = [name for name in within if name not in named]
    if not within:
        if named == {OFFSET}:
            return "The retuned model has it as another operating point of its input."
        if found.effects:
            return (
                "The extended model has none of it: it lasts for this recording alone, or a simulation cannot have it."
            )
        return ""
    if not more:
        return ""
    said = join_clauses([f"{clause(name)} ({name})" for name in more])
    return (
        f"The extended model has, beyond what is named: {said}. It stands there because it predicts unseen rows "
        "better, or was in the given model; it is not a finding."
    )


def objections(found: Diagnosis, run: UnseenRun | None, laws: Sequence[MissingLaw]) -> tuple[str, ...]:
    """Return what a sceptic would hold against the finding: rivals, what was not excited, what remains unexplained.

    Parameters
    ----------
    found : Diagnosis
        The result.
    run : UnseenRun or None
        A free run through what was not fitted.
    laws : sequence of MissingLaw
        What is missing over the signals it goes with.
    """
    said = [*_rivals(found), *_unseen(run), *_bins(laws)]
    said += _ranges(found)
    for effect in found.effects:
        said += _of_effect(effect)
    if len(found.search.recordings) == 1:
        said.append("There is one recording: what is the rig's and what is that day's cannot be told apart.")
    if not found.is_clean:
        q = found.fit
        said.append(
            f"What is left is more than noise: {_percent(q.extended)} of the spread of y on held-out stretches, where "
            f"the noise alone has {_percent(q.noise_floor)}."
        )
    return tuple(said)


def _ranges(found: Diagnosis) -> list[str]:
    """Return between which values the effects were seen, each range once."""
    seen: dict[tuple[str, float, float, str], list[str]] = {}
    for effect in found.effects:
        r = effect.operating_range
        if r is not None:
            seen.setdefault((r.signal, r.low, r.high, r.unit), []).append(in_short(effect.name))
    from_rest = {"plant input": " from the operating point", "position": " from the operating point"}
    return [
        f"{join_clauses(names).capitalize()}: seen for {signal}{from_rest.get(signal, '')} "
        f"between {low:.4g} and {high:.4g}{unit_of(unit)}; beyond that nothing was excited."
        for (signal, low, high, unit), names in seen.items()
    ]


def _rivals(found: Diagnosis) -> list[str]:
    own = {e.name for e in found.effects}
    rivals = [c for c in found.candidates if not own & set(c.name.split("+")) and c.name != "none"]
    if found.verdict in ("none", "parameters"):
        rivals = [c for c in found.candidates if c.name != "none"]
    if not rivals or rivals[0].probability < 0.01:
        return ["No rival explanation reaches a probability of 1 in 100."]
    return [f"The likeliest rival: {of_candidate(rivals[0].name)}, probability {rivals[0].probability:.2f}."]


def _unseen(run: UnseenRun | None) -> list[str]:
    if run is None or "extended" not in run.errors:
        return []
    better, before = run.errors["extended"], min(run.errors["retuned"], run.errors["nominal"])
    if better < before:
        return []
    return ["On the unseen stretch that is drawn the extended model is no better than the best one without effects."]


def _bins(laws: Sequence[MissingLaw]) -> list[str]:
    said = []
    for law in laws:
        at = np.concatenate([b.at for b in law.branches])
        off = sum(
            int(
                np.sum(
                    np.abs(b.found - np.interp(b.at, b.x, b.law)) > 1.96 * np.hypot(b.error, np.interp(b.at, b.x, b.sd))
                )
            )
            for b in law.branches
        )
        if at.size and off > _BINS_OFF * at.size:
            said.append(
                f"The data leave the curve of {in_short(law.effect)} in {off} of {at.size} bins: its form is not exact."
            )
    return said


def _of_effect(effect: FoundEffect) -> list[str]:
    kind, said = kind_of(effect.name), []
    if kind.same:
        said.append(f"Command and reading alone cannot tell {effect.name} from {join_clauses(list(kind.same))}.")
    unfelt = [key.replace("_", " ") for key, p in effect.parameters.items() if not math.isfinite(p.sd)]
    if unfelt and kind.is_simulated:
        said.append(f"The recordings do not say how exact {join_clauses(unfelt)} of {in_short(effect.name)} is.")
    return said


def how_they_add_up(effects: Sequence[FoundEffect], candidates: Sequence[Candidate]) -> str:
    """Say how the effects' probabilities go with those of the explanations that have them.

    Parameters
    ----------
    effects : sequence of FoundEffect
        What is named.
    candidates : sequence of Candidate
        Explanations.
    """
    sums = {e.name: sum(c.probability for c in candidates if e.name in c.name.split("+")) for e in effects}
    less = [e.name for e in effects if sums[e.name] > e.probability + _APART]
    adds_up = "An effect's own probability is the sum of those that have it"
    return f"{adds_up}, but for {join_clauses(less)}, of which parts tell less." if less else f"{adds_up}."
