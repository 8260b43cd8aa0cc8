"""Constants of the diagnosis's judgement, fitted on concealed cases that are none of the proof's.

``python -m tests.benchmarks calibrate`` diagnoses AUTOTUNE_CALIBRATE_CASES cases (4; a fit worth its name takes 100)
from seed AUTOTUNE_CALIBRATE_SEED (5000) on, in the folder AUTOTUNE_CALIBRATE_OUT or a temporary one. What a case
showed is kept there, so that an interrupted run continues and a longer one adds to it.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from autotune.diagnosis import judgement
from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.retuning import BLOCKS, misfit, whiteness
from autotune.diagnosis.search import score
from autotune.models import read_model
from autotune.recording import read_recording
from sim.proof import FIRST_PROOF_SEED, Campaign, conceal

Json = dict[str, Any]
TEMPERATURES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0)
DOUBTS = (0.005, 0.01, 0.02, 0.03, 0.05, 0.1)


def shown(campaign: Campaign, seed: int) -> Json:
    """Diagnose one case; scores, misfit and the like with the sealed answer beside them."""
    kept = campaign.out / "shown" / f"case_{seed:06d}.json"
    if kept.exists():
        return dict(json.loads(kept.read_text(encoding="utf-8")))
    case, answer = campaign.case(seed), json.loads(campaign.answer(seed).read_text(encoding="utf-8"))
    recordings = [read_recording(case / f"{name}.csv") for name in ("rec1", "rec2")]
    said = diagnose(read_model(case / "model.toml"), recordings)
    found = said.search
    fit = found.chosen.fit
    pool = (found.retuned, *found.singles, *found.pairs, *found.triples)
    row = {
        "kind": answer["kind"],
        "accept": [e["accept"] for e in answer["effects"]],
        "scores": [["+".join(h.names) or "none", score(h)] for h in pool],
        "excess": max(1.0, fit.chi2 / fit.rows),
        "chosen": list(found.chosen.names),
        "adequate": judgement.is_adequate(fit, found.data),
        "misfit": misfit(fit, found.data) - math.sqrt(2.0 / fit.rows),
        "slow": whiteness(fit, found.data) - 2.0 * math.sqrt(2.0 / (BLOCKS * len(fit.windows))),
        "far": said.fit.retuned**2 / max(said.fit.noise_floor, 1e-12) ** 2,
        "verdict": said.verdict,
    }
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(row), encoding="utf-8")
    return row


def complete(row: Json, names: Sequence[str]) -> bool:
    """Whether names are all the effects of a case and none besides."""
    accept = [set(group) for group in row["accept"]]
    return all(any(n in group for group in accept) for n in names) and all(group & set(names) for group in accept)


def true(row: Json, names: Sequence[str]) -> bool:
    """Whether names are effects of a case: what the samples alone show is no part of a hypothesis."""
    return all(any(n in group for group in row["accept"]) for n in names if n != "none")


def loss(rows: Sequence[Json], temperature: float, doubt: float) -> float:
    """Return the mean log loss of the best hypothesis's probability over cases that found one adequate."""
    total = 0.0
    for row in rows:
        scores: dict[str, float] = {}
        for name, value in row["scores"]:
            scores[name] = min(scores.get(name, math.inf), value)
        best = judgement.weighed(scores, temperature * row["excess"], doubt)[0]
        p = min(max(best.probability, 1e-6), 0.99)
        total -= math.log(p if true(row, best.name.split("+")) else 1.0 - p)
    return total / max(len(rows), 1)


def main() -> None:
    """Print the constants that fit, beside those in use."""
    count, first = (int(os.environ.get(f"AUTOTUNE_CALIBRATE_{n}", d)) for n, d in (("CASES", "4"), ("SEED", "5000")))
    if first + count > FIRST_PROOF_SEED:
        raise SystemExit(f"seeds from {FIRST_PROOF_SEED} on are the proof's")
    out = Path(os.environ.get("AUTOTUNE_CALIBRATE_OUT", "") or tempfile.mkdtemp(prefix="autotune-calibrate-"))
    campaign = Campaign(out=out, seeds=range(first, first + count), tool=())
    rows = [shown(campaign, seed) for seed in conceal(campaign)]
    whole = [r for r in rows if r["kind"] == "clean" or (r["chosen"] and complete(r, r["chosen"]))]
    other = [r for r in rows if r["chosen"] and not complete(r, r["chosen"])]
    print(f"{count} cases from seed {first}: {len(whole)} explained by the truth, {len(other)} by something else")
    for key, constant in (("misfit", "ADEQUATE"), ("slow", "WHITE")):
        right, wrong = [r[key] for r in whole], [r[key] for r in other]
        bound = float(np.quantile(right, 0.98)) if right else math.nan
        passed = sum(w < bound for w in wrong)
        print(
            f"  {constant:12s} {getattr(judgement, constant):.3f} in use, 98 % of the right are below {bound:.3f}, ",
            end="",
        )
        print(f"as are {passed} of {len(wrong)} wrong")
    far = [r["far"] for r in other if not r["adequate"]]
    if far:
        print(f"  FAR_FROM_NOISE {judgement.FAR_FROM_NOISE:g} in use, wrong and inadequate ones reach {max(far):.2f}")
    named = [r for r in rows if r["adequate"] and r["chosen"]]
    best = min((loss(named, t, d), t, d) for t in TEMPERATURES for d in DOUBTS) if named else (math.nan,) * 3
    used = loss(named, judgement.TEMPERATURE, judgement.UNKNOWN)
    print(f"  TEMPERATURE  {judgement.TEMPERATURE:g} in use, {best[1]:g} fits")
    print(f"  UNKNOWN      {judgement.UNKNOWN:g} in use, {best[2]:g} fits")
    print(f"  log loss {used:.4f} in use, {best[0]:.4f} fitted, over {len(named)} statements")
