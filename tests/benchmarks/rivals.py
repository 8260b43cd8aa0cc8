"""Rivals of the diagnosis in one table, on the same concealed and real cases: names, false claims, forecasts, seconds.

``python -m tests.benchmarks rivals`` takes AUTOTUNE_RIVALS_CASES simulated cases of the proof (20) and the cases of
real rigs that lie beside the checkout (or in AUTOTUNE_REAL_CASES; AUTOTUNE_RIVALS_ONLY names some of them, with commas
between). Every answer is kept in AUTOTUNE_RIVALS_OUT, or a temporary folder; an interrupted table goes on there.
PySINDy and scikit-learn come with the extra ``bench``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.selection.hypothesis import hypothesis
from autotune.diagnosis.simulation.forecast import forecast
from autotune.diagnosis.thresholds import IN_USE
from autotune.errors import AutotuneError
from autotune.model_tables import read_model
from autotune.models import Model
from autotune.recording import read_recording
from sim.score import wilson
from tests.benchmarks._rival_cases import Case, concealed, real
from tests.benchmarks._rival_forecasts import gaussian_process, narx, nrmse
from tests.benchmarks._rival_sindy import sindy

#: Names that a rival says, most important first, None where it says none; error on the recording kept back.
Answer = tuple[tuple[str, ...] | None, float]


@dataclass(frozen=True, kw_only=True)
class Said:
    """What a rival said of a case, and how long it took [s]."""

    names: tuple[str, ...] | None
    error: float
    seconds: float


def ours(case: Case, folder: Path) -> Answer:
    """Run the commands as a user would."""
    tool = [sys.executable, "-m", "autotune.cli"]
    out = folder / "ours"
    words = ["diagnose", "--model", str(case.model), *map(str, case.given), "--out", str(out), "--overwrite"]
    if subprocess.run([*tool, *words], capture_output=True, check=False).returncode:
        return (), float("nan")
    said = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    horizon = [] if case.horizon_s is None else ["--horizon", f"{case.horizon_s!r}"]
    errors = []
    for i, path in enumerate(case.kept_back):
        simulated = out / f"kept_back_{i}.csv"
        words = ["simulate", "--model", str(out / "extended_model.toml"), str(path), *horizon, "--out", str(simulated)]
        if subprocess.run([*tool, *words, "--overwrite"], capture_output=True, check=False).returncode:
            return tuple(e["name"] for e in said["effects"]), float("nan")
        r, y = read_recording(path), np.loadtxt(simulated, delimiter=",", skiprows=1)[:, 1]
        errors.append(nrmse(r.t, r.y, y, case.score_from_s))
    return tuple(e["name"] for e in said["effects"]), float(np.mean(errors))


def _of_model(case: Case, model: Model) -> float:
    recordings = [read_recording(path) for path in case.kept_back]
    return float(np.mean([nrmse(r.t, r.y, forecast(model, r, case.horizon_s), case.score_from_s) for r in recordings]))


def retuned(case: Case, folder: Path) -> Answer:
    """Refit the nominal structure; it names nothing."""
    recordings = [read_recording(path) for path in case.given]
    good = [np.isfinite(r.y) for r in recordings]
    _, fit = prepare(read_model(case.model), recordings, good, IN_USE)
    return None, _of_model(case, fit.model)


def criterion(case: Case, folder: Path) -> Answer:
    """Return the single effect with the best Bayesian information criterion, none where the retuned model has it.

    The fits are this project's own; what is left out are left-out stretches, tests of adequacy and calibration.
    """
    recordings = [read_recording(path) for path in case.given]
    found = search_chain(read_model(case.model), recordings, [np.isfinite(r.y) for r in recordings])
    best = min((hypothesis(j.fit) for j in found.judged if len(j.names) < 2), key=lambda h: h.penalised_chi2)
    return best.names, _of_model(case, best.fit.model)


RIVALS: dict[str, Callable[[Case, Path], Answer]] = {
    "this project": ours,
    "retuned linear": retuned,
    "criterion alone": criterion,
    "PySINDy on the residual": lambda case, folder: sindy(case, read_model(case.model)),
    "nonlinear ARX": lambda case, folder: (None, narx(case, read_model(case.model))),
    "Gaussian-process residual": lambda case, folder: (None, gaussian_process(case, read_model(case.model))),
}
#: Packages that a rival needs.
NEEDS = {"PySINDy on the residual": "pysindy", "nonlinear ARX": "sklearn", "Gaussian-process residual": "sklearn"}


def said(name: str, case: Case, out: Path) -> Said:
    """Return what a rival says of a case; what it said before is kept."""
    folder = out / case.name
    kept = folder / f"{name.replace(' ', '_')}.json"
    if kept.exists():
        one: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
        names = None if one["names"] is None else tuple(one["names"])
        return Said(names=names, error=one["error"], seconds=one["seconds"])
    folder.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rivals' own words on their convergence
        try:
            names, error = RIVALS[name](case, folder)
        except (AutotuneError, np.linalg.LinAlgError):
            names, error = (), float("nan")
    answer = Said(names=names, error=error, seconds=time.perf_counter() - begin)
    kept.write_text(json.dumps(answer.__dict__), encoding="utf-8")
    return answer


def share(hits: Sequence[bool]) -> str:
    """Share with its 95 % interval."""
    if not hits:
        return "-"
    low, high = wilson(sum(hits), len(hits))
    return f"{sum(hits)} of {len(hits)} ({100 * low:.0f}-{100 * high:.0f} %)"


def row(name: str, cases: Sequence[Case], answers: Sequence[Said]) -> str:
    """One line of the table: a rival over all cases."""
    both = list(zip(cases, answers, strict=True))
    names = answers[0].names is not None
    right = [bool(a.names) and a.names[0] in c.right for c, a in both if c.conceals and a.names is not None]
    false = [c.false(a.names) for c, a in both if a.names is not None]
    gaps = [c.gap(a.error) for c, a in both if c.linear is not None]
    worse = [not a.error <= 1.02 * c.linear for c, a in both if c.linear is not None]
    cells = [
        name,
        share(right) if names else "names nothing",
        share(false) if names else "",
        f"{np.median(gaps):.2f}" if gaps else "-",
        f"{sum(worse)} of {len(worse)}",
        f"{np.median([a.seconds for a in answers]):.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def print_table(title: str, cases: Sequence[Case], out: Path) -> None:
    """Give every case to every rival and print the table."""
    present = [name for name in RIVALS if name not in NEEDS or find_spec(NEEDS[name])]
    answers: dict[str, list[Said]] = {name: [] for name in present}
    for case in cases:
        for name in present:
            answers[name].append(said(name, case, out))
    gaps = sum(c.linear is not None for c in cases)
    print(
        f"\n{title}: {len(cases)} cases, {sum(c.conceals for c in cases)} with an effect, {gaps} with a gap to close\n"
    )
    print(
        "| | right name first | cases with a false claim | gap closed, median | worse than linear | seconds, median |"
    )
    print("|---|---|---|---|---|---|")
    for name in present:
        print(row(name, cases, answers[name]))
    for name in (name for name in RIVALS if name not in present):
        print(f"not compared: {name}; pip install -e '.[bench]' brings what it needs")


def main() -> None:
    """Print both tables."""
    out = Path(os.environ.get("AUTOTUNE_RIVALS_OUT", "") or tempfile.mkdtemp(prefix="autotune-rivals-"))
    count = int(os.environ.get("AUTOTUNE_RIVALS_CASES", "20"))
    only = {name for name in os.environ.get("AUTOTUNE_RIVALS_ONLY", "").split(",") if name}
    if count:
        print_table("Concealed in simulated recordings", concealed(out / "proof", count), out)
    recorded = [case for case in real() if not only or case.name in only]
    if recorded:
        print_table("Real rigs", recorded, out)
    else:
        print("\nno cases of real rigs: AUTOTUNE_REAL_CASES names their folder, with an answers.json")
