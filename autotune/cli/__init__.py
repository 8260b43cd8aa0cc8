"""Command line: the only room that knows every other. Heavy imports wait until their command is called."""

from __future__ import annotations

import sys

import typer
from rich.console import Console

from autotune.errors import AutotuneError

app = typer.Typer(
    name="autotune",
    help="Commission a control loop: measure its Bode points with a relay, design its controller, verify it.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
identify = typer.Typer(help="Identify the plant from a recording.", no_args_is_help=True)
app.add_typer(identify, name="identify")

# Each room of commands registers itself on the two apps above; the order here is the order in --help.
from autotune.cli import (  # noqa: E402, F401, I001
    run,
    frequency,
    delay,
    closed_loop,
    design,
    diagnose,
    prove,
    rig,
    files,
)


def main() -> None:
    """Run the command line; an error of the tool is one line on stderr and its exit status."""
    try:
        app()
    except AutotuneError as error:
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"autotune: {error}", markup=False)
        sys.exit(error.exit_status)
