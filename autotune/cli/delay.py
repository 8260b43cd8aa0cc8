"""Commands: delay identification, and the on-line estimator that watches a loop."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from autotune.cli import app, identify

if TYPE_CHECKING:
    from autotune.controller import Controller
    from autotune.identification.delay_model import DelayModel
    from autotune.identification.tracking import Window


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


@app.command()
def watch(
    recording: Annotated[
        Path, typer.Argument(help="recording of normal operation, CSV with t,u,y; it may still be growing (--follow)")
    ],
    out: Annotated[Path, typer.Option(help="CSV file for the parameters over time with their standard deviations")],
    controller: Annotated[
        Path | None, typer.Option(help="the deployed controller, TOML; its margins are judged on the tracked model")
    ] = None,
    order: Annotated[int, typer.Option(min=1, max=4, help="order n of the tracked model, 1 to 4")] = 2,
    window: Annotated[float | None, typer.Option(help="length of y each fit uses [s]; default a fifth of it")] = None,
    every: Annotated[float | None, typer.Option(help="time between fits [s]; default a quarter of the window")] = None,
    max_delay: Annotated[float | None, typer.Option(help="largest delay considered [s]; default half a window")] = None,
    modulus_margin: Annotated[float, typer.Option(help="modulus margin to be kept, 0 to 1")] = 0.5,
    phase_margin: Annotated[float, typer.Option(help="phase margin to be kept [deg]")] = 45.0,
    hold: Annotated[Hold | None, typer.Option(help="u between rows; default the sidecar's hold, else zero")] = None,
    integrator: Annotated[bool, typer.Option("--integrator", help="the plant integrates: a0 = 0")] = False,
    follow: Annotated[
        float, typer.Option(help="go on while the file grows, until it has not for this long [s]; 0: do not wait")
    ] = 0.0,
) -> None:
    """Track gain, time constants and dead time over a recording, and say when the controller wants retuning."""
    import time

    from autotune.controller import read_controller
    from autotune.identification.tracking import track
    from autotune.recording import read_recording

    law = None if controller is None else read_controller(controller)
    record = read_recording(recording)
    length = window if window is not None else 0.2 * record.duration_s
    step = every if every is not None else 0.25 * length
    required = (modulus_margin, phase_margin)
    done, quiet_since, rows, retune_at = -float("inf"), time.monotonic(), len(record), None
    with out.open("w", encoding="utf-8") as table:
        while True:
            fits = track(
                record,
                order,
                window_s=length,
                every_s=step,
                max_delay_s=max_delay,
                hold=None if hold is None else hold.value,
                integrator=integrator,
                after_s=done,
            )
            for fitted in fits:
                verdict = _report(fitted, law, required, table, header=table.tell() == 0)
                done = fitted.end_s
                if verdict == "retune" and retune_at is None:
                    retune_at = fitted.end_s
            if time.monotonic() - quiet_since >= follow:
                break
            time.sleep(min(1.0, step))
            record = read_recording(recording)
            if len(record) > rows:
                rows, quiet_since = len(record), time.monotonic()
    if retune_at is not None:
        typer.echo(f"retune: the controller misses its margins on the tracked model since t = {retune_at:.4g} s")
    typer.echo(f"wrote {out}")


def _report(
    fitted: Window, law: Controller | None, required: tuple[float, float], table: TextIO, *, header: bool
) -> str:
    """Write one window to the table and to the terminal, and return the verdict on the controller, empty without."""
    import math

    from autotune.identification.tracking import quantities
    from autotune.watch import advise

    if fitted.model is None:
        typer.echo(f"t {fitted.end_s:.4g} s: not determined: {fitted.reason}")
        return ""
    found = quantities(fitted.model)
    line = ", ".join(f"{q.name} {q.value:.4g} +- {1.96 * q.sd:.2g} {q.unit}" for q in found)
    cells = [fitted.end_s, *(value for q in found for value in (q.value, q.sd))]
    names = ["t", *(name for q in found for name in (q.name.replace(" ", "_"), f"{q.name.replace(' ', '_')}_sd"))]
    verdict = ""
    if law is not None:
        advice = advise(fitted.model, law, modulus_margin=required[0], phase_margin_rad=math.radians(required[1]))
        verdict = advice.verdict
        phase, phase_sd = math.degrees(advice.phase_rad), math.degrees(advice.phase_sd_rad)
        line += f"; modulus {advice.modulus:.3f} +- {1.96 * advice.modulus_sd:.2g}"
        line += f", phase {phase:.1f} +- {1.96 * phase_sd:.2g} deg: {verdict}"
        cells += [advice.modulus, advice.modulus_sd, phase, phase_sd]
        names += ["modulus", "modulus_sd", "phase_deg", "phase_deg_sd"]
    if header:
        table.write(",".join([*names, *(["verdict"] if verdict else [])]) + "\n")
    table.write(",".join([*(f"{value:.9g}" for value in cells), *([verdict] if verdict else [])]) + "\n")
    table.flush()
    typer.echo(f"t {fitted.end_s:.4g} s: {line}")
    return verdict
