"""What the script ``autotune`` calls: it hears Ctrl-C from its first line on, while the rooms are still imported."""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found]  # signal itself makes enumerations first: too late
import os


def hear() -> None:
    """Let Ctrl-C before the command has begun be one line and exit status 130 as well."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else a parent wants it ignored
        signal.signal(signal.SIGINT, _leave)


def main() -> None:
    """Run the command line; Ctrl-C is heard from its first line on."""
    hear()
    from autotune.cli import main as command_line

    command_line()


def _leave(*_: object) -> None:
    """Leave at once: nothing has been begun, and an exception in the middle of an import would be a traceback."""
    os.write(2, b"autotune: stopped by the operator; nothing was begun\n")
    os._exit(130)
