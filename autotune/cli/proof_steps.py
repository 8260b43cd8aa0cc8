"""What every proof does: publish the seal, diagnose the cases, print what was said."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from autotune.errors import InputError
from autotune.whole_files import write_whole

if TYPE_CHECKING:
    from autotune.report.page import Table as PageTable
    from sim.proof import Campaign


def publish(path: Path, digest: str) -> None:
    """Write the seal before anything is diagnosed; a continued campaign must have the same one.

    Parameters
    ----------
    path : Path
        The seal's file.
    digest : str
        Hash of the sealed answers.

    Raises
    ------
    InputError
        The file holds another one.
    """
    if path.exists() and path.read_text(encoding="utf-8").strip() != digest:
        raise InputError(f"{path}: these answers are not the ones that were sealed; use another --out")
    write_whole(path, digest + "\n")


def diagnose_all(console: Console, tasks: Sequence[tuple[Campaign, int]], workers: int, scheduler: str | None) -> None:
    """Diagnose cases of campaigns; each diagnosis is a program of its own, so a thread is enough to start it.

    Parameters
    ----------
    console : Console
        Shows how far it is.
    tasks : sequence of (Campaign, int)
        Cases by campaign and number.
    workers : int
        How many at once.
    scheduler : str or None
        Address of a Dask scheduler; None starts one here.
    """
    from autotune.batch.engine import cluster, run_all

    with cluster(workers, scheduler, processes=False) as client, Progress(console=console) as progress:
        task = progress.add_task("diagnosing", total=len(tasks))
        for _, failure in run_all(client, _diagnose, {str(i): one for i, one in enumerate(tasks)}, retries=0):
            if failure is not None:
                raise failure
            progress.advance(task)


def _diagnose(task: tuple[Campaign, int]) -> None:
    from sim.proof import diagnose

    diagnose(*task)


def print_table(console: Console, title: str, table: PageTable) -> None:
    """Print a table of the page of the proof.

    Parameters
    ----------
    console : Console
        Where.
    title : str
        Above it.
    table : Table
        As the page shows it.
    """
    view = Table(*table.header, title=title)
    for row in table.rows:
        view.add_row(*map(str, row))
    console.print(view)
