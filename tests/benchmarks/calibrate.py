"""Constants of the diagnosis's judgement, counted on concealed cases that are none of the proof's.

``python -m tests.benchmarks calibrate`` reads the finished diagnoses of the campaign in AUTOTUNE_CALIBRATE_OUT, as
``autotune prove --seed 7000 --cases 200 --out DIR`` leaves them, whether or not all are finished; without it a campaign
of AUTOTUNE_CALIBRATE_CASES (4) cases from seed AUTOTUNE_CALIBRATE_SEED (5000) on is made in a temporary folder.

One bound of adequacy is tried at a time, the others as they are in use. Probabilities are those of diagnosis.json, at
another temperature raised to a power: candidates below 1e-4 are not in it, which counts where the temperature doubles.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autotune.diagnosis import verdict
from autotune.diagnosis.evidence import adequacy, held_out
from autotune.diagnosis.evidence.adequacy import ResidualTests
from autotune.diagnosis.evidence.constancy import Variation
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.findings import probability_of
from autotune.diagnosis.selection import probability
from autotune.diagnosis.selection.probability import Candidate
from autotune.models import read_model
from sim.proof import FIRST_PROOF_SEED, Campaign, conceal, diagnose
from sim.score import calibration_error

Json = dict[str, Any]
#: What single rows and the law show: no bound of adequacy decides on these.
OF_ROWS = frozenset(
    (
        "sensor.quantisation", "sensor.dropout", "sensor.outliers", "sensor.saturation", "timing.jitter",
        "controller.law",
    )
)  # fmt: skip
GRIDS: Mapping[str, Sequence[float]] = {
    "ADEQUATE": (1.0, 1.01, 1.02, 1.04, 1.06, 1.08, 1.12),
    "ADEQUATE_QUICK": (1.04, 1.06, 1.08, 1.12, 1.16, 1.2, 1.3),
    "QUICK": (0.8, 0.9, 1.0, 1.05, 1.1),
    "WHITE": (0.9, 0.95, 1.0, 1.05, 1.08, 1.1, 1.12, 1.15, 1.2, 1.3),
    "INCONSTANT": (12.0, 15.0, 18.0, 20.0, 25.0, 30.0, 40.0, 60.0),
    "OF_THE_GAINED": (0.0, 0.02, 0.05, 0.1, 0.2, 0.4),
    "HALF_OF_THE_GAINED": (0.1, 0.3, 0.5, 0.8),
    "MISSING": (1.01, 1.02, 1.03, 1.05, 1.08, 1.12),
    "DOMINANT": (0.35, 0.5, 0.7, 0.8, 0.9, 0.95),
    "FAR_FROM_NOISE": (4.0, 6.0, 7.0, 8.0, 10.0, 15.0),
}
TEMPERATURES = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0)
DOUBTS = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2)


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

    @property
    def excess(self) -> float:
        """Variance of what is left over the noise's, less what chance adds."""
        return float(self.left["reduced_chi2"] - self.left["reduced_chi2_chance"])

    @property
    def slow(self) -> float:
        """Slow power of what is left over the noise's, less what chance adds."""
        return float(self.left["slow"] - 2.0 * self.left["slow_chance"])


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


def judged(row: Shown, constants: Mapping[str, float]) -> str:
    """Verdict on a case by other constants: abstained, named or neither."""
    white = row.slow < constants["WHITE"]
    bound = constants["ADEQUATE_QUICK" if row.slow < constants["QUICK"] else "ADEQUATE"]
    varies, gained = row.left["varies"]["chi2"], row.left["gained"]
    constant = varies < max(constants["INCONSTANT"], constants["OF_THE_GAINED"] * gained)
    adequate = white and constant and row.excess < bound
    if row.names:
        most = held_out.dominates(row.quality, constants["DOMINANT"], constants["FAR_FROM_NOISE"])
        lesser = varies < constants["HALF_OF_THE_GAINED"] * gained
        return "named" if adequate or (most and lesser) else "abstained"
    missing = not constant or (not adequate and row.left["reduced_chi2"] > constants["MISSING"])
    return "abstained" if missing else "neither"


def counts(rows: Sequence[Shown], constants: Mapping[str, float]) -> tuple[int, int, int]:
    """Count right hypotheses refused, wrong ones accepted, and clean cases in which something is missed."""
    said = [(row, judged(row, constants)) for row in rows]
    return (
        sum(word == "abstained" for row, word in said if row.right and row.names),
        sum(word == "named" for row, word in said if not row.right),
        sum(word != "neither" for row, word in said if row.kind == "clean"),
    )


def at(row: Shown, temperature: float, unknown: float) -> list[tuple[str, float, bool]]:
    """Names put forward with their probabilities at another temperature and doubt, and whether each is right."""
    power = probability.TEMPERATURE / temperature
    known = {name: p**power for name, p in row.candidates if name != "unknown" and p > 0.0}
    total = sum(known.values()) * (1.0 + doubt(row, unknown))
    candidates = [Candidate(name=name, probability=w / total) for name, w in known.items()]
    own = {name for group in row.accept for name in group}
    spared = set(row.nuisance) - own
    return [
        (name, p if name in OF_ROWS or name == "actuator.offset" else probability_of(name, candidates), name in own)
        for name, p in row.stated
        if name not in spared
    ]


def doubt(row: Shown, unknown: float) -> float:
    """Weight of what is unknown, see :func:`autotune.diagnosis.verdict.Evidence.unknown_odds`."""
    varies = Variation(gain=row.left["varies"]["chi2"], places=("plant",), what="", period_s=math.inf)
    left = ResidualTests(varies=varies, **{key: value for key, value in row.left.items() if key != "varies"})
    if not left.is_noise:
        return verdict.HALF_EXPLAINED if held_out.dominates(row.quality) and left.is_lesser else 1.0
    return unknown + (1.0 - unknown) * (max(left.reduced_chi2 - 1.0, 0.0) / (left.allowed - 1.0)) ** 4


def calibration(rows: Sequence[Shown], temperature: float, unknown: float) -> tuple[float, float, int, int, int]:
    """Return log loss, expected error, and among statements with p >= 0.95 the wrong ones, all of them, and all."""
    statements = [(p, ok) for row in rows for _, p, ok in at(row, temperature, unknown)]
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
    in_use = {
        name: float(next(getattr(m, name) for m in (adequacy, held_out, verdict) if hasattr(m, name))) for name in GRIDS
    }
    explained = sum(r.right and bool(r.names) for r in chain)
    print(f"{len(chain)} of them decided by adequacy, {explained} explained by the truth")
    print("  right refused / wrong accepted / clean alarmed, one constant moved at a time:")
    for name, grid in GRIDS.items():
        moved = " ".join(f"{v:g}: {'/'.join(map(str, counts(chain, {**in_use, name: v})))}" for v in grid)
        print(f"  {name:15s} {in_use[name]:g} in use;  {moved}")
    rows = [r for r in rows if r not in chain or judged(r, in_use) == "named"]
    print("  log loss / expected error / wrong of those at p >= 0.95, of what is named with the bounds in use:")
    T, unknown = probability.TEMPERATURE, verdict.UNKNOWN
    for name, value, tried in (
        ("TEMPERATURE", T, [(t, t, unknown) for t in TEMPERATURES]),
        ("UNKNOWN", unknown, [(d, T, d) for d in DOUBTS]),
    ):
        print(f"  {name:16s} {value:g} in use")
        for at_value, t, d in tried:
            loss, error, wrong, sure, count = calibration(rows, t, d)
            print(f"    {at_value:5g}: {loss:.4f} / {error:.4f} / {wrong} of {sure}, {count} in all")
    single: dict[str, list[bool]] = {}
    for row in rows:
        for name, _, ok in at(row, T, unknown):
            single.setdefault(name if name in OF_ROWS else "of the chain", []).append(ok)
    print("  right of those named:", ", ".join(f"{n} {sum(oks)}/{len(oks)}" for n, oks in sorted(single.items())))
    strict = in_use | {"DOMINANT": math.inf}
    half = [r for r in rows if r.verdict == "effect" and judged(r, strict) == "abstained"]
    halves = [ok for r in half for name, _, ok in at(r, T, unknown) if name not in OF_ROWS]
    print(f"  HALF_EXPLAINED  {verdict.HALF_EXPLAINED:g} in use; right of those named without being adequate:", end=" ")
    print(f"{sum(halves)}/{len(halves)}")
