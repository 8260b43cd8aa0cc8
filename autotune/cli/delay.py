"""Command: delay identification."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer

from autotune.cli import identify
from autotune.cli.common import INTEGRATOR, OVERWRITE
from autotune.cli.recordings import R, T, U, Y, read_one, signal_names
from autotune.outputs import Output

if TYPE_CHECKING:
    from autotune.identification.delay.model import DelayModel
    from autotune.identification.delay.two_delays import TwoDelays


#: How u runs between rows.
Hold: TypeAlias = Literal["zero", "linear"]

_METHOD = Annotated[
    Literal["output-error", "algebraic", "online"],
    typer.Option(
        help="output-error is maximum likelihood; algebraic and online are modulating functions, on intervals or "
        "row by row"
    ),
]
_INTERVAL = Annotated[
    float | None, typer.Option(min=1e-6, help="length of the modulated intervals [s]; default a seventh of the record")
]
_FORGETTING = Annotated[
    float | None,
    typer.Option(min=1e-9, help="of --method online: rate of the kernels [1/s]; default 100 over the record"),
]


@identify.command("delay")
def identify_delay_command(
    recording: Annotated[Path, typer.Argument(metavar="REC.csv", help="recording of u and y")],
    out: Annotated[Path, typer.Option(help="file to write the model to, delay.json")],
    order: Annotated[int, typer.Option(min=1, max=4, help="order n of the model, 1 to 4")] = 2,
    max_delay: Annotated[
        float | None, typer.Option(min=0.0, help="largest delay considered [s]; default half the record")
    ] = None,
    hold: Annotated[
        Hold | None, typer.Option(help="u between rows; default the sidecar's hold, else zero (held command)")
    ] = None,
    past_input: Annotated[
        Literal["unknown", "held", "zero"],
        typer.Option(help="u before the first row; unknown leaves out the rows of y that would need it"),
    ] = "unknown",
    start: Annotated[
        float | None, typer.Option(help="time stamp from which y is used [s]; default the first row")
    ] = None,
    integrator: INTEGRATOR = False,
    offset: Annotated[bool, typer.Option(help="estimate a constant offset of u or y")] = True,
    coloured: Annotated[bool, typer.Option(help="allow coloured (autoregressive) noise")] = True,
    method: _METHOD = "output-error",
    delays: Annotated[
        int, typer.Option(min=1, max=2, help="2: x'' + a x(t - h1) = b u(t - h2), the output is delayed as well")
    ] = 1,
    interval: _INTERVAL = None,
    forgetting: _FORGETTING = None,
    start_delay: Annotated[
        float | None, typer.Option(min=0.0, help="starting value of the delay [s]; found when absent")
    ] = None,
    t: T = None,
    u: U = None,
    y: Y = None,
    r: R = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Identify x^(n) = sum a_i x^(i) + b u(t - h) from a recording; no starting value is needed."""
    from rich.console import Console

    place = Output(out, inputs=(recording,), overwrite=overwrite)  # refused before the method is imported
    from autotune.api import methods
    from autotune.identification.delay.model import DelayModel

    record = read_one(recording, signal_names(t, u, y, r))
    if hold is not None:
        record = replace(record, metadata={**record.metadata, "hold": hold})
    settings: dict[str, Any] = {}
    with Console(stderr=True).status("searching the delay") as status:
        if delays == 1 and method == "output-error":
            interval = None
            settings = {"max_delay_s": max_delay, "past_input": past_input, "start_s": start}
            settings |= {"integrator": integrator, "offset": offset, "coloured": coloured}
            settings["progress"] = lambda what, _: status.update(what)
        elif delays == 1:
            settings = {} if start_delay is None else {"start_s": start_delay}
            settings |= {"forgetting": forgetting} if method == "online" else {}
        model = methods.delay(record, order, method=method, delays=delays, interval_s=interval, **settings)
    place.json(model.to_json())
    said = f"{describe(model)}; " if isinstance(model, DelayModel) else f"{_describe_two(model)}\n"
    typer.echo(f"{said}wrote {out}")


def _describe_two(model: TwoDelays) -> str:
    """Return a model with two delays in a sentence, with its 95 % intervals."""
    names, sd = ("a", "b", "h1", "h2"), model.standard_deviations
    parts = [f"{name} {value:.5g} +- {1.96 * s:.2g}" for name, value, s in zip(names, model.values, sd, strict=True)]
    return f"x'' + a x(t - h1) = b u(t - h2): {', '.join(parts)} (95 %)"


def describe(model: DelayModel) -> str:
    """Return the model in a sentence: delay, gain and time constants with their 95 % intervals."""
    sd = model.standard_deviations
    n = model.order
    parts = [f"delay {model.delay_s:.4g} +- {1.96 * sd[n + 1]:.2g} s"]
    parts += [f"a{i} {value:.4g} +- {1.96 * sd[i]:.2g}" for i, value in enumerate(model.a)]
    parts.append(f"b {model.b:.4g} +- {1.96 * sd[n]:.2g}")
    order = model.whitening.lost
    colour = f"coloured (order {order})" if order else "white"
    load = " beside a wandering load" if model.noise_ma else ""
    return f"{', '.join(parts)} (95 %), noise {colour}{load}, sd {model.noise_sd:.3g}"
