"""Commands: the whole chain, from a config file to a verified controller, and from recordings to a controller."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console

from autotune.cli import app
from autotune.cli.common import OVERWRITE, ProgressBar, new_folder, rig_of, warn_of_no_dead_man
from autotune.cli.live import LISTEN, PORT, TOKEN_FILE
from autotune.cli.recordings import R, T, U, Y, read_all, signal_names
from autotune.errors import ExperimentStopped, InputError
from autotune.outputs import OutputFolder
from autotune.whole_files import write_json

if TYPE_CHECKING:
    from autotune.config import Config
    from autotune.controller import PIDController
    from autotune.diagnosis.result import Diagnosis
    from autotune.pipeline import Tuning

_OUT = Annotated[Path, typer.Option(metavar="DIR", help="new folder for result.json and report.html")]


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
    dry_run: Annotated[bool, typer.Option("--dry-run", help="run the rig's simulated twin instead of the rig")] = False,
    verify: Annotated[bool, typer.Option(help="try the new loop on the rig")] = True,
    deploy: Annotated[bool, typer.Option(help="write accepted gains into the rig's own controller")] = True,
    diagnose: Annotated[
        bool, typer.Option("--diagnose", help="diagnose the recordings even where the loop behaves as predicted")
    ] = False,
    live: Annotated[
        bool, typer.Option("--live", help="show the run in the browser, with Abort and the decision")
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            help="seconds of a simulated rig in one second, to watch it with --live; default as fast as it can go",
        ),
    ] = None,
    listen: LISTEN = "127.0.0.1",
    port: PORT = 0,
    token_file: TOKEN_FILE = None,
) -> None:
    """Commission a rig: relay sweep, Bode points, reduced model, controller, verification, report."""
    content = _configuration(config, out, resume, dry_run)  # a mistake there is told before the method is imported
    from autotune.live.session import LivePage, read_token
    from autotune.pipeline import tune
    from autotune.pipeline.folder import FILES_OF_A_RUN, may_store
    from autotune.recording import read_recording
    from autotune.report.page import write_page
    from autotune.report.run_page import run_page

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
            tuning = tune(
                rig,
                content,
                folder,
                verify=verify,
                deploy=deploy,
                resume=resume is not None,
                on_status=bar.show,
                keep=keep,
            )
        missed = tuning.verification is not None and not tuning.verification.accepted
        found = _diagnose(content, tuning, folder, console) if missed or diagnose else None
        recordings = [read_recording(folder / part.recording) for part in tuning.experiment.parts]
        page = run_page(content.name, content.signals, recordings, tuning, found)
        write_page(page, folder / "report.html")
        for warning in (*tuning.experiment.warnings, *tuning.analysis.warnings):
            console.print(f"warning: {warning}", markup=False)
        for note in tuning.analysis.notes:
            console.print(f"note: {note}", markup=False)
        console.print(page.verdict, markup=False)
        if deploy and content.approval is not None:
            again = f"autotune deploy CONFIG.toml --run {folder} --approved-by NAME --reason TEXT"
            console.print(f"not handed over: [approval] asks for a second person: {again}", markup=False)
        for sentence in found.sentences if found is not None else ():
            console.print(sentence, markup=False)
        console.print(f"report: {folder / 'report.html'}", markup=False)
    if missed:
        raise typer.Exit(ExperimentStopped.exit_status)


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


def _pid_in_use(path: Path) -> PIDController:
    """Return the PI or PID of a file; another law has no gains to stand beside the new ones."""
    from autotune.controller import PIDController, read_controller

    found = read_controller(path)
    if not isinstance(found, PIDController):
        raise InputError("no PI or PID", where=str(path), remedy='--present takes kind = "pi" with K and Ti_s')
    return found


@app.command()
def tune(
    out: _OUT,
    recordings: Annotated[list[Path] | None, typer.Argument(metavar="REC.csv", help="recordings of the plant")] = None,
    points: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE.json",
            help="points.json or closed_loop.json, joined with the recordings' points; may be given more than once",
        ),
    ] = None,
    specification: Annotated[
        Literal["Spec1", "Spec2"],
        typer.Option(help="Spec1: modulus margin 0.5 and 45 deg; Spec2: 0.8 and 60 deg, for a plant that varies"),
    ] = "Spec1",
    modulus_margin: Annotated[float | None, typer.Option(help="replaces the named one, 0 to 1")] = None,
    phase_margin: Annotated[float | None, typer.Option(help="replaces the named one [deg]")] = None,
    noise_gain: Annotated[
        float | None,
        typer.Option(
            help="largest amplification of noise to command [u unit/y unit]; default from recorded noise and span of u"
        ),
    ] = None,
    noise_frequency: Annotated[
        float | None, typer.Option(help="lowest frequency of the noise [rad/s]; default the crossover")
    ] = None,
    sample_time: Annotated[
        float | None, typer.Option(help="period of the controller that is to run [s]; default the recording's")
    ] = None,
    kind: Annotated[Literal["pi", "pid"], typer.Option(help="structure of the controller")] = "pi",
    criterion: Annotated[
        Literal["auto", "iae", "h2"],
        typer.Option(
            help="minimised after a step of load: integral of the absolute error, or the norm (11); auto: iae for"
            " plain recordings, h2 for points, as in a run"
        ),
    ] = "auto",
    source: Annotated[
        Literal["auto", "reduced model", "points", "fitted plant"],
        typer.Option(help="what to design on; auto: the first that keeps its margins on everything measured"),
    ] = "auto",
    present: Annotated[
        Path | None,
        typer.Option(metavar="C.toml", help="the gains in use today: the page shows the new ones beside them"),
    ] = None,
    t: T = None,
    u: U = None,
    y: Y = None,
    r: R = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Design a controller from recordings and points, without a rig: model, controller, checks, report."""
    from autotune.config.procedure import DesignSettings, SignalSettings
    from autotune.controller import write_controller
    from autotune.pipeline import CONTROLLER, RESULT, analyse, analysis_json, measure_plant
    from autotune.points import read_points, require_regions
    from autotune.report.page import write_page
    from autotune.report.tuned_page import analysis_page
    from autotune.schema import validate

    recordings, files = recordings or [], points or []
    if not recordings and not files:
        raise InputError("give recordings or --points", where="autotune tune")
    place = OutputFolder(out, (RESULT, CONTROLLER, "report.html"), inputs=(*recordings, *files), overwrite=overwrite)
    options = {
        "modulus_margin": modulus_margin,
        "phase_margin_deg": phase_margin,
        "noise_gain": noise_gain,
        "noise_frequency_rad_s": noise_frequency,
        "sample_time_s": sample_time,
    }
    given_options = {name: value for name, value in options.items() if value is not None}
    asked = validate(
        DesignSettings,
        {"kind": kind, "specification": specification, "source": source, "criterion": criterion, **given_options},
        "autotune tune",
    )
    today = None if present is None else _pid_in_use(present)
    read = read_all(recordings, signal_names(t, u, y, r))
    given = [point for path in files for point in read_points(path)]
    if given and not read:
        require_regions(given, ", ".join(map(str, files)))
    with ProgressBar() as bar:
        found = measure_plant(read, given, bar.work)
        analysis = analyse(found.points, asked, fit=found.fit, facts=found.facts, progress=bar.work)
    notes = found.notes
    units = read[0].metadata.get("units", {}) if read else {}
    signals = SignalSettings(
        sample_time_s=read[0].sample_time_s if read else 1.0,  # the page shows units only
        u_unit=str(units.get("u", "")),
        y_unit=str(units.get("y", "")),
    )
    name, now = ", ".join(path.stem for path in (*recordings, *files)), datetime.now().astimezone()
    page = analysis_page(name, signals, read, analysis, notes, present=today, made=now)
    with place.write_all() as folder:
        write_json(folder / RESULT, analysis_json(analysis))
        write_controller(analysis.controller, folder / CONTROLLER)
        write_page(page, folder / "report.html")
    console = Console(highlight=False, soft_wrap=True)
    for note in (*notes, *analysis.warnings, *analysis.notes):
        console.print(f"note: {note}", markup=False)
    console.print(page.verdict, markup=False)
    console.print(f"report: {out / 'report.html'}, controller: {out / CONTROLLER}", markup=False)
