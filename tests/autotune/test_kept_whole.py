"""Killed at every write of a command: what was there before, or its successor, is there whole."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import autotune as at
from autotune.recording import write_recording

ROOT = Path(__file__).parents[2]
#: runs the command whole once, then once for each of its writes in a forked process that is killed there
KILLER = """
import os, signal, sys
from autotune.cli import app

WRITES = {"os.rename", "os.link", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "shutil.rmtree"}
out, before = sys.argv[1], b"what was there before"
sys.argv[1:] = sys.argv[2:]
folder = os.getcwd()

def run(last):
    seen = 0
    def hook(event, args):
        nonlocal seen
        opened = event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR)
        if (event in WRITES or opened) and isinstance(args[0], str) and os.path.abspath(args[0]).startswith(folder):
            seen += 1
            if seen == last:
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hook)
    try:
        app(sys.argv[1:], standalone_mode=False)
    except BaseException as error:
        print(repr(error), file=sys.stderr)
        os._exit(1)
    os._exit(0)

def forked(last):
    with open(out, "wb") as file:
        file.write(before)
    pid = os.fork()
    if pid == 0:
        run(last)
    status = os.waitpid(pid, 0)[1]
    with open(out, "rb") as file:
        return os.WIFEXITED(status) and os.WEXITSTATUS(status), file.read()

status, after = forked(0)
assert status == 0 and after != before, (status, after[:99])
last, killed = 0, True
while killed:
    last += 1
    status, found = forked(last)
    assert found in (before, after), (last, found[:99])
    killed = status is False
assert status == 0, status
print(last - 1)
"""

MODEL = """
name = "oven"
[input]
offset = 5.0
[output]
offset = 50.0
[[block]]
name = "heat"
place = "plant"
num = [2.0]
den = [6.0, 5.0, 1.0]
"""
COMMANDS = {
    "schema": ["schema"],
    "margins": ["margins", "--model", "m.toml", "--controller", "c.toml"],
    "reduce": ["reduce", "--model", "m.toml"],
    "simulate": ["simulate", "--model", "m.toml", "r.csv"],
    "watch": ["watch", "r.csv", "--order", "1", "--window", "100", "--every", "60", "--max-delay", "2"],
    "model from-text": ["model", "from-text", "2/(3s+1)"],
    "model export": ["model", "export", "m.toml", "--form", "text"],
    "model linearise": ["model", "linearise", "m.toml", "--at", "u=5"],
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_recording(at.example("oven").between(0.0, 120.0), tmp_path / "r.csv")
    (tmp_path / "m.toml").write_text(MODEL)
    (tmp_path / "c.toml").write_text('kind = "pi"\nK = 0.2\nTi_s = 3.0\n')
    return tmp_path


def call(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False, timeout=300,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_killed_at_every_write_the_old_file_or_the_new_one_is_there_whole(folder: Path, command: str) -> None:
    done = call(folder, "-c", KILLER, "out.toml", *COMMANDS[command], "--out", "out.toml", "--overwrite")
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout.split()[-1]) >= 3


REFUSED = {
    "watch": ["watch", "bad.csv"],
    "model export": ["model", "export", "bad.csv", "--form", "text"],
    "identify delay": ["identify", "delay", "bad.csv"],
}


@pytest.mark.parametrize("command", REFUSED)
def test_a_refused_input_neither_destroys_nor_blocks(folder: Path, command: str) -> None:
    (folder / "bad.csv").write_text("no table\n")
    (folder / "old").write_text("what was there before")
    assert call(folder, "-m", "autotune", *REFUSED[command], "--out", "old", "--overwrite").returncode == 2
    assert call(folder, "-m", "autotune", *REFUSED[command], "--out", "new").returncode == 2
    assert (folder / "old").read_text() == "what was there before"
    assert sorted(file.name for file in folder.iterdir()) == ["bad.csv", "c.toml", "m.toml", "old", "r.csv", "r.toml"]


def test_no_command_on_models_replaces_its_own_input(folder: Path) -> None:
    (folder / "s.py").write_text("import control\nG = control.tf([1], [1, 1])\n")
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    for arguments in (
        ["model", "export", "m.toml", "--form", "toml", "--out", "m.toml"],
        ["model", "linearise", "m.toml", "--at", "u=5", "--out", "m.toml"],
        ["model", "from-control", "s.py:G", "--out", "s.py"],
        ["model", "from-fmu", "m.toml", "--out", "m.toml"],
        ["paper", "relay", "--beside", "c.toml", "--out", "c.toml"],
    ):
        done = call(folder, "-m", "autotune", *arguments, "--overwrite")
        assert done.returncode == 2
        assert "is read by this command" in done.stderr
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
