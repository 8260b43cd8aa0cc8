"""Commands that compare a model with recordings: simulate and diagnose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from autotune.cli import app
from autotune.cli.common import OVERWRITE, WITHOUT
from autotune.cli.recordings import R, T, U, Y, read_all, read_one, signal_names
from autotune.errors import InputError
from autotune.outputs import Output, OutputFolder

#: Share of the recorded range by which a signal may leave it before that is said: noise does.
OUTSIDE = 0.05

if TYPE_CHECKING:
    from autotune.arrays import FloatArray
    from autotune.files import SignalNames
    from autotune.models import Model
    from autotune.progress import Progress
    from autotune.recording import Recording


@app.command()
def simulate(
    recording: Annotated[Path, typer.Argument(help="recording whose u drives the model", metavar="REC.csv")],
    model: Annotated[Path, typer.Option(help="model, nominal or extended", metavar="M.toml")],
    out: Annotated[Path, typer.Option(help="file for the columns t,y_sim", metavar="SIM.csv")],
    horizon: Annotated[
        float | None,
        typer.Option(help="length of the windows [s] before which the state is estimated anew; default: one free run"),
    ] = None,
    t: T = None,
    u: U = None,
    y: Y = None,
    r: R = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Simulate a model with a recording's u; with --horizon as a forecast, window after window."""
    import numpy as np

    from autotune.diagnosis.simulation.forecast import forecast
    from autotune.equations.files import forecast_any as of_any
    from autotune.model_file import read_any as read_any_model
    from autotune.models import Model
    from autotune.recorded_units import require_units_of_model

    place = Output(out, inputs=(recording, model), overwrite=overwrite)
    data = read_one(recording, signal_names(t, u, y, r), moving=False)
    nominal = read_any_model(model)
    require_units_of_model(nominal, [data])
    data.require_dense()
    y_sim = forecast(nominal, data, horizon) if isinstance(nominal, Model) else of_any(nominal, data, horizon)
    if not np.all(np.isfinite(y_sim)):
        at = float(data.t[int(np.argmax(~np.isfinite(y_sim)))])
        raise InputError(
            f"the simulation leaves the range of numbers at t = {at:g} s", where=str(model),
            remedy="an unstable model is compared as forecasts: --horizon S",
        )  # fmt: skip
    if isinstance(nominal, Model):
        _warn_beyond(nominal, data, y_sim)
    rows = np.column_stack([data.t, y_sim])
    place.by(lambda part: np.savetxt(part, rows, fmt="%.10g", delimiter=",", header="t,y_sim", comments=""))
    known = np.isfinite(data.y)
    error = float(np.sqrt(np.mean((data.y - y_sim)[known] ** 2)) / max(float(np.std(data.y[known])), 1e-300))
    typer.echo(f"simulated {len(data)} rows, error {error:.4g} of the spread of y, in {out}")


def _warn_beyond(model: Model, recording: Recording, y_sim: FloatArray) -> None:
    """Say on stderr where a model runs outside what it was fitted to: its laws are extrapolated there."""
    for name, port, values in (("u", model.input, recording.u), ("y", model.output, y_sim)):
        beyond, share = port.beyond(values)
        if port.recorded is not None and beyond > OUTSIDE:
            low, high = port.recorded
            typer.echo(
                f"warning: {name} leaves what the model was fitted to ({low:.4g} to {high:.4g}) in"
                f" {100.0 * share:.2g} % of the rows, by up to {beyond:.2g} of its span: laws are extrapolated there;"
                " record that range",
                err=True,
            )


@app.command()
def diagnose(
    recordings: Annotated[
        list[Path], typer.Argument(help="recordings, best with different excitation", metavar="REC.csv")
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="folder for diagnosis.json, extended_model.toml and report.html; routine.json with --routine",
            metavar="DIR",
        ),
    ],
    model: Annotated[Path | None, typer.Option(help="nominal model; none with --routine", metavar="M.toml")] = None,
    routine: Annotated[
        bool,
        typer.Option(
            "--routine", help="a loop in operation, without test or model: valve, tuning, or something outside"
        ),
    ] = False,
    controller: Annotated[
        Path | None,
        typer.Option(help="law that u was computed by; default: the recordings' sidecars", metavar="C.toml"),
    ] = None,
    without: WITHOUT = None,
    t: T = None,
    u: U = None,
    y: Y = None,
    r: R = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Find where and why recordings differ from the simulation: numbers, missing physics, or something else."""
    names = signal_names(t, u, y, r)
    if routine:
        unused = {"--model": model, "--controller": controller, "--without": without}
        _look_at_routine(recordings, out, unused, names, overwrite=overwrite)
    elif model is None:
        raise InputError(
            "no model", where="diagnose",
            remedy="give --model M.toml, or --routine for a loop in operation that has no model",
        )  # fmt: skip
    else:
        _compare_with_model(recordings, out, model, controller, without or (), names, overwrite=overwrite)


def _compare_with_model(
    recordings: Sequence[Path], out: Path, model: Path, controller: Path | None, without: Sequence[str],
    names: SignalNames, *, overwrite: bool,
) -> None:  # fmt: skip
    """Find what a model leaves out of recordings, and write diagnosis.json, the extended model and the page."""
    from autotune.controller import read_controller
    from autotune.diagnosis.diagnose import diagnose as find
    from autotune.equations.files import write_any
    from autotune.experiment_design.next_experiment import with_next_experiment
    from autotune.model_file import read_any as read_any_model
    from autotune.recorded_units import require_units_of_model
    from autotune.report.diagnosis_page import write_diagnosis_page

    files = ("diagnosis.json", "extended_model.toml", "report.html")
    place = OutputFolder(out, files, inputs=(model, controller, *recordings), overwrite=overwrite)
    nominal = read_any_model(model)
    data = read_all(recordings, names)
    require_units_of_model(nominal, data)
    law = None if controller is None else read_controller(controller)
    with _progress_shown("diagnosing") as progress:
        found = with_next_experiment(find(nominal, data, law, without, progress))
    with place.write_all() as folder:
        found.write(folder / "diagnosis.json")
        write_any(found.extended_model, folder / "extended_model.toml", base=model.parent)
        write_diagnosis_page(found, folder / "report.html", law)
    for sentence in found.sentences:
        typer.echo(sentence)
    if found.description is not None:
        typer.echo(found.description.sentence)
    typer.echo(f"diagnosis.json, extended_model.toml and report.html are in {out}")


def _look_at_routine(
    recordings: Sequence[Path], out: Path, unused: Mapping[str, object], names: SignalNames, *, overwrite: bool
) -> None:
    """Look at recordings of one loop in operation, without a model, and write routine.json and the page."""
    from autotune.diagnosis.routine import diagnose_routine
    from autotune.report.routine_page import write_routine_page

    given = next((option for option, value in unused.items() if value), None)
    if given is not None:
        raise InputError(
            "it does not go with --routine, which fits a model of its own", where=given, remedy="leave one of them out"
        )
    place = OutputFolder(out, ("routine.json", "report.html"), inputs=tuple(recordings), overwrite=overwrite)
    data = read_all(recordings, names)
    with _progress_shown("looking") as progress:
        found = diagnose_routine(data, progress=progress)
    with place.write_all() as folder:
        found.write(folder / "routine.json")
        write_routine_page(found, folder / "report.html")
    for sentence in (*found.sentences, found.following):
        typer.echo(sentence)
    typer.echo(f"routine.json and report.html are in {out}")


@contextmanager
def _progress_shown(begin: str) -> Iterator[Progress]:
    """Show how far a search is, and yield what it tells that to."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(begin, total=1.0)
        yield lambda what, share: progress.update(task, description=what, completed=share)
