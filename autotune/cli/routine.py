"""What ``autotune diagnose --routine`` does: recordings of a loop in operation, without a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from autotune.cli.common import announce_compiling
from autotune.cli.recordings import read_all
from autotune.errors import InputError
from autotune.outputs import OutputFolder

if TYPE_CHECKING:
    from autotune.files import SignalNames


def look_at(
    recordings: Sequence[Path], out: Path, unused: Mapping[str, object], names: SignalNames, *, overwrite: bool
) -> None:
    """Look at recordings of one loop in operation and write routine.json and the page.

    Parameters
    ----------
    recordings : sequence of Path
        Files with u, y and, where it was recorded, r.
    out : Path
        Folder for the results.
    unused : mapping of str to object
        Options that a model needs; one that was given is refused.
    names : SignalNames
        Columns of the files.
    overwrite : bool
        Whether results that are there may be replaced.

    Raises
    ------
    InputError
        An option that does not go with ``--routine``, or a recording that nothing can be learnt from.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from autotune.diagnosis.routine import diagnose_routine
    from autotune.report.routine_page import write_routine_page

    given = next((option for option, value in unused.items() if value), None)
    if given is not None:
        raise InputError(
            "it does not go with --routine, which fits a model of its own", where=given, remedy="leave one of them out"
        )
    place = OutputFolder(out, ("routine.json", "report.html"), inputs=tuple(recordings), overwrite=overwrite)
    data = read_all(recordings, names)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    announce_compiling()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("looking", total=1.0)
        found = diagnose_routine(
            data, progress=lambda what, share: progress.update(task, description=what, completed=share)
        )
    with place.write_all() as folder:
        found.write(folder / "routine.json")
        write_routine_page(found, folder / "report.html")
    for sentence in (*found.sentences, found.following):
        typer.echo(sentence)
    typer.echo(f"routine.json and report.html are in {out}")
