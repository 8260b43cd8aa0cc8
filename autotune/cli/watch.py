"""Command: what is watched of a loop, over a recording, a file that grows, or a rig."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from autotune.cli import app
from autotune.cli.common import INTEGRATOR, OVERWRITE, new_folder, rig_of
from autotune.cli.delay import Hold
from autotune.cli.recordings import R, T, U, Y, read_one, signal_names
from autotune.errors import InputError
from autotune.outputs import Output

if TYPE_CHECKING:
    from autotune.controller import Controller
    from autotune.files import SignalNames
    from autotune.identification.delay.tracking import Window
    from autotune.recording import Recording

_ORDER = Annotated[
    int | None,
    typer.Option(
        min=1, max=4, help="order n of the tracked model, 1 to 4; default 2 or 1, what the recording determines"
    ),
]
_FOLLOW = Annotated[
    float,
    typer.Option(
        min=0.0, max=1e6, help="go on while the recording grows, until it has not for this long [s]; 0: do not wait"
    ),
]


@dataclass(frozen=True, kw_only=True)
class _Tracking:
    """What is tracked and judged; order and times [s] are None where they follow from the record."""

    order: int | None
    window_s: float | None
    every_s: float | None
    max_delay_s: float | None
    hold: Hold | None
    integrator: bool
    controller: Controller | None
    modulus_margin: float
    phase_margin_rad: float
    names: SignalNames


@app.command()
def watch(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="REC.csv|CONFIG.toml",
            help="recording of normal operation, or configuration of a rig whose present loop is to run and be watched",
        ),
    ],
    out: Annotated[Path, typer.Option(help="CSV file for the parameters over time; with CONFIG a new folder")],
    controller: Annotated[
        Path | None, typer.Option(help="the deployed controller, TOML; its margins are judged on the tracked model")
    ] = None,
    order: _ORDER = None,
    window: Annotated[
        float | None, typer.Option(min=1e-6, help="length of y each fit uses [s]; default a fifth of it")
    ] = None,
    every: Annotated[
        float | None, typer.Option(min=1e-6, help="time between fits [s]; default a quarter of the window")
    ] = None,
    max_delay: Annotated[
        float | None, typer.Option(min=0.0, help="largest delay considered [s]; default half a window")
    ] = None,
    modulus_margin: Annotated[float, typer.Option(min=0.01, max=0.99, help="modulus margin to be kept, 0 to 1")] = 0.5,
    phase_margin: Annotated[float, typer.Option(min=0.1, max=89.9, help="phase margin to be kept [deg]")] = 45.0,
    hold: Annotated[Hold | None, typer.Option(help="u between rows; default the sidecar's hold, else zero")] = None,
    integrator: INTEGRATOR = False,
    follow: _FOLLOW = 0.0,
    duration: Annotated[float, typer.Option(min=1.0, max=1e7, help="with CONFIG: time on the rig [s]")] = 300.0,
    dither: Annotated[
        float | None, typer.Option(help="with CONFIG: half-amplitude added to the command [u unit]; found when absent")
    ] = None,
    t: T = None,
    u: U = None,
    y: Y = None,
    r: R = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Track gain, time constants and dead time, and say when the controller wants retuning.

    With a recording, one that another program is still writing included, nothing is commanded. With a configuration
    the present controller runs the rig with a small dither, without which a loop at rest tells nothing.
    """
    from autotune.controller import read_controller

    settings = _Tracking(
        order=order,
        window_s=window,
        every_s=every,
        max_delay_s=max_delay,
        hold=hold,
        integrator=integrator,
        controller=None if controller is None else read_controller(controller),
        modulus_margin=modulus_margin,
        phase_margin_rad=math.radians(phase_margin),
        names=signal_names(t, u, y, r),
    )
    if source.suffix.lower() != ".toml":
        _follow(source, Output(out, inputs=(source, controller), overwrite=overwrite), settings, follow)
    else:
        _watch_rig(source, out, settings, duration, dither)


def _watch_rig(source: Path, out: Path, settings: _Tracking, duration_s: float, dither: float | None) -> None:
    """Run the present loop here and fit in another process, so that no fit ever delays a command."""
    import multiprocessing

    from autotune.config import load_config
    from autotune.controller import PIDController
    from autotune.experiment.dither import run_dither
    from autotune.experiment.warm import warm_up
    from autotune.interrupts import interrupt_held

    config = load_config(source)
    if settings.controller is None and config.controller is not None:
        settings = replace(settings, controller=PIDController(K=config.controller.K, Ti_s=config.controller.Ti_s))
    if settings.window_s is None:
        settings = replace(settings, window_s=0.2 * duration_s)
    new_folder(out, ("recording.csv", "recording.toml", "watch.csv"))
    warm_up()  # a first compilation may take longer than a recording may be quiet
    recording = out / "recording.csv"
    quiet_s = max(5.0, 20.0 * config.signals.sample_time_s)
    fits = multiprocessing.get_context("spawn").Process(
        target=_follow, args=(recording, Output(out / "watch.csv"), settings, quiet_s)
    )
    with interrupt_held():  # Ctrl-C is for this process, which ends the recording, which ends the fits
        fits.start()
    try:
        run_dither(rig_of(config), config, recording, duration_s=duration_s, amplitude=dither)
    finally:
        if not recording.exists():  # nothing will ever come
            fits.terminate()
        fits.join()


def _follow(recording: Path, out: Output, settings: _Tracking, quiet_s: float) -> None:
    """Fit window after window of a recording that may be growing, until it has been quiet for so long [s]."""
    import time

    from autotune.identification.delay.tracking import track

    while quiet_s > 0.0 and not recording.exists():
        time.sleep(0.1)
    after, done, retune_at, rows, size, reason = -math.inf, -math.inf, None, -1, -1, ""
    quiet_since = time.monotonic()
    with out.growing() as table:
        while True:
            record, grown = None, recording.stat().st_size
            if grown > size:  # it may grow for long before the loop is in operation
                size, quiet_since = grown, time.monotonic()
                record = _of_operation(recording, settings) if quiet_s == 0.0 else _readable(recording, settings)
            if record is not None and len(record) > rows:
                rows = len(record)
                length = settings.window_s if settings.window_s is not None else 0.2 * record.duration_s
                if quiet_s == 0.0 or record.t[-1] - record.t[0] >= length:
                    settings = settings if settings.order else _with_structure(record, settings, length)
                    for fitted in track(
                        record,
                        settings.order or 2,
                        window_s=length,
                        every_s=settings.every_s if settings.every_s is not None else 0.25 * length,
                        max_delay_s=settings.max_delay_s,
                        hold=settings.hold,
                        integrator=settings.integrator,
                        after_s=after,
                    ):
                        verdict, reason = _report(fitted, settings, table, reason), fitted.reason
                        after, done = fitted.end_s, max(done, fitted.end_s if fitted.model else done)
                        if verdict == "retune" and retune_at is None:
                            retune_at = fitted.end_s
            if time.monotonic() - quiet_since >= quiet_s:
                break
            time.sleep(0.2)
    if retune_at is not None:
        typer.echo(f"retune: the controller misses its margins on the tracked model since t = {retune_at:.4g} s")
    nothing = f"no window determined the model; {out.path} was not written"
    typer.echo(f"wrote {out.path}" if done > -math.inf else nothing)


def _with_structure(record: Recording, settings: _Tracking, window_s: float) -> _Tracking:
    """Return the settings with the order that the record determines, and say it."""
    from autotune.identification.delay.tracking import choose_structure

    chosen = choose_structure(
        record,
        window_s=window_s,
        max_delay_s=settings.max_delay_s,
        hold=settings.hold,
        integrator=settings.integrator,
    )
    if chosen is None:  # each window says why
        return settings
    kind = "an integrating plant" if chosen.integrator else "a plant"
    typer.echo(f"{kind} of order {chosen.order} is tracked, as the recording determines; --order sets another")
    return replace(settings, order=chosen.order, integrator=chosen.integrator)


def _in_operation(record: Recording) -> Recording | None:
    """Leave out the rows before the first set-point, as the plant may be at a stop; None where there is none."""
    import numpy as np

    if "r" not in record.extra:
        return record
    closed = record.t[np.isfinite(record.extra["r"])]
    return record.between(float(closed[0]), np.inf) if closed.size > 1 else None


def _of_operation(recording: Path, settings: _Tracking) -> Recording:
    """Return a finished recording of the loop in operation."""
    record = _in_operation(read_one(recording, settings.names))
    if record is None:
        raise InputError(
            "column 'r' has no set-point in any row", where=str(recording), remedy="record the loop in operation"
        )
    return record


def _readable(recording: Path, settings: _Tracking) -> Recording | None:
    """Return what a growing recording holds of the loop in operation, None while that is less than two rows."""
    from autotune.files import read_recordings

    try:
        return _in_operation(read_recordings(recording, settings.names).longest)
    except InputError:
        return None


def _report(fitted: Window, settings: _Tracking, table: TextIO, before: str) -> str:
    """Write one window to the table and to the terminal, and return the verdict on the controller, empty without.

    A reason that is that of the window before is not said again.
    """
    from autotune.identification.delay.tracking import quantities
    from autotune.watch import advise

    if fitted.model is None:
        why = ", as before" if fitted.reason == before else f": {fitted.reason}"
        typer.echo(f"t {fitted.end_s:.4g} s: not determined{why}")
        return ""
    found = quantities(fitted.model)
    line = ", ".join(f"{q.name} {q.value:.4g} +- {1.96 * q.sd:.2g} {q.unit}" for q in found)
    cells = [fitted.end_s, *(value for q in found for value in (q.value, q.sd))]
    names = ["t", *(name for q in found for name in (q.name.replace(" ", "_"), f"{q.name.replace(' ', '_')}_sd"))]
    verdict = ""
    if settings.controller is not None:
        advice = advise(
            fitted.model,
            settings.controller,
            modulus_margin=settings.modulus_margin,
            phase_margin_rad=settings.phase_margin_rad,
        )
        verdict = advice.verdict
        phase, phase_sd = math.degrees(advice.phase_rad), math.degrees(advice.phase_sd_rad)
        line += f"; modulus {advice.modulus:.3f} +- {1.96 * advice.modulus_sd:.2g}"
        line += f", phase {phase:.1f} +- {1.96 * phase_sd:.2g} deg: {verdict}"
        cells += [advice.modulus, advice.modulus_sd, phase, phase_sd]
        names += ["modulus", "modulus_sd", "phase_deg", "phase_deg_sd"]
    if table.tell() == 0:
        table.write(",".join([*names, *(["verdict"] if verdict else [])]) + "\n")
    table.write(",".join([*(f"{value:.9g}" for value in cells), *([verdict] if verdict else [])]) + "\n")
    table.flush()
    typer.echo(f"t {fitted.end_s:.4g} s: {line}")
    return verdict
