"""``make release`` tags nothing that is not committed, not on main, tagged already or without notes."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from autotune.version import __version__

ROOT = Path(__file__).resolve().parents[1]
WHO = ("-c", "user.name=somebody", "-c", "user.email=somebody@example.org")


def git(folder: Path, *words: str) -> None:
    subprocess.run(["git", *WHO, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A repository with the script, the version and the changelog, all committed on main."""
    for name in (".ci/release", "autotune/version.py", "CHANGELOG.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    git(tmp_path, "init", "-q", "-b", "main")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "all")
    return tmp_path


def release(project: Path, *options: str) -> tuple[int, str]:
    done = subprocess.run([project / ".ci/release", *options], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def test_the_notes_are_the_section_of_the_version(project: Path) -> None:
    sections = "## Unreleased\n\n- later\n", f"## {__version__} - today\n\n- now\n", "## 0 - before\n\n- long ago\n"
    (project / "CHANGELOG.md").write_text("\n".join(("# Changelog\n", *sections)))
    assert release(project, "--notes") == (0, "\n- now\n")


def test_the_version_in_use_has_notes(project: Path) -> None:
    status, said = release(project, "--notes")
    assert status == 0
    assert "### Fixed" in said


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("no notes", f'CHANGELOG.md has no "## {__version__} - DATE"'),
        ("another branch", "git switch main"),
        ("not committed", "git status"),
        ("tagged", f"v{__version__} is tagged"),
    ],
)
def test_a_release_is_refused(project: Path, wrong: str, words: str) -> None:
    match wrong:
        case "no notes":
            (project / "CHANGELOG.md").write_text("# C\n\n## Unreleased\n")
        case "another branch":
            git(project, "switch", "-q", "-c", "elsewhere")
        case "not committed":
            (project / "new.txt").write_text("")
        case "tagged":
            git(project, "tag", f"v{__version__}")
    status, said = release(project)
    assert (status, len(said.splitlines())) == (2, 1)
    assert words in said
