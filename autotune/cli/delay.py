"""Commands: delay identification, and the on-line estimator that watches a loop."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from autotune.cli import identify

if TYPE_CHECKING:
    from autotune.identification.delay_model import DelayModel


class Hold(StrEnum):
    """How u runs between rows."""

    zero = "zero"
    linear = "linear"


class PastInput(StrEnum):
    """What u was before the first row."""

    unknown = "unknown"
    held = "held"
    zero = "zero"


@identify.command("delay")
def identify_delay_command(
    recording: Annotated[Path, typer.Argument(help="recording, CSV with columns t,u,y")],
    out: Annotated[Path, typer.Option(help="file to write the model to, delay.json")],
    order: Annotated[int, typer.Option(min=1, max=4, help="order n of the model, 1 to 4")] = 2,
    max_delay: Annotated[
        float | None, typer.Option(help="largest delay considered [s]; default half the record")
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
) -> None:
    """Identify x^(n) = sum a_i x^(i) + b u(t - h) from a recording; no starting value is needed."""
    from rich.console import Console

    from autotune.identification.delay import identify_delay
    from autotune.identification.delay_model import write_delay_model
    from autotune.recording import read_recording

    record = read_recording(recording)
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
            progress=lambda stage: status.update(stage),
        )
    write_delay_model(model, out)
    typer.echo(f"{describe(model)}; wrote {out}")


def describe(model: DelayModel) -> str:
    """Return the model in a sentence: delay, gain and time constants with their 95 % intervals."""
    sd = model.standard_deviations
    n = model.order
    parts = [f"delay {model.delay_s:.4g} +- {1.96 * sd[n + 1]:.2g} s"]
    parts += [f"a{i} {value:.4g} +- {1.96 * sd[i]:.2g}" for i, value in enumerate(model.a)]
    parts.append(f"b {model.b:.4g} +- {1.96 * sd[n]:.2g}")
    colour = f"coloured (order {len(model.noise_ar)})" if model.noise_ar else "white"
    return f"{', '.join(parts)} (95 %), noise {colour}, sd {model.noise_sd:.3g}"
