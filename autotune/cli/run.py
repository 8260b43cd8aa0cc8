"""Command: the whole chain, from a config file to a verified controller."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from autotune.cli import app
from autotune.cli.common import DRY_RUN, ProgressBar, new_folder, rig_of, warn_of_no_dead_man
from autotune.cli.live import LISTEN, PORT, TOKEN_FILE
from autotune.errors import ExperimentStopped, InputError

if TYPE_CHECKING:
    from autotune.config import Config
    from autotune.diagnosis.result import Diagnosis
    from autotune.pipeline import Tuning

_SPEED = Annotated[
    float | None,
    typer.Option(
        min=0.01, help="seconds of a simulated rig in one second, to watch it with --live; default as fast as it can go"
    ),
]


@app.command()
def run(
    config: Annotated[
        Path | None,
        typer.Argument(metavar="CONFIG.toml", help="configuration of the rig; the stored one with --resume"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="new folder for recordings, result.json and report.html")
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="DIR", help="folder of an interrupted run: go on with the points it has")
    ] = None,
    dry_run: DRY_RUN = False,
    verify: Annotated[bool, typer.Option(help="try the new loop on the rig")] = True,
    deploy: Annotated[bool, typer.Option(help="write accepted gains into the rig's own controller")] = True,
    diagnose: Annotated[
        bool, typer.Option("--diagnose", help="diagnose the recordings even where the loop behaves as predicted")
    ] = False,
    live: Annotated[
        bool, typer.Option("--live", help="show the run in the browser, with Abort and the decision")
    ] = False,
    speed: _SPEED = None,
    listen: LISTEN = "127.0.0.1",
    port: PORT = 0,
    token_file: TOKEN_FILE = None,
) -> None:
    """Commission a rig: relay sweep, Bode points, reduced model, controller, verification, report."""
    content = _configuration(config, out, resume, dry_run)  # a mistake there is told before the method is imported
    from autotune.live.session import LivePage, read_token
    from autotune.pipeline import tune
    from autotune.pipeline.folder import FILES_OF_A_RUN, may_store

    rig = rig_of(content, speed=speed)
    if out is not None:
        new_folder(out, FILES_OF_A_RUN)
        may_store(content, out)
    folder = out or resume or Path()
    console = Console(highlight=False, soft_wrap=True)
    if warning := warn_of_no_dead_man(content):
        console.print(f"warning: {warning}", markup=False)
    with LivePage(folder, listen, port, read_token(token_file)) if live else nullcontext() as onlooker:
        keep = onlooker.keep if onlooker is not None else None
        with _page_where_stopped(content, folder), ProgressBar() as bar:
            asked = {"verify": verify, "deploy": deploy, "resume": resume is not None}
            tuning = tune(rig, content, folder, **asked, on_status=bar.show, keep=keep)
        missed = tuning.verification is not None and not tuning.verification.accepted
        found = _diagnose(content, tuning, folder, console) if missed or diagnose else None
        _report(content, tuning, found, folder, console, is_withheld=deploy and content.approval is not None)
    if missed:
        raise typer.Exit(ExperimentStopped.exit_status)


def _report(
    config: Config, tuning: Tuning, found: Diagnosis | None, folder: Path, console: Console, *, is_withheld: bool
) -> None:
    """Write the page, and say the verdict with all that is to be known beside it."""
    from autotune.recording import read_recording
    from autotune.report.page import write_page
    from autotune.report.run_page import run_page

    recordings = [read_recording(folder / part.recording) for part in tuning.experiment.parts]
    page = run_page(config.name, config.signals, recordings, tuning, found)
    write_page(page, folder / "report.html")
    for warning in (*tuning.experiment.warnings, *tuning.analysis.warnings):
        console.print(f"warning: {warning}", markup=False)
    for note in tuning.analysis.notes:
        console.print(f"note: {note}", markup=False)
    console.print(page.verdict, markup=False)
    if is_withheld:
        again = f"autotune deploy CONFIG.toml --run {folder} --approved-by NAME --reason TEXT"
        console.print(f"not handed over: [approval] asks for a second person: {again}", markup=False)
    for sentence in found.sentences if found is not None else ():
        console.print(sentence, markup=False)
    console.print(f"report: {folder / 'report.html'}", markup=False)


@contextmanager
def _page_where_stopped(config: Config, folder: Path) -> Iterator[None]:
    """Write a page also where the run is stopped: it says why, and how the rig was left."""
    from autotune.pipeline.folder import RECORDING, VERIFICATION, recordings
    from autotune.recording import read_recording
    from autotune.report.page import write_page
    from autotune.report.run_page import stopped_run_page

    try:
        yield
    except ExperimentStopped as error:
        with suppress(InputError, OSError):  # a recording of no rows, a full disk: the line says it all
            files = (*recordings(folder, RECORDING), *recordings(folder, VERIFICATION))
            page = stopped_run_page(config.name, config.signals, [read_recording(file) for file in files], str(error))
            write_page(page, folder / "report.html")
        raise


def _configuration(config: Path | None, out: Path | None, resume: Path | None, dry_run: bool) -> Config:
    """Return the configuration that was given, or the one that the interrupted run began with."""
    from autotune.config import load_config

    if (out is None) == (resume is None):
        raise InputError("give --out for a new run, or --resume for an interrupted one", where="autotune run")
    if config is not None:
        content = load_config(config)
    elif resume is not None:
        from autotune.pipeline.folder import read_stored_config

        content = read_stored_config(resume)
    else:
        raise InputError("CONFIG.toml is missing", where="autotune run", remedy="autotune run CONFIG.toml --out DIR")
    if not dry_run:
        return content
    from drivers import twin_of

    # so that nobody goes on at the rig with what its twin has measured
    return content.model_copy(update={"rig": twin_of(content.rig)})


def _diagnose(config: Config, tuning: Tuning, folder: Path, console: Console) -> Diagnosis | None:
    """Return what the fitted plant leaves out, its files written; None where the recordings do not allow it."""
    from autotune.equations.files import write_any
    from autotune.pipeline.folder import RESULT, VERIFICATION, recordings
    from autotune.pipeline.mismatch import diagnose_run
    from autotune.pipeline.result import append_diagnosis
    from autotune.report.diagnosis_page import write_diagnosis_page

    files = [folder / part.recording for part in tuning.experiment.parts]
    files += recordings(folder, VERIFICATION)[-1:] if tuning.verification is not None else ()
    try:
        with ProgressBar() as bar:
            found = diagnose_run(config, tuning.experiment, tuning.analysis.fit, files, bar.work)
    except InputError as error:
        console.print(f"warning: not diagnosed: {error}", markup=False)
        return None
    place = folder / "diagnosis"
    place.mkdir(exist_ok=True)
    found.write(place / "diagnosis.json")
    write_any(found.extended_model, place / "extended_model.toml")
    write_diagnosis_page(found, place / "report.html")
    append_diagnosis(folder / RESULT, found)
    return found
