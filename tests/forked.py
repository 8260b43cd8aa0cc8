"""A program called as a process of its own, forked from one that has imported what most calls need.

Such a process has its own folder, environment, streams and end. What it does before its first line, and how long it
takes to begin, it does not show: tests of that start an interpreter.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

CALLS = multiprocessing.get_context("forkserver")
CALLS.set_forkserver_preload(["tests.forked", "autotune.cli", "autotune.diagnosis.diagnose", "autotune.report.page"])


def call(
    main: Callable[[], object], command: Sequence[str], folder: Path, environment: Mapping[str, str] | None = None
) -> tuple[int | None, str]:
    """Call a program and wait for its end.

    Parameters
    ----------
    main : callable
        What its script calls.
    command : sequence of str
        Its name and its arguments.
    folder : Path
        Where it is called.
    environment : mapping, optional
        Its environment; that of this process by default.

    Returns
    -------
    status : int or None
        What it ended with; the negative of a signal that ended it.
    printed : str
        What it printed, and what it said on its error stream.
    """
    with tempfile.TemporaryDirectory() as place:
        printed = [Path(place) / name for name in ("stdout", "stderr")]
        given = (main, list(command), folder, dict(os.environ if environment is None else environment), printed)
        child = CALLS.Process(target=_called, args=given)
        child.start()
        child.join()
        return child.exitcode, "".join(path.read_text(encoding="utf-8") for path in printed)


def _called(
    main: Callable[[], object], command: list[str], folder: Path, environment: Mapping[str, str], printed: list[Path]
) -> None:
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    for number, path in enumerate(printed, 1):
        with path.open("wb") as file:
            os.dup2(file.fileno(), number)
    sys.argv = command
    main()
