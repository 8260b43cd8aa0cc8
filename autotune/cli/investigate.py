"""``autotune investigate``: experiments on a rig until what its simulation leaves out is told apart."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from autotune.cli import app
from autotune.cli.common import CONFIG, DRY_RUN, WITHOUT, ProgressBar, new_folder, rig_of
from autotune.cli.recordings import R, T, U, Y, read_all, signal_names
from autotune.errors import InputError
from autotune.whole_files import write_whole

if TYPE_CHECKING:
    from autotune.pipeline.investigation import Investigation

ROUNDS = "rounds.json"
#: what a verdict says after a round
_SAID = {
    "none": "the simulation explains the recordings",
    "parameters": "the structure is right, its numbers are not",
    "effect": "physics was left out",
    "unexplained": "something is missing that no hypothesis explains",
}


@app.command()
def investigate(
    config: CONFIG,
    model: Annotated[Path, typer.Option(help="nominal model", metavar="M.toml")],
    out: Annotated[
        Path, typer.Option(help="new folder for recordings, rounds.json and the diagnosis's files", metavar="DIR")
    ],
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="REC.csv", help="what has been recorded already")
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, max=20, help="most experiments")] = 3,
    duration: Annotated[
        float | None, typer.Option(min=1.0, help="time under excitation per round [s]; default experiment.budget_s")
    ] = None,
    rig_time: Annotated[
        float | None, typer.Option(min=1.0, help="time under excitation in all [s]; default all rounds")
    ] = None,
    without: WITHOUT = None,
    dry_run: DRY_RUN = False,
    t: T = None,
    u: U = None,
    y: Y = None,
    r: R = None,
) -> None:
    """Run the experiments that tell apart what a model may leave out, until one hypothesis is left."""
    from autotune.config import load_config
    from autotune.model_file import read_any
    from autotune.models import Model
    from autotune.pipeline.investigation import Budget, Listeners
    from autotune.pipeline.investigation import investigate as find_out
    from autotune.report.investigation_page import list_candidates

    content = load_config(config)
    nominal = read_any(model)
    if not isinstance(nominal, Model):
        raise InputError(
            "investigate plans experiments for a chain of blocks, these are equations", where=str(model),
            remedy="use autotune diagnose, which names the next experiment, or a chain of autotune model linearise",
        )  # fmt: skip
    given = read_all(recordings or [], signal_names(t, u, y, r))
    rig = rig_of(content, dry_run)
    new_folder(out, (ROUNDS, "diagnosis.json", "extended_model.toml", "report.html"), (config, model))
    with ProgressBar() as bar:
        known = find_out(
            rig, content, nominal, given, out,
            budget=Budget(rounds=rounds, duration_s=duration, rig_time_s=rig_time), without=without or (),
            told=Listeners(report=bar.work, on_status=bar.show, keep=lambda known: _keep(known, out)),
        )  # fmt: skip
    for one in known.rounds:
        kind, on = one.plan.excitation.kind, one.plan.excitation.on
        best = list_candidates(one.candidates, one.verdict)
        typer.echo(f"round {one.number}, {kind} on the {on}: {_SAID[one.verdict]}; {best}")
    found = known.diagnosis
    if found is not None:
        described = () if found.description is None else (found.description.sentence,)
        typer.echo("\n".join((*found.sentences, *described)))
    typer.echo(f"ended: {known.ended}")
    typer.echo(f"rounds.json, diagnosis.json, extended_model.toml and report.html are in {out}")


def _keep(known: Investigation, out: Path) -> None:
    """Write what is known so far; a later stop leaves it there."""
    from autotune.equations.files import write_any
    from autotune.report.investigation_page import write_investigation_page

    write_whole(out / ROUNDS, json.dumps(known.as_json(), indent=2) + "\n")
    found = known.diagnosis
    if found is None:
        return
    found.write(out / "diagnosis.json")
    write_any(found.extended_model, out / "extended_model.toml")
    write_investigation_page(known, found, out / "report.html")
