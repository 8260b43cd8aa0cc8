"""Command: delay identification."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from autotune.cli import identify
from autotune.cli.common import OVERWRITE
from autotune.cli.recordings import R, T, U, Y, read_one, signal_names
from autotune.outputs import Output

if TYPE_CHECKING:
    from autotune.identification.delay.model import DelayModel
    from autotune.recording import Recording


class Hold(StrEnum):
    """How u runs between rows."""

    zero = "zero"
    linear = "linear"


class PastInput(StrEnum):
    """What u was before the first row."""

    unknown = "unknown"
    held = "held"
    zero = "zero"


class DelayMethod(StrEnum):
    """How the delay is identified."""

    output_error = "output-error"
    algebraic = "algebraic"
    online = "online"


@identify.command("delay")
def identify_delay_command(
    recording: Annotated[Path, typer.Argument(help="recording of u and y")],
    out: Annotated[Path, typer.Option(help="file to write the model to, delay.json")],
    order: Annotated[int, typer.Option(min=1, max=4, help="order n of the model, 1 to 4")] = 2,
    max_delay: Annotated[
        float | None, typer.Option(min=0.0, help="largest delay considered [s]; default half the record")
    ] = None,
    hold: Annotated[
        Hold | None, typer.Option(help="u between rows; default the sidecar's hold, else zero (held command)")
    ] = None,
    past_input: Annotated[
        PastInput, typer.Option(help="u before the first row; unknown leaves out the rows of y that would need it")
    ] = PastInput.unknown,
    start: Annotated[
        float | None, typer.Option(help="time stamp from which y is used [s]; default the first row")
    ] = None,
    integrator: Annotated[bool, typer.Option("--integrator", help="the plant integrates: a0 = 0")] = False,
    offset: Annotated[bool, typer.Option(help="estimate a constant offset of u or y")] = True,
    coloured: Annotated[bool, typer.Option(help="allow coloured (autoregressive) noise")] = True,
    method: Annotated[
        DelayMethod,
        typer.Option(
            help="output-error is maximum likelihood; algebraic and online are modulating functions, on intervals or "
            "row by row"
        ),
    ] = DelayMethod.output_error,
    delays: Annotated[
        int, typer.Option(min=1, max=2, help="2: x'' + a x(t - h1) = b u(t - h2), the output is delayed as well")
    ] = 1,
    interval: Annotated[
        float | None,
        typer.Option(min=1e-6, help="length of the modulated intervals [s]; default a seventh of the record"),
    ] = None,
    forgetting: Annotated[
        float | None,
        typer.Option(min=1e-9, help="of --method online: rate of the kernels [1/s]; default 100 over the record"),
    ] = None,
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

    from autotune.identification.delay.identify import identify_delay
    from autotune.identification.delay.model import write_delay_model
    from autotune.identification.dependence import require_answer

    place = Output(out, inputs=(recording,), overwrite=overwrite)
    record = read_one(recording, signal_names(t, u, y, r))
    require_answer([record if hold is None else replace(record, metadata={**record.metadata, "hold": hold.value})])
    if delays == 2:
        place.json(_two_delays(record, interval))
        typer.echo(f"wrote {out}")
        return
    if method is not DelayMethod.output_error:
        model = _by_modulating(record, order, method, interval, forgetting, start_delay, hold)
        place.by(lambda part: write_delay_model(model, part))
        typer.echo(f"{describe(model)}; wrote {out}")
        return
    with Console(stderr=True).status("searching the delay") as status:
        model = identify_delay(
            record,
            order,
            max_delay_s=max_delay,
            hold=None if hold is None else hold.value,
            past_input=past_input.value,
            start_s=start,
            integrator=integrator,
            offset=offset,
            coloured=coloured,
            progress=lambda what, _: status.update(what),
        )
    place.by(lambda part: write_delay_model(model, part))
    typer.echo(f"{describe(model)}; wrote {out}")


def _by_modulating(
    record: Recording,
    order: int,
    method: DelayMethod,
    interval_s: float | None,
    forgetting: float | None,
    start_s: float | None,
    hold: Hold | None,
) -> DelayModel:
    from autotune.identification.delay.methods import algebraic_delay, online_delay

    held: Literal["zero", "linear"] | None = None if hold is None else ("zero" if hold is Hold.zero else "linear")
    if method is DelayMethod.online and start_s is not None:
        return online_delay(record, order, forgetting=forgetting, start_s=start_s, hold=held)
    found = algebraic_delay(record, order, interval_s=interval_s, start_s=start_s or 0.0, hold=held)
    if method is DelayMethod.algebraic:
        return found
    return online_delay(record, order, forgetting=forgetting, start_s=found.delay_s, hold=held)


def _two_delays(record: Recording, interval_s: float | None) -> dict[str, object]:
    """Return the content of the file of a model with two delays, and print it."""
    from autotune.identification.delay.two_delays import intervals_of, two_delays

    found = two_delays(record, intervals_of(record, interval_s))
    values, sd = found.values, found.standard_deviations
    names = ("a", "b", "h1", "h2")
    parts = [f"{name} {value:.5g} +- {1.96 * s:.2g}" for name, value, s in zip(names, values, sd, strict=True)]
    typer.echo(f"x'' + a x(t - h1) = b u(t - h2): {', '.join(parts)} (95 %)")
    return found.to_json()


def describe(model: DelayModel) -> str:
    """Return the model in a sentence: delay, gain and time constants with their 95 % intervals."""
    sd = model.standard_deviations
    n = model.order
    parts = [f"delay {model.delay_s:.4g} +- {1.96 * sd[n + 1]:.2g} s"]
    parts += [f"a{i} {value:.4g} +- {1.96 * sd[i]:.2g}" for i, value in enumerate(model.a)]
    parts.append(f"b {model.b:.4g} +- {1.96 * sd[n]:.2g}")
    colour = f"coloured (order {len(model.noise_ar)})" if model.noise_ar else "white"
    return f"{', '.join(parts)} (95 %), noise {colour}, sd {model.noise_sd:.3g}"
