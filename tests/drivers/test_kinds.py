"""The table of kinds of rigs: what is missing in a line is refused when the table is read, not when a rig is opened."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest

from autotune.config.rig import RIG_SETTINGS, rig_kind_of
from autotune.errors import InputError
from autotune.schema import Section
from drivers.kinds import KINDS, Kind, require_complete


class PigeonSettings(Section):
    kind: Literal["pigeon"] = "pigeon"


PIGEON = Kind(PigeonSettings, "drivers.simulated")


def test_the_table_has_a_line_for_every_kind_and_each_has_its_file() -> None:
    require_complete(KINDS)
    require_complete((*KINDS, PIGEON), (*RIG_SETTINGS, PigeonSettings))


@pytest.mark.parametrize(
    ("line", "known", "message"),
    [
        (None, (*RIG_SETTINGS, PigeonSettings), r"no line for PigeonSettings; add Kind\(PigeonSettings, "),
        (PIGEON, RIG_SETTINGS, "PigeonSettings is no .rig. that a configuration may have; add it to RigSettings"),
        (replace(PIGEON, driver="drivers.pidgeon"), (*RIG_SETTINGS, PigeonSettings), "drivers.pidgeon, which does not"),
        (replace(PIGEON, driver="drivers.clock"), (*RIG_SETTINGS, PigeonSettings), "clock has no open_kind; add def"),
    ],
)
def test_what_is_missing_in_the_table_is_named(
    line: Kind | None, known: tuple[type[Section], ...], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        require_complete((*KINDS, line) if line is not None else KINDS, known)


@pytest.mark.parametrize(
    ("written", "wrong", "message"),
    [
        ("def close(", "def shut(", "PigeonRig of pigeon_post has no close; a rig has clock, open, read, write, "),
        ("def make_safe(", "def _make_safe(", "PigeonRig of pigeon_post has no make_safe"),
        ("self.clock", "self.watch", "PigeonRig of pigeon_post has no clock"),
        ("(settings, session)", "(settings)", "open_kind of pigeon_post takes settings; write def open_kind"),
        ("def open_kind", "def open", "pigeon_post has no open_kind"),
    ],
)
def test_what_is_missing_in_a_driver_s_file_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: str, wrong: str, message: str
) -> None:
    methods = "".join(f"    def {name}: ...\n" for name in ("open(self)", "read(self)", "write(self, u)",
                                                            "make_safe(self)", "close(self)"))  # fmt: skip
    source = f"class PigeonRig:\n    def __init__(self):\n        self.clock = None\n{methods}"
    source += "def open_kind(settings, session) -> PigeonRig: ...\n"
    monkeypatch.syspath_prepend(tmp_path)
    file, table = tmp_path / "pigeon_post.py", (*KINDS, replace(PIGEON, driver="pigeon_post"))
    file.write_text(source)
    require_complete(table, (*RIG_SETTINGS, PigeonSettings))
    file.write_text(source.replace(written, wrong))
    with pytest.raises(InputError, match=re.escape(message)):
        require_complete(table, (*RIG_SETTINGS, PigeonSettings))


def test_settings_without_a_kind_are_named() -> None:
    class Nameless(Section):
        port: int

    with pytest.raises(InputError, match="Nameless has no kind; add kind: Literal"):
        rig_kind_of(Nameless)
