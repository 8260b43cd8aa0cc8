"""Say that inner loops are compiled while they are: why a first call after an installation takes so long.

Most commands import the compiler late and many not at all, so that nobody can ask it early for its events; what is
set up here waits until the compiler is imported.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

NOTE = "note: compiling, once after an installation or for a new model: up to a minute"
#: part of the compiler that is imported before anything can be compiled
_COMPILER = "numba.core.dispatcher"


@cache
def announce_compiling() -> None:
    """Say on stderr, once, when the first inner loop is compiled; on a terminal something moves while any is."""
    if _COMPILER in sys.modules:
        _listen()
    else:
        sys.meta_path.insert(0, _AtItsImport())


class _AtItsImport(MetaPathFinder):
    """Listen to the compiler as soon as it is imported; the import itself is left to the others."""

    def find_spec(
        self, fullname: str, _path: Sequence[str] | None, _target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname == _COMPILER:
            sys.meta_path.remove(self)
            _listen()
        return None


def _listen() -> None:
    from numba.core import event

    class Announcement(event.Listener):  # type: ignore[misc]
        said, depth = False, 0
        moving: AbstractContextManager[object] = nullcontext()

        def on_start(self, _: event.Event) -> None:
            if not self.said:
                self.said = True
                sys.stderr.write(f"{NOTE}\n")  # not past a bar that is drawn there: it puts its own line below
                sys.stderr.flush()
            self.depth += 1
            if self.depth == 1:
                self.moving = _moving()
                self.moving.__enter__()

        def on_end(self, _: event.Event) -> None:
            self.depth -= 1
            if self.depth == 0:
                self.moving.__exit__(None, None, None)

    event.register("numba:compile", Announcement())


def _moving() -> AbstractContextManager[object]:
    """Return what moves on a terminal; nothing where there is none, or where a bar is drawn there already."""
    bar_is_drawn = type(sys.stderr).__module__.startswith("rich.")
    if bar_is_drawn or not sys.stderr.isatty() or threading.current_thread() is not threading.main_thread():
        return nullcontext()
    from rich.console import Console

    return Console(stderr=True).status("compiling")
