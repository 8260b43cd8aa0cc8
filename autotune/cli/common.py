"""What several commands share: the rig of a configuration, a new folder for its files, a progress bar."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

if TYPE_CHECKING:
    from autotune.config import Config
    from autotune.experiment.result import Progress
    from autotune.experiment.rig import Rig


def rig_of(config: Config, dry_run: bool = False) -> Rig:
    """Return the rig that the configuration describes, or its simulated twin; nothing has been sent to it."""
    from autotune.controller import PIDController
    from drivers import open_rig, twin_of

    given = config.controller
    return open_rig(
        twin_of(config.rig) if dry_run else config.rig,
        u_range=(config.limits.u_min, config.limits.u_max),
        u_safe=config.limits.u_safe,
        controller=PIDController(K=given.K, Ti_s=given.Ti_s) if given else None,
    )


def new_folder(out: Path, holds: str) -> None:
    """Make the folder of a run; refuse one in which the file ``holds`` is already."""
    from autotune.errors import InputError

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", where=str(out), remedy="choose another --out") from None
    if (out / holds).exists():
        raise InputError("holds a run already", where=str(out), remedy="choose another --out; nothing is overwritten")


class ProgressBar:
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
        """Show where the procedure is."""
        left = f"{progress.remaining_s:.0f} s of rig time left" if progress.fraction > 0 else ""
        text = f"{progress.state.value}: {progress.message}"
        self._progress.update(self._task, completed=progress.fraction, description=text, left=left)

    def work(self, what: str, share: float) -> None:
        """Show what is being computed and the share done, 0 to 1."""
        self._progress.update(self._task, completed=share, description=what, left="")

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
