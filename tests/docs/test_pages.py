"""What the documentation says works: every command and every example of every page is executed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer

from autotune.cli import app
from tests.docs.pages import Block, Reader, blocks, pages

REAL_TIME = "rig-time"


def _follow(page: Path, folder: Path, wanted: list[Block]) -> None:
    with Reader(page, folder) as reader:
        for block in wanted:
            reader.follow(block)


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_a_page_works_from_its_first_block_to_its_last(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _follow(page, tmp_path, [block for block in blocks(page) if REAL_TIME not in block.words])


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page in pages() if any(REAL_TIME in block.words for block in blocks(page))],
    ids=lambda page: page.stem,
)
def test_a_page_works_on_the_rig_too(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _follow(page, tmp_path, blocks(page))


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_what_a_page_links_to_is_there(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        assert target.startswith("https://") or (page.parent / target).is_file(), target


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_a_command_or_an_option_that_a_page_names_exists(page: Path) -> None:
    commands = typer.main.get_command(app)
    text = page.read_text(encoding="utf-8")
    for line in re.findall(r"`(autotune [a-z][^`]*)`|^ {4}(autotune [a-z].*)$", text, flags=re.MULTILINE):
        words = "".join(line).split()
        command = commands.commands[words[1]]
        if hasattr(command, "commands") and len(words) > 2:
            command = command.commands[words[2]]
        known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
        for option in re.findall(r"--[a-z-]+", " ".join(words)):
            assert option in known | {"--help"}, f"{words}: {option}"


def test_every_command_is_on_some_page() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in pages())
    missing = [name for name in typer.main.get_command(app).commands if f"autotune {name}" not in text]
    assert missing == []
