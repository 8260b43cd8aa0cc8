"""Commands: design on a model or on points, and margins of a given controller."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer

from autotune.cli import app
from autotune.cli.common import NOISE_FREQUENCY, OVERWRITE, STRUCTURE, U_SPAN, Y_SPAN
from autotune.controller_forms import FORMS, to_form
from autotune.errors import InputError
from autotune.outputs import Output

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotune.design.specification import Design, Kind, Specification
    from autotune.models import TransferFunction

    Asked = Callable[..., Specification]  # from the plant, and the highest frequency that is known of it

_POINTS = Annotated[
    Path | None,
    typer.Option(help="points file (JSON) to design on, with its regions; or closed_loop.json, on its joint region"),
]


@app.command("design")
def design_command(
    out: Annotated[Path, typer.Option(help="file to write the design to (JSON)")],
    model: Annotated[Path | None, typer.Option(help="model file (TOML) to design on")] = None,
    points: _POINTS = None,
    modulus_margin: Annotated[float, typer.Option(help="smallest distance of L from -1, between 0 and 1")] = 0.5,
    phase_margin: Annotated[float, typer.Option(help="smallest phase margin [deg]")] = 45.0,
    noise_gain: Annotated[
        float | None,
        typer.Option(help="largest noise amplification y to u, N_max [u/y unit]; default from the plant's gain"),
    ] = None,
    noise: Annotated[
        Literal["bound", "true"],
        typer.Option(help="true: |C/(1+L)| <= N_max (15); bound: |C| <= M_m N_max (16), which implies it"),
    ] = "true",
    noise_frequency: NOISE_FREQUENCY = None,
    criterion: Annotated[
        Literal["h2", "iae"],
        typer.Option(help="minimised after a step of load: the norm (11), or the integral of the absolute error"),
    ] = "h2",
    delay_margin: Annotated[float, typer.Option(help="smallest delay margin [s]; 0 asks for none")] = 0.0,
    setpoint_command: Annotated[
        float | None, typer.Option(help="largest immediate command per unit set-point step [u/y unit]; default none")
    ] = None,
    kind: STRUCTURE = "pi",
    controller: Annotated[Path | None, typer.Option(help="also write the controller file (TOML) here")] = None,
    certificate: Annotated[bool, typer.Option(help="prove a lower bound on the H2 norm (PI on a model)")] = True,
    overwrite: OVERWRITE = False,
) -> None:
    """Design the PI or PID that rejects a step of load best under margins, on a model or straight on points."""
    if (model is None) == (points is None):
        raise InputError("give one of --model and --points", where="autotune design")
    place = Output(out, inputs=(model, points), overwrite=overwrite)  # refused before the method is imported
    law = None if controller is None else Output(controller, inputs=(model, points, out), overwrite=overwrite)
    from autotune.controller import write_controller
    from autotune.design.specification import Specification

    def asked(plant: TransferFunction, highest_rad_s: float | None = None) -> Specification:
        return Specification(
            modulus_margin=modulus_margin,
            phase_margin_rad=math.radians(phase_margin),
            noise_gain=_derive_noise_gain(plant, highest_rad_s) if noise_gain is None else noise_gain,
            noise=noise,
            noise_frequency_rad_s=noise_frequency,
            delay_margin_s=delay_margin,
            setpoint_command=math.inf if setpoint_command is None else setpoint_command,
            criterion=criterion,
        )

    if model is not None:
        designed = _on_model(model, asked, kind, certificate=certificate)
    else:
        assert points is not None
        designed = _on_points(points, asked, kind)
    place.json(designed.to_json())
    if law is not None:
        law.by(lambda part: write_controller(designed.controller, part))
    typer.echo(_sentence(designed))
    typer.echo(f"wrote {out}" + (f" and {controller}" if controller is not None else ""))


def _derive_noise_gain(plant: TransferFunction, highest_rad_s: float | None) -> float:
    """Return the noise gain that a plant asks for where the user does not, and say it."""
    from autotune.design.noise import LoopFacts, default_noise_gain

    allowed, words = default_noise_gain(plant, LoopFacts(), highest_rad_s)
    typer.echo(f"noise gain at most {allowed:.4g}: {words}")
    return allowed


def _on_model(model: Path, asked: Asked, kind: Kind, *, certificate: bool) -> Design:
    """Return the design on a model file, and say what it was checked on where the model is a reduced one."""
    from autotune.design.loop import transfer_function_of
    from autotune.design.synthesis import design
    from autotune.identification.reduced_file import read_reduced
    from autotune.model_file import read_model
    from autotune.pipeline.analysis import on_reduced_model

    H = transfer_function_of(read_model(model))
    wanted, reduced = asked(H), read_reduced(model)
    if reduced is None:
        return design(H, wanted, kind, certificate=certificate)
    designed, looked = on_reduced_model(reduced, wanted, kind, certificate=certificate)
    seen = "; ".join(check.sentence for check in looked) or designed.certificate
    typer.echo(f"designed on the reduced model; checked: {seen}")
    return designed


def _on_points(points: Path, asked: Asked, kind: Kind) -> Design:
    """Return the design on a file of points, or on the joint region of an identified loop's file, and say on what."""
    from autotune.design.on_fit import design_on_fit
    from autotune.design.specification import UNCERTAIN
    from autotune.identification.closed_loop.loop_plant import read_loop_region
    from autotune.identification.frequency.thinning import thin_points, thinning_note
    from autotune.identification.parametric import fit_plant
    from autotune.pipeline.analysis import of_use, on_measured
    from autotune.points import read_points, require_regions

    region = read_loop_region(points)
    of_loop = None if region is None else region.plant_fit()
    if of_loop is not None:
        typer.echo("designed on the joint region of the identified loop's coefficients")
        return design_on_fit(of_loop, asked(of_loop.plant), kind)
    from_file = read_points(points)
    require_regions(from_file, str(points))
    given = of_use(from_file)
    measured = list(thin_points(given))
    for note in thinning_note(len(given), len(measured)):
        typer.echo(f"note: {note}")
    fit = fit_plant(measured)
    source, designed, looked = on_measured(measured, fit, asked(fit.plant, measured[-1].omega_rad_s), kind)
    typer.echo(f"designed on the {source}; checked: " + "; ".join(check.sentence for check in looked))
    if UNCERTAIN in designed.certificate:
        typer.echo(f"warning: {designed.certificate}")
    return designed


def _sentence(designed: Design) -> str:
    c, m = designed.controller, designed.margins
    gains = f"K = {c.K:.5g}, Ti = {c.Ti_s:.4g} s"
    if designed.is_integral:
        gains = f"acts as an integral controller, K/Ti = {c.K / c.Ti_s:.5g} per s: {gains}"
    if designed.kind == "pid":
        gains += f", Td = {c.Td_s:.4g} s, Tf = {c.Tf_s:.3g} s"
    if c.setpoint_weight != 1.0:
        gains += f", set-point weight {c.setpoint_weight:.3g}"
    bound = f" (no smaller than {designed.h2_lower_bound:.5g})" if designed.h2_lower_bound is not None else ""
    binding = ", ".join(designed.binding) or "none"
    return (
        f"{designed.kind.upper()} {gains}: H2 {designed.h2:.5g}{bound}, modulus margin {m.modulus:.3f}, "
        f"phase margin {math.degrees(m.phase_rad):.1f} deg, delay margin {m.delay_s:.3g} s; binding: {binding}"
    )


@app.command("margins")
def margins_command(
    model: Annotated[Path, typer.Option(help="model file (TOML)")],
    controller: Annotated[Path, typer.Option(help="controller file (TOML), or a result.json")],
    out: Annotated[Path, typer.Option(help="file to write the margins to (JSON)")],
    noise_frequency: NOISE_FREQUENCY = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Compute the margins of a controller with a model; a sampled controller is taken with its hold."""
    place = Output(out, inputs=(model, controller), overwrite=overwrite)  # refused before the method is imported
    from autotune.controller import read_controller
    from autotune.design.margins import margins
    from autotune.model_file import read_model

    m = margins(read_model(model), read_controller(controller), noise_frequency_rad_s=noise_frequency)
    if math.isnan(m.modulus + m.phase_rad):
        raise InputError(
            "the loop's response leaves the range of numbers", where=str(controller), remedy="check its coefficients"
        )
    place.json(m.to_json())
    state = "stable" if m.stable else "UNSTABLE: the figures describe the Nyquist curve, not margins"
    typer.echo(
        f"{state}; modulus margin {m.modulus:.4f}, phase margin {math.degrees(m.phase_rad):.2f} deg, "
        f"delay margin {m.delay_s:.4g} s, gain margin {m.gain:.4g}, H2 {m.h2:.5g}"
    )
    typer.echo(f"wrote {out}")


#: what the controller is written as: a maker's form, or its law as code
if TYPE_CHECKING:
    Target: TypeAlias = str
else:
    Target = Literal[(*FORMS, "c", "st")]


@app.command("controller")
def controller_command(
    controller: Annotated[Path, typer.Option(help="controller file (TOML) of kind pi or pid, or a result.json")],
    form: Annotated[Target, typer.Option(help="a maker's form, or c or st for the law as code")] = "isa",
    sample_time: Annotated[float, typer.Option(help="time between samples, for velocity, c and st [s]")] = 0.01,
    u_span: U_SPAN = 1.0,
    y_span: Y_SPAN = 1.0,
    u_min: Annotated[float | None, typer.Option(help="lowest command, for c and st [u unit]; default none")] = None,
    u_max: Annotated[float | None, typer.Option(help="highest command, for c and st [u unit]; default none")] = None,
    u_rate: Annotated[float | None, typer.Option(help="fastest change, for c and st [u unit/s]; default none")] = None,
    out: Annotated[Path | None, typer.Option(help="file to write code to; default the screen")] = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Show a controller's gains as a maker's block takes them, or write its law as C or Structured Text."""
    from autotune.controller import PIDController, read_controller

    place = None if out is None else Output(out, inputs=(controller,), overwrite=overwrite)
    c = read_controller(controller)
    if not isinstance(c, PIDController):
        raise InputError(
            "has num and den", where=str(controller), remedy='forms are of controllers of kind "pi" or "pid"'
        )
    if form == "c" or form == "st":
        from autotune.design.codegen import c_source, structured_text
        from autotune.design.law import PILaw

        law = PILaw(
            controller=c,
            sample_time_s=sample_time,
            u_min=-math.inf if u_min is None else u_min,
            u_max=math.inf if u_max is None else u_max,
            u_rate=math.inf if u_rate is None else u_rate,
        )
        text = c_source(law) if form == "c" else structured_text(law)
    else:
        found = to_form(c, form, u_span=u_span, y_span=y_span, sample_time_s=sample_time)
        text = "".join(f"{name} = {value:.6g}\n" for name, value in found.values.items())
    if place is None:
        typer.echo(text, nl=False)
    else:
        place.text(text)
        typer.echo(f"wrote {out}")
