"""Commands: frequency points from recordings, reduced model from points."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from autotune.cli import app, identify
from autotune.cli.common import OVERWRITE
from autotune.cli.recordings import R, T, U, Y, read_all, signal_names
from autotune.errors import InputError
from autotune.outputs import Output

if TYPE_CHECKING:
    from autotune.identification.reduction import ReducedModel
    from autotune.points import FrequencyPoint


@identify.command("frequency")
def frequency(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC.csv", help="recordings; with r where it moved")],
    out: Annotated[Path, typer.Option(help="points file to write (JSON)")],
    largest_sd: Annotated[
        float,
        typer.Option(min=0.001, max=1.0, help="leave out points whose standard deviation is above this part of gain"),
    ] = 0.5,
    t: T = None,
    u: U = None,
    y: Y = None,
    r: R = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Estimate Bode points from recordings: relay, multisine, random binary or steps, open or closed loop."""
    place = Output(out, inputs=recordings, overwrite=overwrite)  # refused before the method is imported
    from rich.progress import track

    from autotune.identification.frequency.recorded import combine, session_points, sessions
    from autotune.points import points_to_json

    estimates = []
    data = sessions(read_all(recordings, signal_names(t, u, y, r)))
    for one in track(data, description="recordings", transient=True, disable=len(data) < 2):
        estimates.append(session_points(one, largest_relative_sd=largest_sd))
    for one, estimate in zip(data, estimates, strict=True):
        typer.echo(f"{', '.join(part.name for part in one)}: {estimate.excitation}, {len(estimate.points)} point(s)")
    combined = combine(estimates)
    for point in combined.points:
        typer.echo(f"  {_line(point)}")
    for note in combined.notes:
        typer.echo(f"note: {note}")
    place.json({"points": points_to_json(combined.points)})
    typer.echo(f"{len(combined.points)} frequency point(s) written to {out}")


def _line(point: FrequencyPoint) -> str:
    from autotune.identification.envelope import polar_sd

    gain_sd, phase_sd = polar_sd(point)
    return (
        f"{point.omega_rad_s:9.4g} rad/s  gain {point.gain:.4g} (sd {100 * gain_sd:.2g} %)"
        f"  phase {math.degrees(point.phase_rad):.2f} deg (sd {math.degrees(phase_sd):.2g})  {point.source}"
    )


@app.command("reduce")
def reduce(
    out: Annotated[Path, typer.Option(help="reduced model to write: a model file (TOML)")],
    points: Annotated[Path | None, typer.Option(help="points file of identify frequency (JSON)")] = None,
    model: Annotated[Path | None, typer.Option(help="model file (TOML) of a plant that is known")] = None,
    kind: Annotated[
        Literal["auto", "self-regulating", "integrating"],
        typer.Option(help="structure of the model; auto lets the data decide"),
    ] = "auto",
    conditions: Annotated[
        Literal["regions", "estimates"],
        typer.Option(help="bound the points' 95 % regions, or only the estimates"),
    ] = "regions",
    static_gain: Annotated[
        float | None, typer.Option(help="measured static gain with its sign [y unit/u unit]; none when absent")
    ] = None,
    static_gain_sd: Annotated[
        float | None, typer.Option(min=0.0, help="its standard deviation; 1 % of it when absent")
    ] = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Reduce measured points, or a known plant, to the cautious low-order model that a robust PI is designed on."""
    place = Output(out, inputs=(points, model), overwrite=overwrite)  # refused before the method is imported
    if (points is None) == (model is None):
        raise InputError("give one of --points and --model", where="autotune reduce")
    from autotune.identification.frequency.thinning import thin_points, thinning_note
    from autotune.identification.reduced_file import write_reduced
    from autotune.identification.reduction import reduce_points, reduce_transfer_function
    from autotune.points import read_points, require_regions

    if model is not None:
        from autotune.model_file import read_model

        reduced = reduce_transfer_function(read_model(model).transfer_function())
        place.by(lambda part: write_reduced(reduced, part))
        _say(reduced, out)
        return
    assert points is not None
    known = None
    if static_gain is not None:
        known = (static_gain, static_gain_sd if static_gain_sd is not None else 0.01 * abs(static_gain))
    given = read_points(points)
    require_regions(given, str(points))
    few = thin_points(given)
    for note in thinning_note(len(given), len(few)):
        typer.echo(f"note: {note}")
    reduced = reduce_points(few, kind=None if kind == "auto" else kind, conditions=conditions, static_gain=known)
    place.by(lambda part: write_reduced(reduced, part))
    _say(reduced, out)


def _say(reduced: ReducedModel, out: Path) -> None:
    lag = "" if reduced.omega_0r_rad_s is None else f", omega_0r = {reduced.omega_0r_rad_s:.4g} rad/s"
    name = "integrating" if reduced.integrating else "self-regulating"
    typer.echo(f"{name}: {reduced.evidence or 'of a known plant'}")
    typer.echo(f"G_r = {reduced.G_r:.4g}{lag}, omega_d = {reduced.omega_d_rad_s:.4g} rad/s; written to {out}")
    for warning in reduced.warnings:
        typer.echo(f"warning: {warning}")
