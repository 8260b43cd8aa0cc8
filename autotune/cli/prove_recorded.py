"""The proof of the diagnosis on recordings of real rigs into which effects are put."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from autotune.cli.proof_steps import diagnose_all, print_table, publish
from autotune.errors import InputError
from autotune.whole_files import write_whole

if TYPE_CHECKING:
    from sim.recorded.campaign import RecordedCampaign, RecordedMark

WHAT = (
    "Effects were put into recordings of real rigs and sealed, then diagnosed as a user would. "
    "What is said of the recordings as they are is taken as given: what is new counts."
)


def prove_recorded(folder: Path, out: Path, cases: int | None, seed: int, workers: int, scheduler: str | None) -> None:
    """Put effects into the recordings of a folder, diagnose both, reveal the answers and count.

    Parameters
    ----------
    folder, out : Path
        Recorded rigs, and the campaign.
    cases, seed : int
        Number of cases, three for each rig where it is None, and the first one's seed.
    workers, scheduler
        Diagnoses at the same time, or a scheduler that has its workers.

    Raises
    ------
    InputError
        No rig can be used; the campaign was begun with others; an answer changed after it was sealed.
    """
    from rich.progress import track

    from sim.proof import seal
    from sim.recorded.campaign import conceal, mark_all, open_campaign
    from sim.recorded.rigs import RefusedError

    try:
        campaign = open_campaign(folder, out, cases, seed, (sys.executable, "-m", "autotune.cli"))
    except RefusedError as why:
        raise InputError(
            str(why),
            where=str(folder),
            remedy="give folders with model.toml and recordings, see docs/concealed_cases.md",
        ) from None
    console = Console(highlight=False)
    for name, reason in campaign.refused.items():
        console.print(f"left out: {name}: {reason}", markup=False)
    seeds = campaign.cases.seeds
    for _ in track(conceal(campaign), "making cases", total=len(seeds), console=console):
        pass
    digest = seal(campaign.cases)
    publish(out / "seal.txt", digest)
    console.print(f"{len(campaign.rigs)} rigs, {len(seeds)} cases, answers sealed, SHA-256 {digest}")
    plain = campaign.as_recorded
    diagnose_all(console, [(plain, i) for i in plain.seeds], workers, scheduler)
    diagnose_all(console, [(campaign.cases, one) for one in seeds], workers, scheduler)
    if seal(campaign.cases) != digest:
        raise InputError(f"{out / 'sealed'}: an answer changed while the cases were diagnosed; start a fresh campaign")
    _reveal(console, campaign, mark_all(campaign), digest)


def _reveal(console: Console, campaign: RecordedCampaign, marks: Sequence[RecordedMark], digest: str) -> None:
    """Print the tables and write ``proof.json``, ``failures.txt`` and the page."""
    from autotune.report.proof_page import confusion_table, figures_table
    from sim.proof import keep_failures
    from sim.recorded.campaign import as_json
    from sim.recorded.score import by_rig, table
    from sim.score import confusion

    figures = [asdict(row) for row in table(marks)]
    counted = [m.mark for m in marks if not m.not_counted]
    result = {
        "seed": campaign.cases.seeds[0],
        "cases": len(counted),
        "sha256": digest,
        "table": figures,
        **as_json(campaign, marks),
    }
    out = campaign.cases.out
    write_whole(out / "proof.json", json.dumps(result, indent=1))
    print_table(console, "Confusion matrix, by rows", confusion_table(confusion(counted)))
    rigs = by_rig(marks)
    for name, count, right, wrong, missed in rigs:
        console.print(f"{name}: {right} of {count} right, {wrong} wrong new names", markup=False)
        for line in missed:
            console.print(f"    {line}", markup=False)
    print_table(console, "Proof on concealed cases", figures_table(figures))
    failures = keep_failures(campaign.cases, counted)
    _write_page(out, result, counted, rigs)
    console.print(f"report: {out / 'report.html'}", markup=False)
    console.print(f"answers revealed; {sum(m.failed for m in counted)} of {len(counted)} cases to study in {failures}")


def _write_page(out: Path, result: dict[str, Any], counted: Sequence[Any], rigs: Sequence[tuple[Any, ...]]) -> None:
    from autotune.report.page import write_page
    from autotune.report.proof_page import proof_page, rigs_sections
    from sim.recorded.effects import NEVER
    from sim.score import confusion, wilson

    before = {
        one["rig"]: ", ".join(f"{name} {p:.2f}" for name, p in one["named"].items()) or one["verdict"]
        for one in result["as_recorded"]
    }
    sections = rigs_sections([(name, before[name], *rest) for name, *rest in rigs], {**result["rigs_refused"], **NEVER})
    missed = [asdict(m) for m in counted if m.failed]
    # the calibration is over the cases that count
    shown = {**result, "marks": [asdict(m) for m in counted]}
    write_page(proof_page(shown, missed, confusion(counted), wilson, WHAT, sections), out / "report.html")
