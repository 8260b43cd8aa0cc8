"""Commands: the proof of the diagnosis on recordings in which the effect is concealed."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from autotune.cli import app
from autotune.cli.common import SCHEDULER
from autotune.cli.proof_steps import diagnose_all, print_table, publish
from autotune.cli.prove_recorded import prove_recorded
from autotune.errors import InputError, require_extra
from autotune.whole_files import write_whole

if TYPE_CHECKING:
    from sim.proof import Campaign
    from sim.score import Mark

#: Time under excitation of the experiment that decides a tie [s].
TIE_DURATION_S = 16.0


@app.command()
def prove(
    out: Annotated[Path, typer.Option(help="folder of the campaign; an interrupted one is continued there")],
    cases: Annotated[
        int | None, typer.Option(min=1, help="number of concealed cases [default: 600; three for each recorded rig]")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="seed of the first case; below 100000 is for calibration")] = 100_000,
    ties: Annotated[int, typer.Option(min=0, help="rigs that a first recording leaves open, one experiment each")] = 24,
    workers: Annotated[int, typer.Option(min=1, help="diagnoses at the same time")] = 2,
    without: Annotated[
        str, typer.Option(help="ablation: leave this entry out of the catalogue and try its cases; 'all': each in turn")
    ] = "",
    most: Annotated[int, typer.Option(min=1, help="ablation: most cases of an entry")] = 3,
    scheduler: SCHEDULER = None,
    recordings: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="put the effects into recordings of real rigs: a folder each, with model.toml"
        ),
    ] = None,
) -> None:
    """Conceal effects in recordings, diagnose them as a user would, reveal the answers and count.

    Without --recordings the recordings are simulated.
    """
    require_extra("batch", "distributed")
    from autotune.effects import KINDS, unknown

    if without not in ("", "all", *KINDS):
        raise unknown(without, "--without")
    if without and recordings is not None:
        raise InputError("--without and --recordings", where="prove", remedy="give one of the two")
    if scheduler is not None:
        from autotune.batch.engine import require_scheduler

        require_scheduler(scheduler)  # cases take minutes to make
        out = out.absolute()  # its workers were started elsewhere
    if recordings is None:
        _prove_simulated(out, range(seed, seed + (cases or 600)), ties, workers, (without, most), scheduler)
        return
    prove_recorded(recordings, out, cases, seed, workers, scheduler)


def _prove_simulated(
    out: Path, seeds: range, ties: int, workers: int, ablation: tuple[str, int], scheduler: str | None
) -> None:
    """Prove on simulated recordings; ``ablation`` is the entry left out and the most cases of it."""
    from rich.progress import track

    from autotune.report.proof_page import confusion_table, figures_table
    from sim.proof import Campaign, conceal, keep_failures, mark_all, seal
    from sim.score import confusion, resolved, table

    campaign = Campaign(out=out, seeds=seeds, tool=(sys.executable, "-m", "autotune.cli"))
    console = Console(highlight=False)
    for _ in track(conceal(campaign), "making cases", total=len(seeds), console=console):
        pass
    digest = seal(campaign)
    publish(out / "seal.txt", digest)
    console.print(f"answers sealed, SHA-256 {digest}")
    if ablation[0]:
        _ablate(console, campaign, *ablation, workers, scheduler)
        return
    diagnose_all(console, [(campaign, case) for case in seeds], workers, scheduler)
    tried = [tie_resolved(out / "ties", seeds[0] + i) for i in track(range(ties), "ties", console=console)]
    if seal(campaign) != digest:
        raise InputError(f"{out / 'sealed'}: an answer changed while the cases were diagnosed; start a fresh campaign")
    marks = mark_all(campaign, list(seeds))
    of_ties = resolved([one["resolved"] for one in tried if one["experiment"]])
    figures = [asdict(row) for row in (*table(marks), of_ties)]
    result = {
        "seed": seeds[0],
        "cases": len(seeds),
        "sha256": digest,
        "table": figures,
        "marks": [asdict(m) for m in marks],
        "ties": tried,
    }
    write_whole(out / "proof.json", json.dumps(result, indent=1))
    print_table(console, "Confusion matrix, by rows", confusion_table(confusion(marks)))
    print_table(console, "Proof on concealed cases", figures_table(figures))
    failures = keep_failures(campaign, marks)
    _write_page(campaign, result, marks)
    console.print(f"report: {out / 'report.html'}", markup=False)
    console.print(f"answers revealed; {sum(m.failed for m in marks)} of {len(marks)} cases to study in {failures}")


def _write_page(campaign: Campaign, result: dict[str, Any], marks: Sequence[Mark]) -> None:
    """Write one page of the whole proof, and leave pages of single cases only where there is something to study."""
    from autotune.report.page import write_page
    from autotune.report.proof_page import proof_page
    from sim.score import confusion, wilson

    for seed, m in zip(campaign.seeds, marks, strict=True):
        if not m.failed:
            (campaign.diagnosis(seed) / "report.html").unlink(missing_ok=True)
    missed = [asdict(m) for m in marks if m.failed]
    write_page(proof_page(result, missed, confusion(marks), wilson), campaign.out / "report.html")


def tie_resolved(out: Path, seed: int) -> dict[str, Any]:
    """Give a rig that a gentle recording leaves open one round of ``investigate``.

    Parameters
    ----------
    out : Path
        Folder of all ties; what one of them gave is kept there and not computed again.
    seed : int
        Of the tie, see :mod:`sim.ties`.

    Returns
    -------
    dict
        ``left_out``, ``before`` and ``after`` (best name with its probability), ``experiment``, empty where the first
        recording left nothing open, ``right_before`` and ``resolved``.
    """
    from autotune.config import load_config
    from autotune.model_tables import read_model
    from autotune.pipeline.investigation import Budget, investigate
    from autotune.recording import read_recording
    from drivers.simulated import SimulatedRig
    from sim.ties import draw, write

    folder = out / f"tie_{seed:06d}"
    kept = folder / "tie.json"
    if kept.exists():
        return dict(json.loads(kept.read_text(encoding="utf-8")))
    shutil.rmtree(folder, ignore_errors=True)  # what an interrupted one has left
    tie = draw(seed)
    write(tie, folder)
    known = investigate(
        SimulatedRig(tie.rig(), u_safe=0.0), load_config(folder / "config.toml"), read_model(folder / "model.toml"),
        [read_recording(folder / "first.csv")], folder, budget=Budget(rounds=1, duration_s=TIE_DURATION_S),
    )  # fmt: skip
    (old, p), one = known.before[0], known.rounds[0] if known.rounds else None
    new, q = one.candidates[0] if one is not None else (old, p)
    answer = {
        "left_out": tie.left_out,
        "before": f"{old} {p:.2f}",
        "experiment": "" if one is None else f"{one.plan.excitation.kind} on the {one.plan.excitation.on}",
        "after": f"{new} {q:.2f}",
        "right_before": bool(tie.names & set(old.split("+"))),
        "resolved": bool(tie.names & set(new.split("+"))),
    }
    write_whole(kept, json.dumps(answer))
    return answer


def _ablate(console: Console, campaign: Campaign, without: str, most: int, workers: int, scheduler: str | None) -> None:
    """Leave entries out of the catalogue in turn and try the singles that conceal them, one of each entry at a time.

    What is finished is printed however it ends; the same command goes on where it was stopped.
    """
    from sim.proof import mark_all, singles

    found = singles(campaign)
    if without != "all" and without not in found:
        raise InputError(f"no case of this campaign conceals {without}: ask for more cases")
    chosen = {name: found[name][:most] for name in sorted(found) if without in ("all", name)}
    tasks = [
        (replace(campaign, without=name), seed)
        for turn in range(most)
        for name, seeds in chosen.items()
        for seed in seeds[turn : turn + 1]
    ]
    try:
        diagnose_all(console, tasks, workers, scheduler)
    finally:
        ablated = {name: replace(campaign, without=name, seeds=seeds) for name, seeds in chosen.items()}
        _print_ablation(console, {name: mark_all(one, one.finished) for name, one in ablated.items()})


def _print_ablation(console: Console, ablated: Mapping[str, Sequence[Mark]]) -> None:
    from sim.score import wilson

    view = Table("left out", "cases", "withdrawn", "place right", "said instead", title="Ablation")
    for column in view.columns:
        column.overflow = "fold"
    for name, marks in ((name, marks) for name, marks in ablated.items() if marks):
        withdrawn, placed = (sum(hits) for hits in ([m.withdrawn for m in marks], [m.place_right for m in marks]))
        said = ", ".join(m.named[0] if m.named else m.verdict for m in marks if not m.withdrawn)
        view.add_row(name, str(len(marks)), str(withdrawn), str(placed), said)
    console.print(view)
    every = [m for marks in ablated.values() for m in marks]
    for what, hits in (
        ("withdrawn (unexplained, or its equivalent named)", [m.withdrawn for m in every]),
        ("at the right place", [m.place_right for m in every]),
    ):
        low, high = wilson(sum(hits), len(hits))
        console.print(f"{what}: {sum(hits)} of {len(hits)} ({100 * low:.0f} to {100 * high:.0f} %)")
    untried = ", ".join(name for name, marks in ablated.items() if not marks)
    if untried:
        console.print(f"not tried yet: {untried}")
