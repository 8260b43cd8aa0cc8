"""Commands: the whole chain, from a config file to a verified controller, and from recordings to a controller."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from autotune.cli import app
from autotune.cli.common import ProgressBar, new_folder, rig_of
from autotune.cli.live import LISTEN, PORT, TOKEN

_OUT = Annotated[Path, typer.Option(metavar="DIR", help="new folder for recordings, result.json and report.html")]


@app.command()
def run(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="configuration of the rig")],
    out: _OUT,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="run the rig's simulated twin instead of the rig")] = False,
    verify: Annotated[bool, typer.Option(help="try the new loop on the rig")] = True,
    deploy: Annotated[bool, typer.Option(help="write accepted gains into the rig's own controller")] = True,
    live: Annotated[
        bool, typer.Option("--live", help="show the run in the browser, with Abort and the decision")
    ] = False,
    listen: LISTEN = "127.0.0.1",
    port: PORT = 0,
    token: TOKEN = None,
) -> None:
    """Commission a rig: relay sweep, Bode points, reduced model, controller, verification, report."""
    from autotune.config import load_config
    from autotune.live.session import LivePage
    from autotune.pipeline import RECORDING, tune
    from autotune.recording import read_recording
    from autotune.report.page import write_page
    from autotune.report.run_page import run_page

    content = load_config(config)
    rig = rig_of(content, dry_run)
    new_folder(out, RECORDING)
    with LivePage(out, listen, port, token) if live else nullcontext() as onlooker:
        keep = onlooker.keep if onlooker is not None else None
        with ProgressBar() as bar:
            tuning = tune(rig, content, out, verify=verify, deploy=deploy, on_progress=bar.show, keep=keep)
        page = run_page(content.name, content.signals, read_recording(out / RECORDING), tuning)
        write_page(page, out / "report.html")
        console = Console(highlight=False, soft_wrap=True)
        for warning in (*tuning.experiment.warnings, *tuning.analysis.warnings):
            console.print(f"warning: {warning}", markup=False)
        console.print(page.verdict, markup=False)
        console.print(f"report: {out / 'report.html'}", markup=False)


@app.command()
def tune(
    out: _OUT,
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="[REC.csv ...]", help="recordings of the plant, t,u,y")
    ] = None,
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
    noise_gain: Annotated[float, typer.Option(help="largest amplification of noise to command [u unit/y unit]")] = 0.1,
    kind: Annotated[Literal["pi", "pid"], typer.Option(help="structure of the controller")] = "pi",
    source: Annotated[Literal["reduced model", "points"], typer.Option(help="what to design on")] = "reduced model",
) -> None:
    """Design a controller from recordings and points, without a rig: Bode points, reduced model, controller, report."""
    import json

    from autotune.config.procedure import DesignSettings, SignalSettings
    from autotune.errors import InputError
    from autotune.identification.frequency.recorded import combine, frequency_points
    from autotune.pipeline import RESULT, analyse, analysis_json
    from autotune.points import read_points
    from autotune.recording import read_recording
    from autotune.report.page import write_page
    from autotune.report.run_page import analysis_page

    recordings, files = recordings or [], points or []
    if not recordings and not files:
        raise InputError("give recordings or --points", where="autotune tune")
    read = [read_recording(path) for path in recordings]
    given = [point for path in files for point in read_points(path)]
    new_folder(out, RESULT)
    combined = combine([frequency_points(recording) for recording in read]) if read else None
    notes = combined.notes if combined else ()
    settings = DesignSettings(
        kind=kind,
        specification=specification,
        modulus_margin=modulus_margin,
        phase_margin_deg=phase_margin,
        noise_gain=noise_gain,
        source=source,
    )
    analysis = analyse([*(combined.points if combined else ()), *given], settings)
    units = read[0].metadata.get("units", {}) if read else {}
    signals = SignalSettings(
        sample_time_s=read[0].sample_time_s if read else 1.0,  # the page shows units only
        u_unit=str(units.get("u", "")),
        y_unit=str(units.get("y", "")),
    )
    (out / RESULT).write_text(json.dumps(analysis_json(analysis), indent=2) + "\n", encoding="utf-8")
    page = analysis_page(", ".join(path.stem for path in (*recordings, *files)), signals, read, analysis, notes)
    write_page(page, out / "report.html")
    console = Console(highlight=False, soft_wrap=True)
    for note in (*notes, *analysis.warnings):
        console.print(f"note: {note}", markup=False)
    console.print(page.verdict, markup=False)
    console.print(f"report: {out / 'report.html'}", markup=False)
