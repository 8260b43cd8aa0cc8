"""Command: from recordings and points to a controller, without a rig."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console

from autotune.cli import app
from autotune.cli.common import NOISE_FREQUENCY, OVERWRITE, STRUCTURE, ProgressBar
from autotune.cli.recordings import R, T, U, Y, read_all, signal_names
from autotune.errors import InputError
from autotune.outputs import OutputFolder
from autotune.whole_files import write_json

if TYPE_CHECKING:
    from autotune.controller import PIDController
    from autotune.pipeline import Analysis
    from autotune.recording import Recording

_POINTS = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE.json",
        help="points.json or closed_loop.json, joined with the recordings' points; may be given more than once",
    ),
]
_CRITERION = Annotated[
    Literal["auto", "iae", "h2"],
    typer.Option(
        help="minimised after a step of load: integral of the absolute error, or the norm (11); auto: iae for"
        " plain recordings, h2 for points, as in a run"
    ),
]


@app.command()
def tune(
    out: Annotated[Path, typer.Option(metavar="DIR", help="new folder for result.json and report.html")],
    recordings: Annotated[list[Path] | None, typer.Argument(metavar="REC.csv", help="recordings of the plant")] = None,
    points: _POINTS = None,
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
    noise_frequency: NOISE_FREQUENCY = None,
    sample_time: Annotated[
        float | None, typer.Option(help="period of the controller that is to run [s]; default the recording's")
    ] = None,
    kind: STRUCTURE = "pi",
    criterion: _CRITERION = "auto",
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
    from autotune.config.procedure import DesignSettings
    from autotune.pipeline import CONTROLLER, RESULT, analyse, measure_plant
    from autotune.points import read_points, require_regions
    from autotune.schema import validate

    recordings, files = recordings or [], points or []
    if not recordings and not files:
        raise InputError("give recordings or --points", where="autotune tune")
    place = OutputFolder(out, (RESULT, CONTROLLER, "report.html"), inputs=(*recordings, *files), overwrite=overwrite)
    options: dict[str, Any] = {"kind": kind, "specification": specification, "source": source, "criterion": criterion}
    options |= {"modulus_margin": modulus_margin, "phase_margin_deg": phase_margin, "noise_gain": noise_gain}
    options |= {"noise_frequency_rad_s": noise_frequency, "sample_time_s": sample_time}
    given_options = {name: value for name, value in options.items() if value is not None}
    asked = validate(DesignSettings, given_options, "autotune tune")
    today = None if present is None else _pid_in_use(present)
    read = read_all(recordings, signal_names(t, u, y, r))
    given = [point for path in files for point in read_points(path)]
    if given and not read:
        require_regions(given, ", ".join(map(str, files)))
    with ProgressBar() as bar:
        found = measure_plant(read, given, bar.work)
        analysis = analyse(found.points, asked, fit=found.fit, facts=found.facts, progress=bar.work)
    name = ", ".join(path.stem for path in (*recordings, *files))
    _report(place, name, read, analysis, found.notes, today)


def _report(
    place: OutputFolder, name: str, read: list[Recording], analysis: Analysis, notes: Sequence[str],
    today: PIDController | None,
) -> None:  # fmt: skip
    """Write result, controller and page, and say the verdict with all that is to be known beside it."""
    from autotune.config.procedure import SignalSettings
    from autotune.controller import write_controller
    from autotune.pipeline import CONTROLLER, RESULT, analysis_json
    from autotune.report.page import write_page
    from autotune.report.tuned_page import analysis_page

    units = read[0].metadata.get("units", {}) if read else {}
    u_unit, y_unit = str(units.get("u", "")), str(units.get("y", ""))  # the page shows no more of the signals
    signals = SignalSettings(sample_time_s=read[0].sample_time_s if read else 1.0, u_unit=u_unit, y_unit=y_unit)
    now = datetime.now().astimezone()
    page = analysis_page(name, signals, read, analysis, notes, present=today, made=now)
    with place.write_all() as folder:
        write_json(folder / RESULT, analysis_json(analysis))
        write_controller(analysis.controller, folder / CONTROLLER)
        write_page(page, folder / "report.html")
    console = Console(highlight=False, soft_wrap=True)
    for note in (*notes, *analysis.warnings, *analysis.notes):
        console.print(f"note: {note}", markup=False)
    console.print(page.verdict, markup=False)
    console.print(f"report: {place.path / 'report.html'}, controller: {place.path / CONTROLLER}", markup=False)


def _pid_in_use(path: Path) -> PIDController:
    """Return the PI or PID of a file; another law has no gains to stand beside the new ones."""
    from autotune.controller import PIDController, read_controller

    found = read_controller(path)
    if not isinstance(found, PIDController):
        raise InputError("no PI or PID", where=str(path), remedy='--present takes kind = "pi" with K and Ti_s')
    return found
