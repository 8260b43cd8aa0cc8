"""Ctrl-C is one line and exit status 130, wherever in the interpreter it arrives."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

#: a command in whose work Ctrl-C arrives, run as ``python -m``
COMMAND = """
import typer
from autotune import cli
from autotune.cli.guard import GuardedCommand

app = typer.Typer()


class Half:
    def __init__(self) -> None:
        raise KeyboardInterrupt

    def __del__(self) -> None:
        self.never_set


@app.command(cls=GuardedCommand)
def work() -> None:
    {work}


cli.app = app
cli.main()
"""


@pytest.mark.parametrize(
    "work",
    [
        "raise KeyboardInterrupt",
        "exec('raise KeyboardInterrupt')",  # while a dataclass is made: python -m would end by a signal
        "Half()",  # in a constructor: the finaliser finds half an object
        "raise SystemError('returned a result with an exception set') from KeyboardInterrupt()",  # in a compiled one
    ],
)
def test_an_interrupt_is_one_line_wherever_it_arrives(tmp_path: Path, work: str) -> None:
    (tmp_path / "command.py").write_text(COMMAND.format(work=work))
    done = subprocess.run([sys.executable, "-m", "command"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 130, done.stderr
    assert done.stderr.splitlines() == ["autotune: stopped by the operator; nothing was written"]
    assert [file.name for file in tmp_path.iterdir() if "defect" in file.name] == []
