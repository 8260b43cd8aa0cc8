"""The fenced blocks of a page, run in order in one scratch folder, as a reader would.

``console``: a line that begins with ``$`` is run by the shell; the lines under it are what it prints, ``...`` for any
text, and each of them has to come. ``# exit status N`` behind a command is its status, 0 where there is none. One that
ends in ``&`` runs on to the end of the page. ``sh`` is a script. ``python`` is executed in one namespace per page.
``toml``, ``diff`` and ``python`` are files where their first line names one (``# NAME``); a ``toml`` without a name
replaces those tables in a configuration of the project, which has to load. A block with the word ``rig-time`` is a
real-time one and takes minutes; one with the word ``board`` needs a board and one with ``dry`` would build an
environment: there make says what it would do.
"""

from __future__ import annotations

import os
import re
import select
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from autotune.config import Config, validate
from autotune.entry import main
from tests.forked import call

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
CONFIGS = ROOT / "configs"
#: words for blocks of which make only says what it would do, and its folder
DRY = {"dry": ROOT, "board": ROOT / "drivers" / "firmware"}
#: languages whose blocks a reader only reads
READ_ONLY = {"text", "{toctree}", "st"}
STATUS = re.compile(r"\s+# exit status (\d+)$")
#: a call of the program that needs no shell
PLAIN = re.compile(r"autotune [^|<>&;*?$`~\\]+")


@dataclass(frozen=True, kw_only=True)
class Block:
    """A fenced block: language, further words, content, and the line of the page it begins at."""

    language: str
    words: tuple[str, ...]
    content: str
    line: int


def pages() -> list[Path]:
    """Return the pages that a reader follows, and the README."""
    return [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]


def blocks(page: Path) -> list[Block]:
    """Return the fenced blocks of a page in their order."""
    found, inside, at = [], None, 0
    lines: list[str] = []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        fence = re.fullmatch(r"(\s*)```(.*)", line)
        if fence and inside is None:
            inside, at, lines = fence[2].split() or [""], number, []
        elif fence and inside is not None:
            found.append(Block(language=inside[0], words=tuple(inside[1:]), content="\n".join(lines) + "\n", line=at))
            inside = None
        elif inside is not None:
            lines.append(line)
    return found


class Reader:
    """Somebody who does what a page says, in a folder of its own."""

    def __init__(self, page: Path, folder: Path) -> None:
        self._page = page
        self._folder = folder
        self._names: dict[str, Any] = {"__name__": "__main__"}
        self._background: list[subprocess.Popen[str]] = []
        self._environment = os.environ | {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "COLUMNS": "120",
            "SOURCE": str(ROOT),
        }

    def __enter__(self) -> Reader:
        (self._folder / "configs").symlink_to(CONFIGS)
        return self

    def __exit__(self, *_: object) -> None:
        for child in self._background:
            os.killpg(child.pid, signal.SIGINT)
            child.communicate(timeout=30)

    def follow(self, block: Block) -> None:
        """Do what a block says."""
        where = f"{self._page.name}:{block.line}"
        match block.language:
            case "console":
                self._console(block, where)
            case "python" if re.match(r"# \S+\.py\n", block.content):
                self._file(block, where)
            case "python":
                # a class defined on a page finds its module, and a traceback its line
                exec(compile("\n" * block.line + block.content, str(self._page), "exec"), self._names)
            case "sh":
                self._console(replace(block, content=f"$ bash -e {self._script(block)}\n"), where)
            case "toml" | "diff":
                self._file(block, where)
            case language:
                assert language in READ_ONLY, f"{where}: a block of {language or 'no language'} is neither run nor read"

    def _script(self, block: Block) -> Path:
        path = self._folder / f"line_{block.line}.sh"
        path.write_text(block.content, encoding="utf-8")
        return path

    def _file(self, block: Block, where: str) -> None:
        name = re.match(r"# (\S+\.(?:toml|diff|py))\n", block.content)
        if name:
            (self._folder / name[1]).write_text(block.content, encoding="utf-8")
        elif block.language == "toml":
            _loads(block.content, where)
        else:
            raise AssertionError(f"{where}: a block of {block.language} needs a name")

    def _console(self, block: Block, where: str) -> None:
        for command, printed in _commands(block.content):
            said = STATUS.search(command)
            wanted = int(said[1]) if said else 0
            command = STATUS.sub("", command)
            for word, folder in DRY.items():
                if word in block.words:
                    command = command.replace("make ", f"make -n -C {folder} ")
            if command.endswith("&"):
                self._start(command.removesuffix("&"), printed, where)
                continue
            if PLAIN.fullmatch(command):
                status, output = call(main, shlex.split(command, comments=True), self._folder, self._environment)
            else:
                status, output = self._run(command)
            assert status == wanted, f"{where}: {command}: exit status {status}\n{output}"
            _compare(printed, output, f"{where}: {command}")

    def _run(self, command: str) -> tuple[int | None, str]:
        """Return the exit status of a command of the shell, and what it prints."""
        done = subprocess.run(
            ["bash", "-c", command], cwd=self._folder, env=self._environment, capture_output=True, text=True,
            check=False, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        return done.returncode, done.stdout + done.stderr

    def _start(self, command: str, printed: list[str], where: str) -> None:
        """Start a command in the background, and go on when it has printed what the page says it does."""
        child = subprocess.Popen(
            ["bash", "-c", f"exec {command}"], cwd=self._folder, env=self._environment | {"PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        )  # fmt: skip
        self._background.append(child)
        assert child.stdout is not None
        output, until = "", time.monotonic() + 60.0
        while printed and not _matches(printed, output):
            assert child.poll() is None and time.monotonic() < until, f"{where}: {command}: {output}"  # noqa: PT018
            if select.select([child.stdout], [], [], 1.0)[0]:
                output += os.read(child.stdout.fileno(), 65536).decode()


def _commands(content: str) -> list[tuple[str, list[str]]]:
    found: list[tuple[str, list[str]]] = []
    for line in content.splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        elif found and found[-1][0].endswith("\\"):
            found[-1] = (found[-1][0][:-1] + line.strip().removeprefix("> "), found[-1][1])
        elif line.strip():
            found[-1][1].append(line.rstrip())
    return found


def _matches(printed: list[str], output: str) -> bool:
    lines = [" ".join(line.split()) for line in output.splitlines()]
    for wanted in printed:
        pattern = re.escape(" ".join(wanted.split())).replace(r"\.\.\.", ".*")
        while lines and not re.fullmatch(pattern, lines[0]):
            lines.pop(0)
        if not lines:
            return False
        lines.pop(0)
    return True


def _compare(printed: list[str], output: str, where: str) -> None:
    wanted = [line for line in printed if line.strip() != "..."]
    assert _matches(wanted, output), f"{where} prints\n{output}\nand not\n" + "\n".join(wanted)


def _loads(content: str, where: str) -> None:
    """Put the tables of a block into the project's configuration for Modbus TCP; the whole has to load."""
    base = tomllib.loads((CONFIGS / "ball_modbus_tcp.toml").read_text(encoding="utf-8"))
    given = tomllib.loads(content)
    merged = {**base, **{name: _merged(base.get(name), table) for name, table in given.items()}}
    validate(Config, merged, where)


def _merged(base: Any, given: Any) -> Any:
    if isinstance(base, dict) and isinstance(given, dict) and "kind" not in given:
        return {**base, **given}
    return given
