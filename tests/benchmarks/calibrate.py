"""Thresholds of the diagnosis, counted on concealed cases that are none of the proof's.

``python -m tests.benchmarks calibrate`` reads the finished diagnoses of the campaign in AUTOTUNE_CALIBRATE_OUT, as
``autotune prove --seed 7000 --cases 200 --out DIR`` leaves them, whether or not all are finished; without it a campaign
of AUTOTUNE_CALIBRATE_CASES (4) cases from seed AUTOTUNE_CALIBRATE_SEED (5000) on is made in a temporary folder.

It goes over every field of the table, one moved at a time, the others as they are in use. Probabilities are those of
diagnosis.json, at another temperature raised to a power: candidates below 1e-4 are not in it, which counts where the
temperature doubles.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from autotune.diagnosis.evidence.adequacy import ResidualTests
from autotune.diagnosis.evidence.constancy import Variation
from autotune.diagnosis.evidence.held_out import FitQuality, dominates
from autotune.diagnosis.findings import probability_of
from autotune.diagnosis.selection.probability import Candidate
from autotune.diagnosis.thresholds import IN_USE, Thresholds, table
from autotune.diagnosis.verdict import odds_of_unknown
from autotune.effects import ALL
from autotune.models import read_model
from sim.proof import FIRST_PROOF_SEED, Campaign, conceal, diagnose
from sim.score import calibration_error

Json = dict[str, Any]
#: What single rows and the law show: no bound of adequacy decides on these.
OF_ROWS = frozenset(k.name for k in ALL if k.sought in ("samples", "residual", "law")) | {"sensor.saturation"}
#: Factors by which a threshold is moved; of one beside 1, such as a reduced chi-square, what is above 1 is.
FACTORS = (0.0, 0.25, 0.5, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0)


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What one case showed.

    ``names`` are the effects of the extended model, ``left`` what that leaves, as diagnosis.json has it; ``candidates``
    and ``stated`` are names with probabilities.
    """

    kind: str
    accept: Sequence[Sequence[str]]
    nuisance: Sequence[str]
    verdict: str
    names: Sequence[str]
    left: Json
    quality: FitQuality
    candidates: Sequence[tuple[str, float]]
    stated: Sequence[tuple[str, float]]

    @property
    def right(self) -> bool:
        """Whether the extended model has all the effects of the case and none besides."""
        every = all(any(n in group for group in self.accept) for n in self.names)
        return self.kind != "outside" and every and all(set(group) & set(self.names) for group in self.accept)


def shown(campaign: Campaign, seed: int) -> Shown:
    """Read a case's diagnosis beside its answer."""
    folder = campaign.diagnosis(seed)
    answer = json.loads(campaign.answer(seed).read_text(encoding="utf-8"))
    said = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    known = {effect.name for effect in read_model(campaign.case(seed) / "model.toml").effects}
    return Shown(
        kind=answer["kind"],
        accept=[e["accept"] for e in answer["effects"]],
        nuisance=answer["nuisance"],
        verdict=said["verdict"],
        names=[e.name for e in read_model(folder / "extended_model.toml").effects if e.name not in known],
        left=said["residual"],
        quality=FitQuality(**{key: said["fit"][key] for key in ("nominal", "retuned", "extended", "noise_floor")}),
        candidates=[(c["name"], c["probability"]) for c in said["candidates"]],
        stated=[(e["name"], e["probability"]) for e in said["effects"]],
    )


def tests_of(row: Shown, limits: Thresholds) -> ResidualTests:
    """What the extended model left, under other thresholds."""
    varies = Variation(gain=row.left["varies"]["chi2"], places=("plant",), what="", period_s=math.inf)
    numbers = {key: value for key, value in row.left.items() if key != "varies"}
    return ResidualTests(varies=varies, limits=limits, **numbers)


def judged(row: Shown, limits: Thresholds) -> str:
    """Verdict on a case by other thresholds: abstained, named or neither."""
    left = tests_of(row, limits)
    if row.names:
        most = dominates(row.quality, limits) and left.is_lesser
        return "named" if left.is_noise or most else "abstained"
    missing = not left.is_constant or (not left.is_noise and left.is_missing)
    return "abstained" if missing else "neither"


def moved(limits: Thresholds, name: str, factor: float) -> Thresholds:
    """Return the table with one threshold moved."""
    value = getattr(limits, name)
    beside_one = next(unit for one, _, unit, _, _ in table(limits) if one == name) in ("reduced chi2", "slow power")
    new = 1.0 + factor * (value - 1.0) if beside_one else factor * value
    return replace(limits, **{name: type(value)(new)})


def counts(rows: Sequence[Shown], limits: Thresholds) -> tuple[int, int, int]:
    """Count right hypotheses refused, wrong ones accepted, and clean cases in which something is missed."""
    said = [(row, judged(row, limits)) for row in rows]
    return (
        sum(word == "abstained" for row, word in said if row.right and row.names),
        sum(word == "named" for row, word in said if not row.right),
        sum(word != "neither" for row, word in said if row.kind == "clean"),
    )


def at(row: Shown, limits: Thresholds) -> list[tuple[str, float, bool]]:
    """Names put forward with their probabilities at another temperature and other odds, and whether each is right."""
    power = IN_USE.temperature / limits.temperature
    known = {name: p**power for name, p in row.candidates if name != "unknown" and p > 0.0}
    total = sum(known.values()) * (1.0 + unknown_odds(row, limits))
    candidates = [Candidate(name=name, probability=w / total) for name, w in known.items()]
    own = {name for group in row.accept for name in group}
    spared = set(row.nuisance) - own
    return [
        (name, p if name in OF_ROWS or name == "actuator.offset" else probability_of(name, candidates), name in own)
        for name, p in row.stated
        if name not in spared
    ]


def unknown_odds(row: Shown, limits: Thresholds) -> float:
    """Prior odds of what is unknown, see :func:`autotune.diagnosis.verdict.odds_of_unknown`."""
    left = tests_of(row, IN_USE)
    return odds_of_unknown(left, dominates(row.quality, IN_USE) and left.is_lesser, limits)


def calibration(rows: Sequence[Shown], limits: Thresholds) -> tuple[float, float, int, int, int]:
    """Return log loss, expected error, and among statements with p >= 0.95 the wrong ones, all of them, and all."""
    statements = [(p, ok) for row in rows for _, p, ok in at(row, limits)]
    loss = -float(np.mean([math.log(min(max(p if ok else 1.0 - p, 1e-6), 1.0)) for p, ok in statements]))
    sure = [ok for p, ok in statements if p >= 0.95]
    return loss, calibration_error(statements), sure.count(False), len(sure), len(statements)


def campaign_in(folder: str) -> Campaign:
    """Return the campaign of a folder, or make a small one."""
    if folder:
        out = Path(folder)
        seeds = [int(p.stem.removeprefix("case_")) for p in (out / "sealed").glob("case_*.json")]
        if not seeds:
            raise SystemExit(f"{out} holds no campaign: make one with autotune prove --seed 7000 --out {out}")
        campaign = Campaign(out=out, seeds=sorted(seeds), tool=())
    else:
        count, first = (
            int(os.environ.get(f"AUTOTUNE_CALIBRATE_{n}", d)) for n, d in (("CASES", "4"), ("SEED", "5000"))
        )
        out = Path(tempfile.mkdtemp(prefix="autotune-calibrate-"))
        campaign = Campaign(out=out, seeds=range(first, first + count), tool=(sys.executable, "-m", "autotune.cli"))
    if max(campaign.seeds) >= FIRST_PROOF_SEED:
        raise SystemExit(f"seeds from {FIRST_PROOF_SEED} on are the proof's")
    return campaign


def main() -> None:
    """Print for every constant what other values would do."""
    campaign = campaign_in(os.environ.get("AUTOTUNE_CALIBRATE_OUT", ""))
    if campaign.tool:
        for seed in conceal(campaign):
            diagnose(campaign, seed)
    told = [seed for seed in campaign.finished if (campaign.diagnosis(seed) / "diagnosis.json").exists()]
    rows = [shown(campaign, seed) for seed in told]
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(Counter(r.kind for r in rows).items()))
    print(f"{len(rows)} cases diagnosed in {campaign.out}: {kinds}")
    chain = [r for r in rows if not OF_ROWS & {name for name, _ in r.stated if name not in r.nuisance}]
    explained = sum(r.right and bool(r.names) for r in chain)
    print(f"{len(chain)} of them decided by adequacy, {explained} explained by the truth")
    named = [r for r in rows if r not in chain or judged(r, IN_USE) == "named"]
    print("  right refused / wrong accepted / clean alarmed, log loss / expected error / wrong of those at p >= 0.95,")
    print("  one threshold moved at a time, where that changes anything:")
    still = []
    for name, value, unit, _, origin in table(IN_USE):
        tried = {factor: moved(IN_USE, name, factor) for factor in FACTORS}
        told = {f: (counts(chain, limits), calibration(named, limits)[:4]) for f, limits in tried.items()}
        if len(set(told.values())) == 1:
            still.append(name)
            continue
        print(f"  {name} {value:g} {unit} ({origin})")
        for factor, (refused, (loss, error, wrong, sure)) in told.items():
            at_value = getattr(tried[factor], name)
            print(f"    {at_value:8.4g}: {'/'.join(map(str, refused))}  {loss:.4f} / {error:.4f} / {wrong} of {sure}")
    print(f"  not told by diagnosis.json, they act before it is written: {', '.join(still)}")
    single: dict[str, list[bool]] = {}
    for row in named:
        for name, _, ok in at(row, IN_USE):
            single.setdefault(name if name in OF_ROWS else "of the chain", []).append(ok)
    print("  right of those named:", ", ".join(f"{n} {sum(oks)}/{len(oks)}" for n, oks in sorted(single.items())))
    strict = replace(IN_USE, dominant=math.inf)
    half = [r for r in named if r.verdict == "effect" and judged(r, strict) == "abstained"]
    halves = [ok for r in half for name, _, ok in at(r, IN_USE) if name not in OF_ROWS]
    print(f"  right of those named without being adequate: {sum(halves)}/{len(halves)}")
