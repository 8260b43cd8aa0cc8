"""Real recordings whose physics is documented: what is named, how sure, and whether the extended model is nearer.

``python -m tests.benchmarks rigs`` runs the scorers of the recordings beside the checkout over both sets and prints
their last lines with what both give together; RIGS_ONLY names cases, RIGS_KERNEL a linear-algebra kernel (Haswell,
SkylakeX). ``RIGS_STABLE=1`` prints instead how often a diagnosis says the same of a recording that is changed by what
must not matter: its first or last tenth left out, a tenth of its noise added, and what cannot matter at all: units of u
and y, of time, the sign of u together with the plant's, another hour, the recordings' order.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from autotune.diagnosis import diagnose
from autotune.model_tables import read_model
from autotune.models import Model, TransferFunction
from autotune.recording import Recording, read_recording
from tests.conftest import SHARED

SETS = ("real_cases", "real_cases_2")
#: Difference of probabilities that counts as none.
SAME = 0.1


def main() -> None:
    """Print the table of what is asked of the real recordings, or how stable the answers are."""
    only = {name for name in os.environ.get("RIGS_ONLY", "").split(",") if name}
    if os.environ.get("RIGS_STABLE"):
        _stability(only)
        return
    cases: dict[str, Mapping[str, Any]] = {}
    results: list[dict[str, Any]] = []
    for name in SETS:
        answers = json.loads((SHARED / name / "answers.json").read_text(encoding="utf-8"))["cases"]
        mine = {case["id"]: case for case in answers if not only or case["id"] in only}
        if mine:
            cases |= mine
            results += _scored(name, sorted(mine))
    _told(cases, results)


def _scored(name: str, only: list[str]) -> list[dict[str, Any]]:
    """Return what the scorer of one set says of each case, its last lines printed."""
    kernel = os.environ.get("RIGS_KERNEL", "")
    environment = {**os.environ, "OPENBLAS_CORETYPE": kernel} if kernel else dict(os.environ)
    with tempfile.TemporaryDirectory(prefix="autotune-rigs-") as folder:
        out = Path(folder) / "out.json"
        tool = f"{sys.executable} -m autotune"
        call = [
            sys.executable,
            str(SHARED / name / "score.py"),
            "--tool",
            tool,
            "--only",
            ",".join(only),
            "--json",
            str(out),
        ]
        said = subprocess.run(call, check=True, capture_output=True, text=True, env=environment).stdout
        print("\n".join(said.splitlines()[:-2]), f"\n{name}: ", *said.splitlines()[-2:], sep="\n", flush=True)
        return list(json.loads(out.read_text(encoding="utf-8")))


def _told(cases: Mapping[str, Mapping[str, Any]], results: list[dict[str, Any]]) -> None:
    """Print both sets together, and the stated probabilities beside how often they were right."""
    named = [r["answer"] == "yes" for r in results if cases[r["id"]]["accept"]]
    calm = [
        r["answer"] == "yes" and not r["forbidden_claims"] and not r["other_claims"]
        for r in results
        if not cases[r["id"]]["accept"]
    ]
    gaps = [r["gap"] for r in results if r["gap"] is not None]
    worse = [r["id"] for r in results if r["extended"] and r["nominal"] and r["extended"] > 1.05 * r["nominal"]]
    print(
        f"\nTogether: named {sum(named)} of {len(named)}, calm {sum(calm)} of {len(calm)}, gap median "
        f"{statistics.median(gaps) if gaps else float('nan'):.2f}, at least .8 in {sum(g >= 0.8 for g in gaps)} of "
        f"{len(gaps)}, worse than nominal {len(worse)} ({' '.join(worse)}), forbidden "
        f"{sum(len(r['forbidden_claims']) for r in results)}, other {sum(len(r['other_claims']) for r in results)}"
    )
    claims = [
        (p, not set(r["forbidden_claims"] + r["other_claims"]) & {name}) for r in results for name, p, _ in r["claims"]
    ]
    print("| stated | claims | mean | right |\n|---|---|---|---|")
    for low, high in zip(np.arange(0.0, 1.0, 0.2), np.arange(0.2, 1.2, 0.2), strict=False):
        some = [(p, right) for p, right in claims if low <= p < high]
        if some:
            mean, right = np.mean([p for p, _ in some]), np.mean([right for _, right in some])
            print(f"| {low:.1f} to {high:.1f} | {len(some)} | {mean:.2f} | {right:.2f} |")


#: What a change makes of a model and its recordings.
Changed = tuple[Model, list[Recording]]


def _of_rows(change: Callable[[Recording], Recording]) -> Callable[[Model, list[Recording]], Changed]:
    return lambda model, recordings: (model, [change(r) for r in recordings])


def _without_first(r: Recording) -> Recording:
    return r.only(np.arange(len(r) // 10, len(r)))


def _without_last(r: Recording) -> Recording:
    return r.only(np.arange(len(r) - len(r) // 10))


def _noisier(r: Recording) -> Recording:
    size = 0.1 * float(np.nanstd(np.diff(r.y))) / np.sqrt(2.0)
    return replace(r, y=r.y + size * np.random.default_rng(1).normal(size=len(r)))


def _later(r: Recording) -> Recording:
    return replace(r, t=r.t + 1000.0)


def _times(model: Model, place: int, factor: float) -> Model:
    """Return a model with one block's gain times a factor."""
    blocks = list(model.blocks)
    dynamics = blocks[place].dynamics
    num = tuple(factor * c for c in dynamics.num)
    blocks[place] = replace(blocks[place], dynamics=replace(dynamics, num=num))
    return replace(model, blocks=tuple(blocks))


def _with_u(factor: float) -> Callable[[Model, list[Recording]], Changed]:
    def change(model: Model, recordings: list[Recording]) -> Changed:
        model = replace(_times(model, 0, 1.0 / factor), input=replace(model.input, offset=factor * model.input.offset))
        return model, [replace(r, u=factor * r.u) for r in recordings]

    return change


def _with_y(factor: float) -> Callable[[Model, list[Recording]], Changed]:
    def change(model: Model, recordings: list[Recording]) -> Changed:
        model = replace(_times(model, -1, factor), output=replace(model.output, offset=factor * model.output.offset))
        return model, [replace(r, y=factor * r.y) for r in recordings]

    return change


def _slower(model: Model, recordings: list[Recording]) -> Changed:
    """Return everything a thousand times as slow."""

    def slowed(dynamics: TransferFunction) -> TransferFunction:
        num, den = (tuple(c * 1e3 ** (len(p) - 1 - i) for i, c in enumerate(p)) for p in (dynamics.num, dynamics.den))
        return TransferFunction(num=num, den=den, delay_s=1e3 * dynamics.delay_s)

    blocks = tuple(replace(b, dynamics=slowed(b.dynamics)) for b in model.blocks)
    return replace(model, blocks=blocks), [replace(r, t=1e3 * r.t) for r in recordings]


#: What may matter a little, and what cannot.
CHANGES: dict[str, Callable[[Model, list[Recording]], Changed]] = {
    "first tenth left out": _of_rows(_without_first),
    "last tenth left out": _of_rows(_without_last),
    "a tenth of the noise added": _of_rows(_noisier),
    "another hour": _of_rows(_later),
    "other order": lambda model, recordings: (model, recordings[::-1]),
    "u in thousandths": _with_u(1e3),
    "y in thousandths": _with_y(1e3),
    "sign of u": _with_u(-1.0),
    "time in thousandths": _slower,
}


def _stability(only: set[str]) -> None:
    """Print for each change how often names stay, probabilities within a tenth, and how far these move at most."""
    held: dict[str, list[float]] = {name: [0, 0, 0, 0.0] for name in CHANGES}
    for folder in SETS:
        for case in json.loads((SHARED / folder / "answers.json").read_text(encoding="utf-8"))["cases"]:
            if only and case["id"] not in only:
                continue
            place = SHARED / folder / case["id"]
            model = read_model(place / case["model"])
            recordings = [read_recording(place / name) for name in case["fit"]]
            before = _names(model, recordings)
            for change, changed in CHANGES.items():
                if len(recordings) == 1 and change == "other order":
                    continue
                after = _names(*changed(model, recordings))
                moved = max((abs(before.get(n, 0.0) - after.get(n, 0.0)) for n in {*before, *after}), default=0.0)
                same, (count, names, near, most) = set(before) == set(after), held[change]
                held[change] = [count + 1, names + same, near + (same and moved <= SAME), max(most, moved)]
                if moved > SAME:
                    print(f"{case['id']}, {change}: {_said(before)} -> {_said(after)}", flush=True)
    print("| change | cases | same names | probabilities within .1 | moved at most |\n|---|---|---|---|---|")
    for change, (count, names, near, most) in held.items():
        print(f"| {change} | {count} | {names} | {near} | {most:.2g} |")


def _names(model: Model, recordings: list[Recording]) -> dict[str, float]:
    return {e.name: e.probability for e in diagnose(model, recordings).effects}


def _said(names: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {p:.2f}" for name, p in names.items()) or "nothing"
