"""Commands: a model beside its plant, a set-point that a loop can follow, and a controller by pole placement."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from autotune.cli import app
from autotune.cli.common import OVERWRITE
from autotune.errors import InputError
from autotune.outputs import Output

#: Rows of a reference, a file of 40 MB.
_MOST_ROWS = 1e6


@app.command("validate")
def validate_command(
    model: Annotated[Path, typer.Option(help="model file (TOML) that is to stand for the plant")],
    against: Annotated[Path, typer.Option(help="model file (TOML) of the plant")],
    out: Annotated[Path, typer.Option(help="file to write the comparison to (JSON)")],
    controller: Annotated[
        Path | None, typer.Option(help="controller file (TOML) or result.json; the PI designed on --model when absent")
    ] = None,
    scaling: Annotated[
        float | None,
        typer.Option(help="k of the plants k H and the controller C/k; the controller's gain at crossover when absent"),
    ] = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Compare a model with its plant as a controller sees them: nu-gap and stability margins b, criterion (10)."""
    from autotune.api.methods import validate

    place = Output(out, inputs=(model, against, controller), overwrite=overwrite)
    found = validate(against, model, controller, scaling=scaling)
    place.json(
        {
            "nu_gap": found.nu_gap,
            "b_model": found.b_reduced,
            "b_plant": found.b_rig,
            "scaling": found.scaling,
            "holds": found.holds,
            "holds_at_every_frequency": found.holds_locally,
        }
    )
    typer.echo(
        f"nu-gap {found.nu_gap:.4g}, b with the model {found.b_reduced:.4g}, with the plant {found.b_rig:.4g}, at "
        f"scaling {found.scaling:.4g}: criterion (10) {'holds' if found.holds else 'does not hold'}"
    )
    typer.echo(f"wrote {out}")


@app.command("reference")
def reference_command(
    out: Annotated[Path, typer.Option(help="CSV t,r,u_ff to write; with --controller the prefilter (TOML)")],
    model: Annotated[Path | None, typer.Option(help="model file (TOML) or delay.json that u is computed with")] = None,
    controller: Annotated[
        Path | None,
        typer.Option(help="controller file (TOML) or result.json: write the prefilter of its set-point weight instead"),
    ] = None,
    begin: Annotated[float, typer.Option("--from", help="y at rest before [y unit]")] = 0.0,
    end: Annotated[float, typer.Option("--to", help="y at rest after [y unit]")] = 1.0,
    rest: Annotated[float, typer.Option(help="u that holds --from [u unit]")] = 0.0,
    u_min: Annotated[float | None, typer.Option(help="lowest command [u unit]")] = None,
    u_max: Annotated[float | None, typer.Option(help="highest command [u unit]")] = None,
    u_rate: Annotated[float | None, typer.Option(help="fastest change of the command [u unit/s]")] = None,
    y_speed: Annotated[float | None, typer.Option(help="fastest change of y [y unit/s]")] = None,
    sample_time: Annotated[
        float | None, typer.Option(min=1e-6, help="time between rows [s]; 200 rows when absent")
    ] = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Plan the fastest smooth transition within limits with the command that follows it, or write a prefilter."""
    place = Output(out, inputs=(model, controller), overwrite=overwrite)
    if (model is None) == (controller is None):
        raise InputError("give one of --model and --controller", where="autotune reference")
    if controller is not None:
        weight = _prefilter(controller, place)
        passes = "; F is 1: the whole set-point passes; write setpoint_weight = 0 into the file for the full prefilter"
        typer.echo(
            f"wrote {out}, the prefilter F of set-point weight {weight:g}{passes if weight == 1.0 else ''}; "
            "filter the set-point by it, and set the controller's set-point weight to 1"
        )
        return
    import numpy as np

    from autotune.api.methods import transition
    from autotune.api.plants import as_plant
    from autotune.identification.delay.model import read_delay_model

    assert model is not None
    plant = as_plant(read_delay_model(model) if model.suffix == ".json" else model)
    found = transition(
        plant,
        y_start=begin,
        y_end=end,
        u_rest=rest,
        u_min=-math.inf if u_min is None else u_min,
        u_max=math.inf if u_max is None else u_max,
        u_rate=math.inf if u_rate is None else u_rate,
        y_speed=math.inf if y_speed is None else y_speed,
    )
    step = found.duration_s / 200.0 if sample_time is None else sample_time
    if found.duration_s > _MOST_ROWS * step:
        raise InputError(
            f"--sample-time {step:g} s makes {found.duration_s / step:.3g} rows of {found.duration_s:.4g} s",
            where="autotune reference", remedy=f"at most {_MOST_ROWS:g} are written",
        )  # fmt: skip
    t = step * np.arange(math.ceil(found.duration_s / step - 1e-9) + 1)
    rows = np.column_stack([t, np.interp(t, found.t_s, found.y), np.interp(t, found.t_s, found.u)])
    place.by(lambda part: np.savetxt(part, rows, fmt="%.10g", delimiter=",", header="t,r,u_ff", comments=""))
    if (plant.poles.real > 0.0).any():
        typer.echo("warning: the plant is unstable: u_ff holds it only beside a controller that does", err=True)
    typer.echo(f"{found.duration_s:.4g} s from {begin:g} to {end:g}, decided by {found.binding}; wrote {out}")


def _prefilter(controller: Path, place: Output) -> float:
    """Write the prefilter of a controller file and return its set-point weight."""
    from autotune.controller import PIDController, read_controller, write_controller
    from autotune.design.reference import prefilter

    law = read_controller(controller)
    if not isinstance(law, PIDController):
        raise InputError("has num and den", where=str(controller), remedy="a prefilter belongs to a PI or PID")
    place.by(lambda part: write_controller(prefilter(law), part))
    return law.setpoint_weight


@app.command("rst")
def rst_command(
    model: Annotated[Path, typer.Option(help="model file (TOML) without dead time")],
    out: Annotated[Path, typer.Option(help="file to write R, S, T and the margins to (JSON)")],
    dominant: Annotated[float, typer.Option(min=1e-9, help="distance of the double dominant pole [rad/s]")],
    rest: Annotated[float, typer.Option(min=1e-9, help="distance of the poles that nothing else decides [rad/s]")],
    controller: Annotated[Path | None, typer.Option(help="also write the feedback R/S (controller file, TOML)")] = None,
    sample_time: Annotated[
        float | None, typer.Option(min=1e-6, help="also write the law as it runs, for this time between samples [s]")
    ] = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Place the poles of a loop with an RST controller, the plant's own stable poles kept."""
    from autotune.api.methods import margins
    from autotune.api.pole_placement import rst
    from autotune.controller import write_controller

    place = Output(out, inputs=(model, controller), overwrite=overwrite)
    law = None if controller is None else Output(controller, inputs=(model, out), overwrite=overwrite)
    placed = rst(model, dominant_rad_s=dominant, rest_rad_s=rest)
    m = margins(model, placed)
    content: dict[str, Any] = {"R": list(placed.R), "S": list(placed.S), "T": list(placed.T), "margins": m.to_json()}
    if sample_time is not None:
        content["sampled"] = placed.law(sample_time).to_json()
    place.json(content)
    if law is not None:
        law.by(lambda part: write_controller(placed.feedback(), part))
    typer.echo(
        f"RST of order {len(placed.S) - 1}: modulus margin {m.modulus:.3f}, phase margin "
        f"{math.degrees(m.phase_rad):.1f} deg, delay margin {m.delay_s:.3g} s, noise gain "
        f"{m.noise_gain:.3g}, H2 {m.h2:.4g}; wrote {out}"
    )
