"""Command: the live page of a run that goes on, or of one that has ended."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from autotune.cli import app

LISTEN = Annotated[str, typer.Option(metavar="ADDRESS", help="address of the live page")]
PORT = Annotated[int, typer.Option(min=0, max=65535, help="port of the live page; 0 takes a free one")]
TOKEN_FILE = Annotated[
    Path | None,
    typer.Option(help="file with the word that visitors need; else AUTOTUNE_LIVE_TOKEN, else one is made up"),
]


@app.command()
def live(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a run")],
    listen: LISTEN = "127.0.0.1",
    port: PORT = 0,
    token_file: TOKEN_FILE = None,
    beside_run: Annotated[bool, typer.Option("--beside-run", hidden=True)] = False,
) -> None:
    """Show a run in the browser: while it goes, or when it has ended. Looks on only; run --live has the controls."""
    from autotune.errors import InputError, require_extra

    require_extra("live", "nicegui")
    from autotune.live.server import Run, listening, serve, token_for
    from autotune.live.session import read_token
    from autotune.pipeline import PROGRESS

    if not beside_run and not (folder / PROGRESS).is_file():
        raise InputError(f"holds no {PROGRESS}", where=str(folder), remedy="give the --out folder of autotune run")
    token = token_for(read_token(token_file))
    bound = listening(listen, port)
    host = socket.gethostname() if listen in ("0.0.0.0", "::") else f"[{listen}]" if ":" in listen else listen
    url = f"http://{host}:{bound.getsockname()[1]}/?token={token}"
    if beside_run:
        if os.name == "posix":
            os.nice(10)  # the control loop first
        typer.echo(url)
        serve(folder, bound, token, Run())
        return
    Console(highlight=False, soft_wrap=True).print(f"live page, until Ctrl-C: {url}", markup=False)
    serve(folder, bound, token)
