"""Commands on the configuration file itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from autotune.cli import app


@app.command()
def schema(out: Annotated[Path, typer.Option(help="file to write the JSON Schema of the config to")]) -> None:
    """Write the JSON Schema of the configuration, so that editors complete its keys."""
    from autotune.config import json_schema

    out.write_text(json.dumps(json_schema(), indent=2) + "\n", encoding="utf-8")
    typer.echo(f"wrote {out}")
