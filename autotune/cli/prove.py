"""Commands: the proof of the diagnosis on recordings in which the effect is concealed."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import Progress, track
from rich.table import Table

from autotune.cli import app
from autotune.errors import InputError

if TYPE_CHECKING:
    from sim.score import Mark


@app.command()
def prove(
    out: Annotated[Path, typer.Option(help="folder of the campaign; an interrupted one is continued there")],
    cases: Annotated[int, typer.Option(min=1, help="number of concealed cases")] = 600,
    seed: Annotated[int, typer.Option(min=0, help="seed of the first case; below 100000 is for calibration")] = 100_000,
    workers: Annotated[int, typer.Option(min=1, help="diagnoses at the same time")] = 2,
    without: Annotated[str, typer.Option(help="ablation: leave this entry out of the catalogue, try its cases")] = "",
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="existing Dask scheduler, tcp://host:8786, with its workers")
    ] = None,
) -> None:
    """Conceal effects in simulated recordings, diagnose them as a user would, reveal the answers and count."""
    from autotune.batch.engine import cluster, run_all
    from sim.proof import Campaign, conceal, diagnose, keep_failures, mark_all, seal
    from sim.score import table

    tool = (sys.executable, "-m", "autotune.cli")
    extra = ("--without", without) if without else ()
    if scheduler is not None:
        out = out.absolute()  # its workers were started elsewhere
    campaign = Campaign(out=out, seeds=range(seed, seed + cases), tool=tool, extra=extra)
    console = Console(highlight=False)
    for _ in track(conceal(campaign), "making cases", total=cases, console=console):
        pass
    digest = seal(campaign)
    _publish(out / "seal.txt", digest)
    console.print(f"answers sealed, SHA-256 {digest}")
    chosen = _cases_of(campaign.out, campaign.seeds, without)
    if not chosen:
        raise InputError(f"no case of this campaign conceals {without}: ask for more cases")
    # each diagnosis is a program of its own, so a thread of this process is enough to start it
    with cluster(workers, scheduler, processes=False) as client, Progress(console=console) as progress:
        task = progress.add_task("diagnosing", total=len(chosen))
        named = {str(case): case for case in chosen}
        for _, failure in run_all(client, partial(diagnose, campaign), named, retries=0):
            if failure is not None:
                raise failure
            progress.advance(task)
    if seal(campaign) != digest:
        raise InputError(f"{out / 'sealed'}: an answer changed while the cases were diagnosed; start a fresh campaign")
    marks = mark_all(campaign, chosen)
    rows = [asdict(row) for row in table(marks)]
    result = {"seed": seed, "cases": cases, "sha256": digest, "table": rows, "marks": [asdict(m) for m in marks]}
    (out / "proof.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    _print_confusion(console, marks)
    if without:
        _print_ablation(console, marks, without)
    else:
        _print_table(console, marks)
    failures = keep_failures(campaign, marks)
    console.print(f"answers revealed; {sum(m.failed for m in marks)} of {len(marks)} cases to study in {failures}")


def _publish(path: Path, digest: str) -> None:
    """Write the seal before anything is diagnosed; a continued campaign must have the same one."""
    if path.exists() and path.read_text(encoding="utf-8").strip() != digest:
        raise InputError(f"{path}: these answers are not the ones that were sealed; use another --out")
    path.write_text(digest + "\n", encoding="utf-8")


def _cases_of(out: Path, seeds: range, name: str) -> list[int]:
    """Seeds of the cases to try: all, or the singles that conceal one effect."""
    if not name:
        return list(seeds)
    chosen = []
    for seed in seeds:
        answer = json.loads((out / "sealed" / f"case_{seed:06d}.json").read_text(encoding="utf-8"))
        if answer["kind"] == "single" and answer["effects"][0]["name"] == name:
            chosen.append(seed)
    return chosen


def _print_confusion(console: Console, marks: Sequence[Mark]) -> None:
    from sim.score import confusion

    view = Table("concealed", "cases", "right", "said instead", title="Confusion matrix, by rows")
    for name, count, right, said in confusion(marks):
        view.add_row(name, str(count), str(right), ", ".join(f"{word} {times}" for word, times in said))
    console.print(view)


def _print_table(console: Console, marks: Sequence[Mark]) -> None:
    from sim.score import table

    view = Table("figure", "asked", "measured", "95 % interval", "of", "met", title="Proof on concealed cases")
    for row in table(marks):
        share = row.interval is not None
        value = f"{100 * row.value:.1f} %" if share else f"{row.value:.3f}"
        interval = f"{100 * row.interval[0]:.1f} to {100 * row.interval[1]:.1f} %" if row.interval else ""
        met = "" if row.met is None else ("yes" if row.met else "no")
        view.add_row(row.figure, row.asked, value if row.count else "-", interval, str(row.count), met)
    console.print(view)


def _print_ablation(console: Console, marks: Sequence[Mark], name: str) -> None:
    from sim.score import wilson

    for what, hits in (
        ("turned to unexplained", [m.verdict == "unexplained" for m in marks]),
        ("still at the right place", [m.place_right for m in marks]),
    ):
        low, high = wilson(sum(hits), len(hits))
        console.print(f"without {name}: {what} {sum(hits)} of {len(hits)} ({100 * low:.0f} to {100 * high:.0f} %)")
