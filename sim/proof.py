"""A campaign of concealed cases: make, seal, let the tool diagnose as a user would, reveal, mark.

The tool is a command line: it is run as a program of its own and sees model and recordings, never an answer.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim.conceal.cases import write
from sim.score import Mark, mark
from sim.whole import write_text

Json = dict[str, Any]
STOPPED = 130  # exit status of a program that the operator stopped


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """Where a campaign lies and what it runs.

    ``tool`` is the command that diagnoses, ``without`` an effect that is left out of its catalogue.
    """

    out: Path
    seeds: Sequence[int]
    tool: tuple[str, ...]
    without: str = ""

    def case(self, seed: int) -> Path:
        """Folder of a case: model and recordings."""
        return self.out / "cases" / f"case_{seed:06d}"

    def answer(self, seed: int) -> Path:
        """Sealed answer of a case."""
        return self.out / "sealed" / f"case_{seed:06d}.json"

    def diagnosis(self, seed: int) -> Path:
        """Folder of the tool's output, apart for each effect that is left out."""
        kind = Path("without", self.without) if self.without else Path("diagnoses")
        return self.out / kind / f"case_{seed:06d}"

    @property
    def finished(self) -> list[int]:
        """Seeds whose cases the tool has had."""
        return [seed for seed in self.seeds if (self.diagnosis(seed) / "finished").exists()]


def conceal(campaign: Campaign) -> Iterator[int]:
    """Make the campaign's cases that do not exist yet; yields each seed when its case lies there."""
    for seed in campaign.seeds:
        if not campaign.answer(seed).exists():
            write(seed, campaign.case(seed), campaign.answer(seed))
        yield seed


def seal(campaign: Campaign) -> str:
    """SHA-256 of all answers in order of their seeds, as hexadecimal digits."""
    digest = hashlib.sha256()
    for seed in campaign.seeds:
        digest.update(campaign.answer(seed).read_bytes())
    return digest.hexdigest()


def singles(campaign: Campaign) -> dict[str, list[int]]:
    """Seeds of the cases that conceal one effect of the catalogue, by its name."""
    found: dict[str, list[int]] = {}
    for seed in campaign.seeds:
        answer = json.loads(campaign.answer(seed).read_text(encoding="utf-8"))
        if answer["kind"] == "single":
            found.setdefault(answer["effects"][0]["name"], []).append(seed)
    return found


def diagnose(campaign: Campaign, seed: int) -> None:
    """Let the tool diagnose one case; one that is diagnosed already stays as it is.

    Parameters
    ----------
    campaign : Campaign
        Its folder and cases.
    seed : int
        Of the case.

    Raises
    ------
    InterruptedError
        Ctrl-C reached the tool; a continued campaign diagnoses the case again.
    """
    out, case = campaign.diagnosis(seed), campaign.case(seed)
    if (out / "finished").exists():
        return
    shutil.rmtree(out, ignore_errors=True)  # what an interrupted one has left: the tool overwrites nothing
    out.mkdir(parents=True)
    records = [str(path) for path in sorted(case.glob("rec*.csv"), key=lambda path: (len(path.name), path.name))]
    words = ["diagnose", "--model", str(case / "model.toml"), *records, "--out", str(out)]
    words += ["--without", campaign.without] if campaign.without else []
    said = _run(campaign, words)
    if said.returncode == 0 and (case / "unseen.csv").exists():
        horizon = f"{json.loads(campaign.answer(seed).read_text(encoding='utf-8'))['horizon']:g}"
        words = ["simulate", "--model", str(out / "extended_model.toml"), str(case / "unseen.csv")]
        said = _run(campaign, [*words, "--horizon", horizon, "--out", str(out / "unseen_sim.csv")])
    if said.returncode in (STOPPED, -signal.SIGINT, -signal.SIGTERM):
        raise InterruptedError(f"the operator stopped the diagnosis of case {seed}")  # it is not finished
    write_text(out / "stderr.txt", said.stderr)
    write_text(out / "finished", f"{said.returncode}\n")


def _run(campaign: Campaign, words: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*campaign.tool, *words], capture_output=True, text=True, check=False)


def mark_all(campaign: Campaign, chosen: Sequence[int]) -> list[Mark]:
    """Reveal the answers and mark the chosen cases; a tool that failed on a case is marked as having said nothing.

    Parameters
    ----------
    campaign : Campaign
        Its folder and cases.
    chosen : sequence of int
        Seeds of the cases.
    """
    return [_mark(campaign, seed) for seed in chosen]


def _mark(campaign: Campaign, seed: int) -> Mark:
    out = campaign.diagnosis(seed)
    answer = json.loads(campaign.answer(seed).read_text(encoding="utf-8"))
    name = out.name
    said = out / "diagnosis.json"
    if not said.exists():
        nothing: Json = {"verdict": "failed", "effects": [], "places": []}
        return mark(name, answer, nothing, math.inf if answer["improvable"] else None)
    diagnosis = json.loads(said.read_text(encoding="utf-8"))
    simulated = out / "unseen_sim.csv"
    error = forecast_nrmse(campaign.case(seed) / "unseen.csv", simulated, answer) if simulated.exists() else math.inf
    return mark(name, answer, diagnosis, error)


def forecast_nrmse(recording: Path, simulated: Path, answer: Json) -> float:
    """Forecast error over the standard deviation of y, on the rows two horizons after the first.

    Parameters
    ----------
    recording : Path
        What was measured.
    simulated : Path
        The forecast.
    answer : mapping
        Of the case; has the horizon [s].
    """
    rows = np.loadtxt(recording, delimiter=",", skiprows=1)
    forecast = np.loadtxt(simulated, delimiter=",", skiprows=1)
    late = rows[:, 0] >= rows[0, 0] + 2.0 * answer["horizon"]
    y = rows[late, 2]
    e = y - np.interp(rows[late, 0], forecast[:, 0], forecast[:, 1])
    return float(np.sqrt(np.mean(e**2)) / np.std(y))


def keep_failures(campaign: Campaign, marks: Sequence[Mark]) -> Path:
    """Write what was concealed and what was said for every failure, one line each, worst kind first.

    Parameters
    ----------
    campaign : Campaign
        Its folder and cases.
    marks : sequence of Mark
        One for each case.
    """
    lines = []
    for m in sorted((m for m in marks if m.failed), key=lambda m: (m.kind, m.true_names, m.case)):
        answer = campaign.out / "sealed" / f"{m.case}.json"
        a = json.loads(answer.read_text(encoding="utf-8"))
        said = ", ".join(f"{n} ({p:.2f})" for n, p in zip(m.named, m.probabilities, strict=True)) or "-"
        gap = "" if m.gap is None else f" gap {m.gap:.2f}"
        truth = " + ".join(m.true_names) or m.kind
        lines.append(
            f"{m.case} {m.rig:12s} {m.strength or m.kind:9s} ratio {a['retuned_train_ratio']:7.3f}  "
            f"{truth}  ->  {m.verdict}: {said}{'' if m.place_right or not a['places'] else ' (wrong place)'}{gap}"
        )
    path = campaign.out / "failures.txt"
    write_text(path, "\n".join(lines) + "\n")
    return path
