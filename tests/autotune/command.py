"""The command line as a process of its own would run it, in this one: what it prints and its exit status.

A process imports the method for one to two seconds before it does what a test is about. Where the process is what is
meant (signals, kills, the interpreter's start), a test starts one.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import pytest
from typer.testing import CliRunner

from autotune.cli import app, main


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a command ended."""

    returncode: int
    stdout: str
    stderr: str


def autotune(*words: str | Path, cwd: Path) -> Ended:
    """Run a command in a folder, from its words to its exit status, and leave signals and hooks as they were."""
    stdout, stderr, folder = io.StringIO(), io.StringIO(), Path.cwd()
    interrupt, unraisable = signal.getsignal(signal.SIGINT), sys.unraisablehook
    os.chdir(cwd)
    try:
        with (
            mock.patch.object(sys, "argv", ["autotune", *map(str, words)]),
            warnings.catch_warnings(),
            contextlib.redirect_stdout(stdout),
            contextlib.redirect_stderr(stderr),
            pytest.raises(SystemExit) as end,
        ):
            main()
    finally:
        os.chdir(folder)
        signal.signal(signal.SIGINT, interrupt)
        sys.unraisablehook = unraisable
    return Ended(returncode=int(end.value.code or 0), stdout=stdout.getvalue(), stderr=stderr.getvalue())


def run(*words: object) -> str:
    """Run a command that ends well, and return what it prints."""
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output
