"""A campaign on recorded rigs: as they are, and with effects put in; what is new against the first is what counts.

A real recording has causes of its own. What the tool says of the recording as it is, is taken as given: an effect is
found when its name is new in what the tool says of the changed recording.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sim.proof import Campaign, forecast_nrmse
from sim.recorded import cases
from sim.recorded.cases import Ready
from sim.recorded.rigs import RefusedError, find
from sim.score import Mark, mark
from sim.whole import write_text

Json = dict[str, Any]
ALARMS = ("unexplained", "failed")
#: Cases in which the command's operating point alone was moved.
OFFSET_PUT_IN = "numbers: offset"
#: Said where the diagnosis of a case or of the recording as it is ended without a file.
NOTHING: Json = {"verdict": "failed", "effects": [], "places": []}


@dataclass(frozen=True, kw_only=True)
class RecordedCampaign:
    """Cases of recorded rigs, the recordings as they are, and why rigs were left out."""

    cases: Campaign
    as_recorded: Campaign
    rigs: tuple[Ready, ...]
    refused: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class RecordedMark:
    """Mark of a case by what is new, the names that were said of the recording as it is, and why it does not count.

    ``not_counted`` is empty where the case counts.
    """

    mark: Mark
    before: tuple[str, ...]
    not_counted: str


def open_campaign(folder: Path, out: Path, count: int | None, seed: int, tool: tuple[str, ...]) -> RecordedCampaign:
    """Read the rigs and keep what they were beside the campaign.

    Parameters
    ----------
    folder, out
        Recorded rigs, and where the campaign lies.
    count, seed
        Cases, three for each rig by default, and the first one's seed.
    tool
        Command that diagnoses.

    Raises
    ------
    RefusedError
        No rig can be used, or the campaign was begun with others.
    """
    found, refused = find(folder)
    rigs = []
    for rig in found:
        try:
            rigs.append(cases.prepare(rig))
        except RefusedError as why:
            refused[rig.name] = str(why)
    if not rigs:
        reasons = "; ".join(f"{name}: {why}" for name, why in refused.items())
        raise RefusedError(reasons or "no folder with a model.toml and recordings")
    stamps = json.dumps({one.rig.name: one.rig.stamp for one in rigs}, indent=1)
    kept = out / "rigs.json"
    if kept.exists() and kept.read_text(encoding="utf-8") != stamps:
        raise RefusedError(f"the campaign in {out} was begun with other recordings")
    write_text(kept, stamps)
    count = 3 * len(rigs) if count is None else count
    return RecordedCampaign(
        cases=Campaign(out=out, seeds=range(seed, seed + count), tool=tool),
        as_recorded=Campaign(out=out / "as_recorded", seeds=range(len(rigs)), tool=tool),
        rigs=tuple(rigs),
        refused=refused,
    )


def conceal(campaign: RecordedCampaign) -> Iterator[int]:
    """Make what does not exist yet; yields each seed when its case lies there."""
    first, plain = campaign.cases, campaign.as_recorded
    for i in plain.seeds:
        if not plain.answer(i).exists():
            cases.keep_as_recorded(campaign.rigs[i], plain.case(i), plain.answer(i))
    for seed in first.seeds:
        if not first.answer(seed).exists():
            cases.conceal(seed, campaign.rigs, first.case(seed), first.answer(seed))
        yield seed


def mark_all(campaign: RecordedCampaign) -> list[RecordedMark]:
    """Reveal the answers and mark every case by what is new in it."""
    plain = campaign.as_recorded
    before = [_read_answer(plain, i) for i in plain.seeds]
    reached = [_error(plain, i, _answer(plain, i)) for i in plain.seeds]
    out = []
    for seed in campaign.cases.seeds:
        i = seed % len(campaign.rigs)
        spread = _answer(plain, i)["spread"]
        out.append(_mark_case(campaign.cases, seed, before[i], reached[i] * (spread or math.nan)))
    return out


def _answer(campaign: Campaign, seed: int) -> Json:
    return dict(json.loads(campaign.answer(seed).read_text(encoding="utf-8")))


def _read_answer(campaign: Campaign, seed: int) -> Json:
    path = campaign.diagnosis(seed) / "diagnosis.json"
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else NOTHING


def _error(campaign: Campaign, seed: int, answer: Json) -> float:
    simulated = campaign.diagnosis(seed) / "unseen_sim.csv"
    return forecast_nrmse(campaign.case(seed) / "unseen.csv", simulated, answer) if simulated.exists() else math.inf


def _mark_case(campaign: Campaign, seed: int, before: Json, reached: float) -> RecordedMark:
    """Mark a case; ``reached`` is what the tool's model of the recording as it is errs by, in units of y."""
    answer, said = _answer(campaign, seed), _read_answer(campaign, seed)
    own = {name for effect in answer["effects"] for name in effect["accept"]}
    names = tuple(str(effect["name"]) for effect in before["effects"])
    if answer["sub"] == OFFSET_PUT_IN:  # to say so is right, and no effect
        before = {**before, "effects": [*before["effects"], {"name": "actuator.offset"}]}
    not_counted = "already named of the recording as it is" if own & set(names) else ""
    if before["verdict"] == "failed":
        not_counted = "the recording as it is was not diagnosed"
    if answer["improvable"] and math.isfinite(reached):
        errors = answer["nrmse_unseen"]
        errors["noise"] = min(errors["noise"], reached / errors["spread"])
    said = {**said, "places": []}  # places of new names only
    if _new_names(said, before):  # what samples show is named beside something unexplained, too
        said = {**said, "verdict": "effect"}
    elif answer["kind"] == "clean" and not raises_alarm(said, before):
        said = {**said, "verdict": "parameters", "effects": []}
    error = _error(campaign, seed, answer) if answer["improvable"] else None
    marked = mark(
        f"case_{seed:06d}", {**answer, "nuisance": [str(effect["name"]) for effect in before["effects"]]}, said, error
    )
    return RecordedMark(mark=marked, before=names, not_counted=not_counted)


def raises_alarm(said: Json, before: Json) -> bool:
    """Whether something is said of a changed recording that was not said of the recording as it is.

    Parameters
    ----------
    said : mapping
        Of the changed recording.
    before : mapping
        Of the recording as it is.
    """
    worse = said["verdict"] in ALARMS and before["verdict"] not in (*ALARMS, "effect")
    return bool(_new_names(said, before)) or worse or (said["verdict"] == "failed" != before["verdict"])


def _new_names(said: Json, before: Json) -> set[str]:
    """Names of effects that were not said of the recording as it is."""
    return {str(e["name"]) for e in said["effects"]} - {str(e["name"]) for e in before["effects"]}


def as_json(campaign: RecordedCampaign, marks: Sequence[RecordedMark]) -> Json:
    """Return marks, what was said of the recordings as they are, and what was passed over, for ``proof.json``.

    Parameters
    ----------
    campaign : RecordedCampaign
        Its folder and rigs.
    marks : sequence of RecordedMark
        One for each case.
    """
    plain = campaign.as_recorded
    return {
        "marks": [{**asdict(m.mark), "before": m.before, "not_counted": m.not_counted} for m in marks],
        "as_recorded": [
            {"rig": one.rig.name, "closed_loop": one.rig.closed_loop, **_outline(_read_answer(plain, i))}
            for i, one in enumerate(campaign.rigs)
        ],
        "rigs_refused": campaign.refused,
        "passed_over": {
            f"case_{seed:06d} {answer['rig']}": answer["passed_over"]
            for seed, answer in ((seed, _answer(campaign.cases, seed)) for seed in campaign.cases.seeds)
            if answer["passed_over"]
        },
    }


def _outline(said: Json) -> Json:
    return {"verdict": said["verdict"], "named": {e["name"]: e["probability"] for e in said["effects"]}}
