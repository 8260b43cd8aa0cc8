"""Ctrl-C while the tool is still being imported: one line, and the exit status of an interrupt."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

#: Interrupts the process when a module is about to be imported, as an operator may at that moment.
CUSTOM = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
"""


@pytest.mark.parametrize("name", ["autotune.version", "autotune.cli", "typer"])
@pytest.mark.parametrize("script", [True, False])
def test_an_interrupt_during_the_import_is_one_line(name: str, script: bool, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(CUSTOM.format(name=name), encoding="utf-8")
    installed = tmp_path / "autotune"
    installed.write_text("from autotune.entry import main\nmain()\n", encoding="utf-8")
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), root))}
    given = [sys.executable, *([str(installed)] if script else ["-m", "autotune"]), "--version"]
    ended = subprocess.run(given, capture_output=True, text=True, env=environment, timeout=120, check=False)
    assert ended.returncode == 130
    assert ended.stderr.splitlines() == ["autotune: stopped by the operator; nothing was begun"]


def test_an_interrupt_while_the_call_is_read_is_one_line() -> None:
    program = """
import os, signal, typer.core
read = typer.core.TyperGroup.parse_args
def interrupted(*given):
    os.kill(os.getpid(), signal.SIGINT)
    return read(*given)
typer.core.TyperGroup.parse_args = interrupted
from autotune.entry import main
main()
"""
    given = [sys.executable, "-c", program, "--version"]
    ended = subprocess.run(given, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 130
    assert ended.stderr.splitlines() == ["autotune: stopped by the operator; nothing was begun"]


def test_an_interrupt_where_compiled_code_makes_its_result_is_raised_after_it() -> None:
    program = """
import ctypes, signal
import numpy as np
from numba import njit
from autotune.interrupts import raise_interrupt

kill = getattr(ctypes.CDLL(None), "raise")
kill.argtypes, kill.restype = [ctypes.c_int], ctypes.c_int

@njit
def interrupted(number):
    values = np.ones(3)
    if number:
        kill(number)
    return values, values > 0.5

interrupted(0)
signal.signal(signal.SIGINT, raise_interrupt)
try:
    made = interrupted(int(signal.SIGINT))
    while True:
        pass
except KeyboardInterrupt:
    print(made)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == "(array([1., 1., 1.]), array([ True,  True,  True]))\n"


@pytest.mark.parametrize("lasts_s", [0.0, 60.0])
def test_an_interrupt_in_an_import_is_raised_after_it_unless_it_lasts(tmp_path: Path, lasts_s: float) -> None:
    (tmp_path / "imported.py").write_text(
        "import os, signal, time\n"
        "os.kill(os.getpid(), signal.SIGINT)\n"
        f"end = time.monotonic() + {lasts_s}\n"
        "while time.monotonic() < end:\n    pass\n"
        "whole = True\n",
        encoding="utf-8",
    )
    program = """
import signal, sys
from autotune.interrupts import raise_interrupt
signal.signal(signal.SIGINT, raise_interrupt)
try:
    import imported
    while True:
        pass
except KeyboardInterrupt:
    print("imported" in sys.modules)
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), str(Path(__file__).parents[2])))}
    given = [sys.executable, "-c", program]
    ended = subprocess.run(given, capture_output=True, text=True, env=environment, timeout=40, check=False)
    assert (ended.returncode, ended.stderr, ended.stdout) == (0, "", f"{lasts_s == 0.0}\n")


@pytest.mark.parametrize(("said", "kept"), [(None, "1"), ("3", "3")])
def test_a_command_keeps_linear_algebra_on_one_thread_unless_it_is_told_otherwise(said: str | None, kept: str) -> None:
    """On two busy processors an exponential of three states took 12 ms for .07, and a run twice its time."""
    program = """
import os, sys
sys.argv = ["autotune", "--version"]
from autotune.entry import main
try:
    main()
except SystemExit:
    pass
import scipy.linalg
from threadpoolctl import threadpool_info
print(os.environ["OPENBLAS_NUM_THREADS"], max(one["num_threads"] for one in threadpool_info()))
"""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment |= {} if said is None else {"OPENBLAS_NUM_THREADS": said}
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment, timeout=120, check=True
    )
    set_to, used = ended.stdout.split()[-2:]
    assert set_to == kept
    assert said is not None or used == "1"
