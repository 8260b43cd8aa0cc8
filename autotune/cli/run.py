"""Commands: the whole chain, from a config file to a verified controller, and from recordings to a controller."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from autotune.cli import app

if TYPE_CHECKING:
    from autotune.config import Config
    from autotune.experiment.result import Progress
    from autotune.experiment.rig import Rig

_OUT = Annotated[Path, typer.Option(metavar="DIR", help="new folder for recordings, result.json and report.html")]


@app.command()
def run(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="configuration of the rig")],
    out: _OUT,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="run the rig's simulated twin instead of the rig")] = False,
    verify: Annotated[bool, typer.Option(help="try the new loop on the rig")] = True,
    deploy: Annotated[bool, typer.Option(help="write accepted gains into the rig's own controller")] = True,
) -> None:
    """Commission a rig: relay sweep, Bode points, reduced model, controller, verification, report."""
    from autotune.config import load_config
    from autotune.pipeline import RECORDING, tune
    from autotune.recording import read_recording
    from autotune.report.page import write_page
    from autotune.report.run_page import run_page

    content = load_config(config)
    rig = _rig(content, dry_run)
    _new_folder(out, RECORDING)
    with _Bar() as bar:
        tuning = tune(rig, content, out, verify=verify, deploy=deploy, on_progress=bar.show)
    page = run_page(content.name, content.signals, read_recording(out / RECORDING), tuning)
    write_page(page, out / "report.html")
    console = Console(highlight=False, soft_wrap=True)
    for warning in (*tuning.experiment.warnings, *tuning.analysis.warnings):
        console.print(f"warning: {warning}", markup=False)
    console.print(page.verdict, markup=False)
    console.print(f"report: {out / 'report.html'}", markup=False)


def _rig(config: Config, dry_run: bool) -> Rig:
    from autotune.controller import PIDController
    from drivers import open_rig, twin_of

    given = config.controller
    return open_rig(
        twin_of(config.rig) if dry_run else config.rig,
        u_range=(config.limits.u_min, config.limits.u_max),
        u_safe=config.limits.u_safe,
        controller=PIDController(K=given.K, Ti_s=given.Ti_s) if given else None,
    )


def _new_folder(out: Path, holds: str) -> None:
    from autotune.errors import InputError

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", where=str(out), mend="choose another --out") from None
    if (out / holds).exists():
        raise InputError("holds a run already", where=str(out), mend="choose another --out; nothing is overwritten")


class _Bar:
    """A progress bar that the procedure drives; it draws on terminals only."""

    def __init__(self) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[left]}"), TimeRemainingColumn(),
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._progress.add_task("connecting", total=1.0, left="")

    def show(self, progress: Progress) -> None:
        left = f"{progress.remaining_s:.0f} s of rig time left" if progress.fraction > 0 else ""
        text = f"{progress.state.value}: {progress.message}"
        self._progress.update(self._task, completed=progress.fraction, description=text, left=left)

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
