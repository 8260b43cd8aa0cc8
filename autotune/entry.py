"""What the script ``autotune`` calls: it hears Ctrl-C from its first line on, while the rooms are still imported."""

from __future__ import annotations

from autotune.early import hear


def main() -> None:
    """Run the command line; Ctrl-C before the command has begun is one line and exit status 130 as well."""
    hear()
    from autotune.cli import main as command_line
    from autotune.compiling import announce_compiling

    announce_compiling()
    command_line()
