"""Constants of the diagnosis's judgement, counted on concealed cases that are none of the proof's.

``python -m tests.benchmarks calibrate`` reads the finished diagnoses of the campaign in AUTOTUNE_CALIBRATE_OUT, as
``autotune prove --seed 7000 --cases 200 --out DIR`` leaves them, whether or not all are finished; without it a campaign
of AUTOTUNE_CALIBRATE_CASES (4) cases from seed AUTOTUNE_CALIBRATE_SEED (5000) on is made in a temporary folder. What
the extended models leave of the recordings is computed again and kept in the folder's ``shown``.

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
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from autotune.diagnosis import judgement
from autotune.diagnosis.data import Data
from autotune.diagnosis.diagnose import probability_of
from autotune.diagnosis.fitting import Fit, fit
from autotune.diagnosis.noise import noise_from_differences
from autotune.diagnosis.parameters import parametrise
from autotune.diagnosis.result import Candidate, FitQuality
from autotune.diagnosis.retuning import BLOCKS, floored, misfit, whiteness
from autotune.diagnosis.samples import inspect
from autotune.diagnosis.windows import LAGS_PER_WINDOW, slowest_lag_s, window_rows
from autotune.models import read_model
from autotune.recording import read_recording
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
    "MISSING": (1.01, 1.02, 1.03, 1.05, 1.08, 1.12),
    "DOMINANT": (0.35, 0.5, 0.7, 0.8, 0.9, 0.95),
    "FAR_FROM_NOISE": (4.0, 6.0, 7.0, 8.0, 10.0, 15.0),
    "NEARLY_ALL": (0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 1.0),
    "CLEAR_OF_NOISE": (1.2, 1.5, 2.0, 2.5, 3.0),
}
TEMPERATURES = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0)
DOUBTS = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2)


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What one case showed.

    ``names`` are the effects of the extended model; ``excess`` and ``slow`` the residual's variance and slow power over
    the noise's, less what chance adds to them; ``candidates`` and ``stated`` are names with probabilities.
    """

    case: str
    kind: str
    accept: Sequence[Sequence[str]]
    nuisance: Sequence[str]
    verdict: str
    names: Sequence[str]
    misfit: float
    excess: float
    slow: float
    fit: Mapping[str, float]
    candidates: Sequence[tuple[str, float]]
    stated: Sequence[tuple[str, float]]

    @property
    def right(self) -> bool:
        """Whether the extended model has all the effects of the case and none besides."""
        every = all(any(n in group for group in self.accept) for n in self.names)
        return self.kind != "outside" and every and all(set(group) & set(self.names) for group in self.accept)

    @property
    def quality(self) -> FitQuality:
        """Errors on rows that were not fitted."""
        return FitQuality(**{key: self.fit[key] for key in ("nominal", "retuned", "extended", "noise_floor")})


def shown(campaign: Campaign, seed: int) -> Shown:
    """Compute what a case's extended model leaves; what was kept of an earlier time is read."""
    folder, case = campaign.diagnosis(seed), campaign.case(seed)
    kept = campaign.out / "shown" / f"{folder.name}.json"
    if kept.exists():
        return Shown(**json.loads(kept.read_text(encoding="utf-8")))
    answer = json.loads(campaign.answer(seed).read_text(encoding="utf-8"))
    said = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    names, result, data = left_by(case, folder)
    row = Shown(
        case=folder.name,
        kind=answer["kind"],
        accept=[e["accept"] for e in answer["effects"]],
        nuisance=answer["nuisance"],
        verdict=said["verdict"],
        names=names,
        misfit=misfit(result, data),
        excess=misfit(result, data) - math.sqrt(2.0 / result.rows),
        slow=whiteness(result, data) - 2.0 * math.sqrt(2.0 / (BLOCKS * len(result.windows))),
        fit=said["fit"],
        candidates=[(c["name"], c["probability"]) for c in said["candidates"]],
        stated=[(e["name"], e["probability"]) for e in said["effects"]],
    )
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(asdict(row)), encoding="utf-8")
    return row


def left_by(case: Path, diagnosis: Path) -> tuple[list[str], Fit, Data]:
    """Fit the start states of an extended model to a case's recordings, its numbers as they are."""
    recordings = [read_recording(case / f"{name}.csv") for name in ("rec1", "rec2")]
    good = inspect(recordings)[0]
    model, nominal = read_model(diagnosis / "extended_model.toml"), read_model(case / "model.toml")
    windows = [window_rows(r, LAGS_PER_WINDOW * slowest_lag_s(nominal)) for r in recordings]
    data = Data(
        recordings=tuple(recordings),
        good=tuple(good),
        starts=tuple(starts for starts, _ in windows),
        stops=tuple(stops for _, stops in windows),
        noise=floored(noise_from_differences([r.y for r in recordings], good), recordings),
    )
    size = float(np.std(np.concatenate([r.u for r in recordings]))) or 1.0
    p = parametrise(replace(model, effects=()), model.effects, size, recordings[0].sample_time_s)
    none = np.zeros(p.centre.size, dtype=bool)
    result = fit(p, data, free=none, iterations=20)
    data = replace(data, noise=floored(noise_from_differences(result.residuals, good), recordings))
    return [e.name for e in model.effects], fit(p, data, x0=result.x0, free=none, iterations=20), data


def judged(row: Shown, constants: Mapping[str, float]) -> str:
    """Verdict on a case by other constants: abstained, named or neither."""
    white = row.slow < constants["WHITE"]
    bound = constants["ADEQUATE_QUICK" if row.slow < constants["QUICK"] else "ADEQUATE"]
    adequate = white and row.excess < bound
    if row.names:
        names = (("DOMINANT", "FAR_FROM_NOISE"), ("NEARLY_ALL", "CLEAR_OF_NOISE"))
        most = judgement.dominates(row.quality, [(constants[share], constants[far]) for share, far in names])
        return "named" if adequate or most else "abstained"
    return "abstained" if not adequate and row.misfit > constants["MISSING"] else "neither"


def counts(rows: Sequence[Shown], constants: Mapping[str, float]) -> tuple[int, int, int]:
    """Count right hypotheses refused, wrong ones accepted, and clean cases in which something is missed."""
    said = [(row, judged(row, constants)) for row in rows]
    return (
        sum(word == "abstained" for row, word in said if row.right and row.names),
        sum(word == "named" for row, word in said if not row.right),
        sum(word != "neither" for row, word in said if row.kind == "clean"),
    )


def at(row: Shown, temperature: float, doubts: tuple[float, float]) -> list[tuple[str, float, bool]]:
    """Names put forward with their probabilities at another temperature and doubt, and whether each is right.

    ``doubts`` are the least weights of what is unknown beside one effect and beside several.
    """
    power = judgement.TEMPERATURE / temperature
    known = {name: p**power for name, p in row.candidates if name != "unknown" and p > 0.0}
    best = max(known.values())
    weights = {name: w / best for name, w in known.items()} | {"unknown": doubt(row, doubts)}
    total = sum(weights.values())
    candidates = [Candidate(name=name, probability=w / total) for name, w in weights.items()]
    own = {name for group in row.accept for name in group}
    spared = set(row.nuisance) - own
    return [
        (name, p if name in OF_ROWS or name == "actuator.offset" else probability_of(name, candidates), name in own)
        for name, p in row.stated
        if name not in spared
    ]


def doubt(row: Shown, doubts: tuple[float, float]) -> float:
    """Weight of what is unknown, see :func:`autotune.diagnosis.judgement.doubt_of`."""
    bound = judgement.ADEQUATE_QUICK if row.slow < judgement.QUICK else judgement.ADEQUATE
    allowed = bound + row.misfit - row.excess
    if row.slow >= judgement.WHITE or row.misfit >= allowed:
        return judgement.HALF_EXPLAINED if judgement.dominates(row.quality) else 1.0
    least = doubts[len(row.names) > 1]
    return least + (1.0 - least) * (max(row.misfit - 1.0, 0.0) / (allowed - 1.0)) ** 4


def calibration(
    rows: Sequence[Shown], temperature: float, doubts: tuple[float, float]
) -> tuple[float, float, int, int, int]:
    """Return log loss, expected error, and among statements with p >= 0.95 the wrong ones, all of them, and all."""
    statements = [(p, ok) for row in rows for _, p, ok in at(row, temperature, doubts)]
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
    in_use = {name: float(getattr(judgement, name)) for name in GRIDS}
    explained = sum(r.right and bool(r.names) for r in chain)
    print(f"{len(chain)} of them decided by adequacy, {explained} explained by the truth")
    print("  right refused / wrong accepted / clean alarmed, one constant moved at a time:")
    for name, grid in GRIDS.items():
        moved = " ".join(f"{v:g}: {'/'.join(map(str, counts(chain, {**in_use, name: v})))}" for v in grid)
        print(f"  {name:15s} {in_use[name]:g} in use;  {moved}")
    rows = [r for r in rows if r not in chain or judged(r, in_use) == "named"]
    print("  log loss / expected error / wrong of those at p >= 0.95, of what is named with the bounds in use:")
    T, one, more = judgement.TEMPERATURE, judgement.UNKNOWN, judgement.UNKNOWN_TO_PAIRS
    for name, value, tried in (
        ("TEMPERATURE", T, [(t, t, (one, more)) for t in TEMPERATURES]),
        ("UNKNOWN", one, [(d, T, (d, more)) for d in DOUBTS]),
        ("UNKNOWN_TO_PAIRS", more, [(d, T, (one, d)) for d in DOUBTS]),
    ):
        print(f"  {name:16s} {value:g} in use")
        for at_value, t, doubts in tried:
            loss, error, wrong, sure, count = calibration(rows, t, doubts)
            print(f"    {at_value:5g}: {loss:.4f} / {error:.4f} / {wrong} of {sure}, {count} in all")
    single: dict[str, list[bool]] = {}
    for row in rows:
        for name, _, ok in at(row, T, (one, more)):
            single.setdefault(name if name in OF_ROWS else "of the chain", []).append(ok)
    print("  right of those named:", ", ".join(f"{n} {sum(oks)}/{len(oks)}" for n, oks in sorted(single.items())))
    strict = in_use | {"DOMINANT": math.inf, "NEARLY_ALL": math.inf}
    half = [r for r in rows if r.verdict == "effect" and judged(r, strict) == "abstained"]
    halves = [ok for r in half for name, _, ok in at(r, T, (one, more)) if name not in OF_ROWS]
    print(
        f"  HALF_EXPLAINED  {judgement.HALF_EXPLAINED:g} in use; right of those named without being adequate:", end=" "
    )
    print(f"{sum(halves)}/{len(halves)}")
