"""``autotune identify closed-loop``: the plant from a recording of its loop. ``autotune dither``: make such a one."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer
from rich.console import Console

from autotune.cli import app, identify
from autotune.cli.common import OVERWRITE, ProgressBar, rig_of
from autotune.cli.recordings import R, T, U, Y, read_one, signal_names
from autotune.errors import InputError
from autotune.outputs import Output, claim

if TYPE_CHECKING:
    from autotune.identification.closed_loop.dither_proposal import DitherLimits
    from autotune.identification.closed_loop.identify import ClosedLoopIdentification
    from autotune.identification.closed_loop.state_space import InnovationModel
    from autotune.recording import Recording


#: How the plant is identified; the names of ``autotune.identification.closed_loop.methods``.
ClosedLoopMethod: TypeAlias = Literal[
    "prediction-error", "indirect", "indirect-refitted", "van-overschee", "oku-tanaka", "ort", "ssarx", "pbsid"
]
Columns: TypeAlias = list[str] | None


@identify.command("closed-loop")
def closed_loop(
    recording: Annotated[Path, typer.Argument(help="recording, with r where it is known", metavar="REC.csv")],
    out: Annotated[Path, typer.Option(help="JSON file to write the model and its response to")],
    order: Annotated[
        int | None, typer.Option(min=1, max=30, help="number of states; chosen from the data when absent")
    ] = None,
    delay: Annotated[
        int | None,
        typer.Option(min=0, help="dead time in whole samples beyond the first; with --order, default 0"),
    ] = None,
    controller: Annotated[
        Path | None,
        typer.Option(help="controller TOML: checked against the data, and says where the plant matters"),
    ] = None,
    max_order: Annotated[int, typer.Option(min=1, max=30, help="highest order tried without --order")] = 8,
    config: Annotated[
        Path | None, typer.Option(help="configuration of the rig: a dither is proposed within its limits")
    ] = None,
    method: Annotated[
        ClosedLoopMethod,
        typer.Option(help="prediction-error has regions, evidence and a verdict; the others are the papers' own"),
    ] = "prediction-error",
    more_u: Annotated[Columns, typer.Option(metavar="COLUMN", help="a further input; may be repeated")] = None,
    more_y: Annotated[Columns, typer.Option(metavar="COLUMN", help="a further output; may be repeated")] = None,
    more_r: Annotated[
        Columns, typer.Option(metavar="COLUMN", help="what was added to that further input; may be repeated")
    ] = None,
    f: Annotated[int | None, typer.Option("--f", min=1, help="rows of the future, of a subspace method")] = None,
    p: Annotated[int | None, typer.Option("--p", min=1, help="rows of the past, likewise")] = None,
    n_cl: Annotated[int | None, typer.Option("--n-cl", min=1, help="order of the loop, of the indirect method")] = None,
    psi: Annotated[str | None, typer.Option("--psi", help="its instrument: r, or 'r and y' (when absent)")] = None,
    t: T = None,
    u: U = None,
    y: Y = None,
    r: R = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Identify the plant from r, u and y recorded while its loop is closed."""
    place = Output(out, inputs=(recording, controller, config), overwrite=overwrite)  # refused before all imports
    from autotune.api import methods
    from autotune.controller import read_controller
    from autotune.identification.closed_loop.state_space import InnovationModel

    data = read_one(recording, signal_names(t, u, y, r))
    law = None if controller is None else read_controller(controller)
    windows = {"f": f, "p": p, "n_cl": n_cl, "Psi": psi}
    if method != "prediction-error" or more_u or more_y:
        if delay is not None or config is not None:
            raise InputError("--delay and --config are of prediction-error", where=method)
        more = more_u or [], more_y or [], more_r or []
        model = methods.closed_loop(data, order, controller=law, method=method, more=more, **windows)
        assert isinstance(model, InnovationModel)
        place.json(_model_json(model, method))
        poles = ", ".join(f"{pole:.4g}" for pole in model.poles)
        typer.echo(f"order {model.order} by {method}, poles {poles}")
    elif any(value is not None for value in windows.values()):
        raise InputError("--f, --p, --n-cl and --psi are of the other methods", where="prediction-error")
    else:
        limits = None if config is None else _limits(config)
        _identify_with_regions(data, place, order, controller=law, delay=delay, max_order=max_order, limits=limits)
    typer.echo(f"wrote {out}")


def _identify_with_regions(data: Recording, place: Output, order: int | None, **settings: Any) -> None:
    """Identify by prediction errors, write the model with its regions, and say what it is worth."""
    from autotune.api import methods
    from autotune.identification.closed_loop.identify import ClosedLoopIdentification

    console = Console(stderr=True, highlight=False)
    with console.status("reading the loop") as status:
        settings["progress"] = lambda what, _: status.update(f"fitting {what}")
        result = methods.closed_loop(data, order, **settings)
    assert isinstance(result, ClosedLoopIdentification)
    place.json(closed_loop_json(result))
    for warning in result.warnings:
        console.print(f"warning: {warning}", markup=False, soft_wrap=True)
    typer.echo(summary(result))


def _model_json(model: InnovationModel, method: str) -> dict[str, Any]:
    """Return the content of ``closed_loop.json`` of a model without regions."""
    single = model.B.shape[1] == 1 and len(model.C) == 1
    content: dict[str, Any] = {
        "method": method,
        "order": model.order,
        "input_delay": model.input_delay,
        "sample_time_s": model.sample_time_s,
    }
    if single:
        num, den = model.polynomials()
        content |= {"num": num.tolist(), "den": den.tolist()}
        content["noise_variance"] = float(model.innovation_covariance[0, 0])
    content["poles"] = [[pole.real, pole.imag] for pole in model.poles]
    return content | state_space_json(model)


def state_space_json(model: InnovationModel) -> dict[str, Any]:
    """Return the model's matrices and its noise model, H = noise_num / den where there is one output."""
    import numpy as np

    matrices = {name: getattr(model, name).tolist() for name in ("A", "B", "C", "D", "K")}
    noise: dict[str, Any] = {"covariance": model.innovation_covariance.tolist()}
    if len(model.C) == 1:
        den = np.real(np.poly(model.A))
        impulse = [1.0]
        x = model.K
        for _ in range(model.order):
            impulse.append(float((model.C @ x)[0, 0]))
            x = model.A @ x
        noise["num"] = np.convolve(den, impulse)[: model.order + 1].tolist()
        noise["den"] = den.tolist()
    return {"state_space": matrices, "noise_model": noise}


def _limits(config: Path) -> DitherLimits:
    from autotune.config import load_config
    from autotune.experiment.dither import LARGEST_DEPARTURE, LARGEST_SHARE
    from autotune.identification.closed_loop.dither_proposal import DitherLimits

    limits = load_config(config).limits
    return DitherLimits(
        amplitude=LARGEST_SHARE * 0.5 * (limits.u_max - limits.u_min),
        departure=LARGEST_DEPARTURE * limits.swing,
        source="a third of the rig's limits",
    )


def closed_loop_json(result: ClosedLoopIdentification) -> dict[str, Any]:
    """Return the content of ``closed_loop.json``.

    ``response`` is that of the polynomials; ``points`` is the plant's own, without the command's hold, at as many
    frequencies as are independent, so that the file can be given to ``autotune tune --points`` as it is.
    ``plant_region`` has the coefficients with their joint covariance, on which ``autotune design --points`` designs.
    """
    from autotune.identification.closed_loop.loop_plant import loop_region
    from autotune.points import points_to_json

    model = result.estimate.model
    region = loop_region(result.structures)
    num, den = model.polynomials()
    verdict = result.excitation
    content: dict[str, Any] = {
        "order": model.order,
        "input_delay": model.input_delay,
        "sample_time_s": model.sample_time_s,
        "num": num.tolist(),
        "den": den.tolist(),
        "poles": [[pole.real, pole.imag] for pole in result.poles],
        "pole_cov": result.pole_covariance.tolist(),
        "noise_variance": float(model.innovation_covariance[0, 0]),
        "response": points_to_json(result.response),
        "points": points_to_json(result.design_points),
        "plant_region": None if region is None else region.to_json(),
        "excitation": {
            "enough": verdict.enough,
            "band_rad_s": list(verdict.band_rad_s),
            "relative_sd": verdict.relative_sd,
            "amplitude_factor": verdict.amplitude_factor,
            "length_factor": verdict.length_factor,
            "verdict": verdict.sentence,
        },
        "dither_proposal": None if result.proposal is None else asdict(result.proposal),
        "residuals_white_probability": result.whiteness.probability,
        "order_evidence": [
            {"order": c.order, "delay": c.delay, "relative_innovation_sd": c.innovation_sd, "bic": c.bic}
            for c in result.evidence
        ],
        "warnings": list(result.warnings),
        **state_space_json(model),
    }
    if result.law is not None:
        share = result.law.beyond_rounding
        content["controller"] = {
            "unexplained": share if math.isfinite(share) else None,
            "r_enters_at": result.law.summation,
        }
    return content


def summary(result: ClosedLoopIdentification) -> str:
    """Return model and excitation in a sentence or two."""
    model = result.estimate.model
    poles = ", ".join(
        f"{p.real:.4g}" + (f" ± {p.imag:.4g}i" if p.imag > 0 else "") for p in result.poles if p.imag >= 0
    )
    late = f" and {model.input_delay} samples of dead time" if model.input_delay else ""
    sd = math.sqrt(float(model.innovation_covariance[0, 0]))
    of_model = f"order {model.order}{late}, poles {poles}, innovation sd {sd:.3g}"
    return f"{of_model}; {_alternatives_text(result)}{result.excitation.sentence}"


def _alternatives_text(result: ClosedLoopIdentification) -> str:
    """Return what is said of other orders and dead times that the record leaves open; nothing where there are none."""
    from autotune.identification.closed_loop.loop_plant import PROBABLE

    others = result.structures.probable(PROBABLE)
    if not others:
        return ""
    models = [one.model for one in (result.estimate, *others)]
    orders, delays = ([one.order for one in models], [one.input_delay for one in models])
    return (
        f"the record leaves orders {min(orders)} to {max(orders)} and {min(delays)} to {max(delays)} samples of dead "
        "time open, which count in the regions; "
    )


@app.command()
def dither(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="configuration of the rig, with [controller]")],
    out: Annotated[Path, typer.Option(help="CSV to write: t,u,y,r,dither")],
    duration: Annotated[
        float | None, typer.Option(min=1.0, help="time under dither [s]; experiment.budget_s when absent")
    ] = None,
    amplitude: Annotated[
        float | None,
        typer.Option(min=1e-12, help="half-amplitude of the dither [u unit]; found on the rig when absent"),
    ] = None,
    dwell: Annotated[
        tuple[float, float] | None,
        typer.Option(help="shortest and longest dwell [s]; a sample and a fiftieth of the duration when absent"),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="of the random dwell times")] = 0,
) -> None:
    """Add a dither to the rig's present controller and record r, u and y, within the limits of the config."""
    from autotune.config import load_config
    from autotune.experiment.dither import run_dither

    content = load_config(config)
    if out.with_suffix(".toml").resolve() == config.resolve():
        raise InputError(
            f"the recording's sidecar {out.with_suffix('.toml')} would overwrite the configuration",
            where="--out",
            remedy="give the recording another name",
        )
    rig = rig_of(content)
    claim(out, inputs=(config,))
    if out.with_suffix(".toml").exists():
        raise InputError("exists already", where=str(out.with_suffix(".toml")), remedy="give --out another name")
    with ProgressBar() as bar:
        done = run_dither(
            rig, content, out, duration_s=duration, amplitude=amplitude, dwell_s=dwell, seed=seed, on_status=bar.show
        )
    unit_u, unit_y = content.signals.u_unit, content.signals.y_unit
    typer.echo(
        f"{done.duration_s:g} s under K = {done.controller.K:g}, Ti = {done.controller.Ti_s:g} s with a dither of "
        f"{done.amplitude:.3g} {unit_u}; y stayed within {done.departure:.3g} {unit_y} of the set-point"
    )
    typer.echo(f"wrote {out}; now: autotune identify closed-loop {out} --out closed_loop.json")
