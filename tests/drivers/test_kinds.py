"""The table of kinds of rigs: what is missing in a line is refused when the table is read, not when a rig is opened."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest

from autotune.config.rig import RIG_SETTINGS
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
def test_what_is_missing_is_named(line: Kind | None, known: tuple[type[Section], ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        require_complete((*KINDS, line) if line is not None else KINDS, known)
