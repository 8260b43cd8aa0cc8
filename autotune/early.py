"""Ctrl-C before anything has begun: one line and exit status 130, while the tool is still being imported."""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found]  # signal itself makes enumerations first: too late
import os


def hear() -> None:
    """Let Ctrl-C be one line and exit status 130 from now on, until a command begins."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else a parent wants it ignored
        signal.signal(signal.SIGINT, _leave)


def _leave(*_: object) -> None:
    """Leave at once: nothing has been begun, and an exception in the middle of an import would be a traceback."""
    os.write(2, b"autotune: stopped by the operator; nothing was begun\n")
    os._exit(130)
