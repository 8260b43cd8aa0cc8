"""Command: identify, design or diagnose many loops at once, or look at them in operation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from autotune.cli import app
from autotune.cli.common import SCHEDULER
from autotune.errors import InputError, OperatorStop, require_extra

if TYPE_CHECKING:
    from autotune.batch.campaign import Campaign
    from autotune.batch.row import Row


@app.command()
def batch(
    campaign: Annotated[Path, typer.Argument(metavar="CAMPAIGN.toml", help="loops, files, and what is asked of them")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder of the results; an interrupted one is continued")],
    workers: Annotated[
        int | None, typer.Option(min=1, help="processes on this machine; default as many as processors")
    ] = None,
    scheduler: SCHEDULER = None,
) -> None:
    """Identify, design or diagnose every loop of a plant, or look at it in operation; a Parquet table and one page."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    require_extra("batch", "distributed", "pyarrow")
    from autotune.batch.campaign import Campaign, failed
    from autotune.batch.engine import cluster, require_scheduler, run_all
    from autotune.batch.loop import analyse_loop
    from autotune.batch.settings import read_campaign

    settings, loops = read_campaign(campaign)
    work = Campaign(settings=settings, loops=loops, out=out.absolute())
    work.claim()
    console = Console(highlight=False, soft_wrap=True)
    rows = work.done(lambda line: console.print(line, markup=False))
    if scheduler is not None and len(rows) < len(loops):
        require_scheduler(scheduler)  # exports of a plant take long to prepare
    bars = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(
        *columns, console=bars, transient=True, disable=not bars.is_terminal, speed_estimate_period=600.0
    ) as progress:
        reading = progress.add_task("preparing exports", total=100, visible=False)
        tasks = work.works(
            rows, lambda name, share: progress.update(reading, description=name, completed=100 * share, visible=True)
        )
        progress.update(reading, visible=False)
        if rows:
            console.print(f"{len(rows)} of {len(loops)} loops are done already", markup=False)
        if tasks:
            # its speed is that of this session: what was done before does not count
            bar = progress.add_task("starting workers", total=len(tasks))
            try:
                with cluster(min(workers, len(tasks)) if workers else None, scheduler) as client:
                    for name, found in run_all(client, analyse_loop, tasks):
                        loop = tasks[name].loop
                        rows[name] = failed(loop, found) if isinstance(found, Exception) else work.keep(loop, found)
                        progress.update(bar, advance=1, description=settings.task)
            except KeyboardInterrupt:
                raise OperatorStop(
                    f"stopped by the operator with {len(rows)} of {len(loops)} loops done",
                    where=str(out),
                    remedy="the same command continues",
                ) from None
    if not _report(work, rows.values(), out, console):
        raise InputError(
            "no loop could be analysed", where=str(campaign), remedy="the reason of each is above and in the report"
        )


def _report(work: Campaign, rows: Iterable[Row], out: Path, console: Console) -> bool:
    """Write table and page, say what needs attention, and return whether any loop could be analysed."""
    from autotune.batch.campaign import REPORT, RESULTS, write_results
    from autotune.batch.row import ATTENTION
    from autotune.report.campaign_page import campaign_page
    from autotune.report.page import write_page

    ordered = write_results(rows, work.out / RESULTS)
    page = campaign_page(work.settings, ordered)
    write_page(page, work.out / REPORT)
    counts = Counter(row.attention for row in ordered)
    for row in [row for row in ordered if row.attention not in ("designed", "fine")][:10]:
        console.print(f"{row.attention:7s} {row.loop}: {row.reason}", markup=False)
    if sum(counts[attention] for attention in ATTENTION[:3]) > 10:
        console.print("and more, in the report", markup=False)
    console.print(page.verdict, markup=False)
    console.print(f"report: {out / REPORT}, table: {out / RESULTS}", markup=False)
    return counts["failed"] < len(ordered)
