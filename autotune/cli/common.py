"""What several commands share: options, the rig of a configuration, a new folder for its files, a progress bar."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console

from autotune.cli.guard import mark_rig_in_command
from autotune.errors import InputError
from autotune.outputs import claim

if TYPE_CHECKING:
    from autotune.config import Config
    from autotune.experiment.result import Status
    from autotune.experiment.rig import Rig

# Arguments and options of several commands, in the same words.
CONFIG = Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="configuration of the rig")]
OVERWRITE = Annotated[bool, typer.Option("--overwrite", help="replace what is at --out; an input never is")]
DRY_RUN = Annotated[bool, typer.Option("--dry-run", help="run the rig's simulated twin instead of the rig")]
WITHOUT = Annotated[
    list[str] | None, typer.Option(help="leave an effect out of the catalogue; may be given several times")
]
INTEGRATOR = Annotated[bool, typer.Option("--integrator", help="the plant integrates: a0 = 0")]
STRUCTURE = Annotated[Literal["pi", "pid"], typer.Option(help="structure of the controller")]
NOISE_FREQUENCY = Annotated[
    float | None, typer.Option(help="lowest frequency of the noise [rad/s]; default the crossover")
]
U_SPAN = Annotated[float, typer.Option(help="engineering span of the output, for percent forms [u unit]")]
Y_SPAN = Annotated[float, typer.Option(help="engineering span of the measurement [y unit]")]
SCHEDULER = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="existing Dask scheduler, tcp://host:8786, with its workers")
]


def rig_of(config: Config, dry_run: bool = False, speed: float | None = None) -> Rig:
    """Return the rig that the configuration describes, or its simulated twin; nothing has been sent to it.

    Parameters
    ----------
    config : Config
        Of the rig.
    dry_run : bool
        Whether its simulated twin is meant.
    speed : float, optional
        Seconds of a simulated rig in a second of whoever watches; as fast as the processor allows where not given.
    """
    from autotune.controller import PIDController
    from drivers import open_rig, twin_of

    given = config.controller
    mark_rig_in_command()
    return open_rig(
        twin_of(config.rig) if dry_run else config.rig,
        u_range=(config.limits.u_min, config.limits.u_max),
        u_safe=config.limits.u_safe,
        controller=PIDController(K=given.K, Ti_s=given.Ti_s) if given else None,
        speed=speed,
    )


def warn_of_no_dead_man(config: Config) -> str:
    """Return what is to be known of a rig whose device no one is known to make safe; empty where a dead-man is mapped.

    Parameters
    ----------
    config : Config
        Of the rig; a kind without registers has its dead-man in its protocol, or is in this process.
    """
    registers = getattr(config.rig, "registers", None)
    if registers is None or registers.heartbeat is not None:
        return ""
    place = next((name for name in ("nodes", "signals") if hasattr(config.rig, name)), "registers")
    return (
        "no dead-man is mapped: if this computer or the line fails, the device may hold the last command for ever;"
        f" map rig.{place}.heartbeat, or stand at the rig's stop"
    )


def new_folder(out: Path, names: str | Sequence[str], inputs: Sequence[Path | None] = ()) -> None:
    """Make the folder of a run whose files grow while it goes; refuse one in which there is one of its files.

    Parameters
    ----------
    out : Path
        The folder.
    names : str or sequence of str
        What will be written into it.
    inputs : sequence of Path or None
        What the command reads.

    Raises
    ------
    InputError
        There is a file of the name, or none can be written there.
    """
    for name in (names,) if isinstance(names, str) else names:
        if (out / name).exists():
            raise InputError(
                f"holds {name} already", where=str(out), remedy="choose another --out; nothing is overwritten"
            )
        claim(out / name, inputs=inputs)


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

    def show(self, status: Status) -> None:
        """Show where the procedure is."""
        left = f"{status.remaining_s:.0f} s of rig time left" if status.fraction > 0 else ""
        text = f"{status.state.value}: {status.message}"
        self._progress.update(self._task, completed=status.fraction, description=text, left=left)

    def work(self, what: str, share: float) -> None:
        """Show what is being computed and how much of it is done.

        Parameters
        ----------
        what : str
            What is being computed.
        share : float
            How much of it is done, 0 to 1.
        """
        self._progress.update(self._task, completed=share, description=what, left="")

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
