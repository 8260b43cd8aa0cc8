"""What is installed is what is locked: every package with its version and hashes, and no index is named."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ASKED = {
    "run": PROJECT["dependencies"],
    "test": PROJECT["dependencies"] + PROJECT["optional-dependencies"]["test"],
    "docs": PROJECT["dependencies"] + PROJECT["optional-dependencies"]["docs"],
}


def locked(name: str) -> dict[str, set[str]]:
    """Return the versions of every package of a lock file; one for each platform where they differ."""
    found: dict[str, set[str]] = {}
    for line in (ROOT / ".ci" / "lock" / f"{name}.txt").read_text().splitlines():
        if match := re.match(r"([A-Za-z0-9._-]+)==([^\s;\\]+)", line):
            found.setdefault(canonicalize_name(match[1]), set()).add(match[2])
    return found


@pytest.mark.parametrize("name", ASKED)
def test_the_lock_holds_every_package_that_is_asked_for_in_a_version_that_is(name: str) -> None:
    versions = locked(name)
    for text in ASKED[name]:
        asked = Requirement(text)
        assert canonicalize_name(asked.name) in versions, f"{text}: make lock"
        for version in versions[canonicalize_name(asked.name)]:
            assert asked.specifier.contains(version), f"{text}, locked {version}: make lock"


@pytest.mark.parametrize("name", ["pip", "setuptools"])
def test_what_installs_is_locked_too_and_not_what_the_interpreter_brought(name: str) -> None:
    assert metadata.version(name) in locked("test")[name]


@pytest.mark.parametrize("name", [*ASKED, "tools"])
def test_every_locked_file_has_its_hash_and_no_index_is_named(name: str) -> None:
    text = (ROOT / ".ci" / "lock" / f"{name}.txt").read_text()
    assert "://" not in text
    assert "index" not in re.sub(r"[\w-]*index[\w-]*==", "", text)
    for entry in re.split(r"\n(?=[A-Za-z0-9])", text.strip()):
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", entry), entry.splitlines()[0]
