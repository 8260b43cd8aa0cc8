"""Commands on the configuration file itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from autotune.cli import app
from autotune.cli.common import OVERWRITE
from autotune.outputs import Output


@app.command()
def schema(
    out: Annotated[Path, typer.Option(help="file to write the JSON Schema of the config to")],
    overwrite: OVERWRITE = False,
) -> None:
    """Write the JSON Schema of the configuration, so that editors complete its keys."""
    from autotune.config import json_schema

    place = Output(out, overwrite=overwrite)
    place.json(json_schema())
    typer.echo(f"wrote {out}")
