"""A first call compiles its inner loops: it says so, whatever the command, and something moves meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from autotune.compiling import NOTE, announce_compiling

KERNEL = "import numba; numba.njit(lambda x: x + 1.0)(1.0)"
ANNOUNCED = "from autotune.compiling import announce_compiling; announce_compiling(); "


def _said(program: str, **environment: str) -> str:
    """Return what a Python process says on stderr."""
    ended = subprocess.run(
        [sys.executable, "-c", program], env=os.environ | environment, capture_output=True, text=True, check=True
    )
    return ended.stderr


def _drawn(program: str) -> str:
    """Return what a Python process draws on a terminal."""
    pty = pytest.importorskip("pty")  # not on Windows
    own, its = pty.openpty()
    with subprocess.Popen([sys.executable, "-c", program], stdout=its, stderr=its) as process:
        os.close(its)
        drawn = b""
        try:
            while part := os.read(own, 65536):
                drawn += part
        except OSError:  # the other end has gone
            pass
        os.close(own)
        assert process.wait() == 0
    return drawn.decode()


def test_it_is_said_once_that_something_is_compiled_and_not_before_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    announce_compiling.cache_clear()
    announce_compiling()
    kernels = [numba.njit(lambda x, k=k: x + k) for k in (1.0, 2.0)]
    assert capsys.readouterr().err == ""
    kernels[0](1.0)
    assert capsys.readouterr().err == f"{NOTE}\n"
    kernels[1](1.0)
    announce_compiling()
    assert capsys.readouterr().err == ""


def test_it_is_said_of_a_compiler_that_is_imported_later() -> None:
    assert _said(f"{ANNOUNCED} import numba") == ""
    assert _said(f"{ANNOUNCED} {KERNEL}; {KERNEL}") == f"{NOTE}\n"
    assert _said(KERNEL) == ""


def test_every_command_says_it_and_says_nothing_once_the_code_is_kept(tmp_path: Path) -> None:
    (tmp_path / "plant.toml").write_text(
        '[[block]]\nname = "lag"\nplace = "plant"\nnum = [1.0]\nden = [2.0, 3.0, 1.0]\n', encoding="utf-8"
    )
    words = ["autotune", "design", "--model", "plant.toml", "--noise-gain", "10", "--overwrite", "--out", "pi.json"]
    call = f"import os, sys; os.chdir({str(tmp_path)!r}); sys.argv = {words}; from autotune.entry import main; main()"
    said = [_said(call, NUMBA_CACHE_DIR=str(tmp_path / "kernels")) for _ in range(2)]
    assert said[0].startswith(NOTE)
    assert NOTE not in said[1]


def test_something_moves_on_a_terminal_while_it_is_compiled() -> None:
    assert " compiling\r" in _drawn(f"{ANNOUNCED} {KERNEL}").replace("\x1b[0m", "")


def test_where_a_bar_is_drawn_the_note_has_its_own_line_and_nothing_else_moves() -> None:
    bar = "bar = Progress(console=Console(stderr=True)); bar.add_task('designing'); bar.start(); bar.refresh()"
    drawn = _drawn(
        f"from rich.console import Console; from rich.progress import Progress; {ANNOUNCED} {bar}; {KERNEL}; bar.stop()"
    )
    assert f"\x1b[2K{NOTE}\r\n" in drawn
    assert " compiling\r" not in drawn
