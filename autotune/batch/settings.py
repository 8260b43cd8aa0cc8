"""The campaign file: which loops there are, where their recordings lie, and what is asked of each."""

from __future__ import annotations

import csv
import os
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from autotune.config import validate
from autotune.config.procedure import DesignSettings
from autotune.errors import InputError
from autotune.files.cells import GOOD
from autotune.files.table import FileForm
from autotune.schema import Number, Section, Text, Time
from autotune.text_files import read_text, read_toml

_FILE = "recording of the loop, or the export that holds its tags; * for several files that follow in time"


class LoopSettings(Section):
    """One loop: its signals in a file, their units, and what is known of it."""

    name: Annotated[Text, Field(min_length=1, description="name of the loop, each only once")]
    file: Annotated[str, Field(min_length=1, description=_FILE)]
    area: Annotated[Text, Field(description="part of the plant, by which the page groups its loops")] = ""
    u: Annotated[str, Field(description="column or tag of the command")] = "u"
    y: Annotated[str, Field(description="column or tag of the measurement")] = "y"
    r: Annotated[str, Field(description="column or tag of the set-point; default r where the file has it")] = ""
    u_unit: Annotated[Text, Field(description="unit of the command")] = ""
    y_unit: Annotated[Text, Field(description="unit of measurement and set-point")] = ""
    u_scale: Annotated[Number, Field(description="u is the file's value times this [u unit]")] = 1.0
    u_offset: Annotated[Number, Field(description="and plus this [u unit]")] = 0.0
    y_scale: Annotated[Number, Field(description="y and r are the file's values times this [y unit]")] = 1.0
    y_offset: Annotated[Number, Field(description="and plus this [y unit]")] = 0.0
    start: Annotated[str, Field(description="first stamp to use, written as in the file; default the first")] = ""
    end: Annotated[str, Field(description="stamp before which to stop, written as in the file; default the end")] = ""
    model: Annotated[str, Field(description="nominal model to diagnose (TOML)")] = ""
    controller: Annotated[str, Field(description="controller the loop runs with (TOML)")] = ""
    K: Annotated[Number | None, Field(description="gain the loop runs with, with its sign [u unit/y unit]")] = None
    Ti_s: Annotated[Time | None, Field(description="integral time the loop runs with [s]")] = None

    @model_validator(mode="after")
    def _one_controller(self) -> LoopSettings:
        if (self.K is None) != (self.Ti_s is None):
            raise ValueError("K and Ti_s are given together, or neither")
        if self.K is not None and self.controller:
            raise ValueError("the controller is given twice, as K and Ti_s and as a file")
        if self.u_scale == 0.0 or self.y_scale == 0.0:
            raise ValueError("a scale of 0 leaves nothing of the signal")
        return self


class ExportSettings(Section):
    """How the files are written, as far as it is said; all else is found out from each file."""

    time: Annotated[str, Field(description="column of the time stamps; found out when empty")] = ""
    time_format: Annotated[str | None, Field(description="strptime format of the stamps; found out when absent")] = None
    time_unit_s: Annotated[
        float | None, Field(gt=0, description="seconds in one unit of numeric stamps; found out when absent")
    ] = None
    delimiter: Annotated[
        str | None,
        Field(min_length=1, max_length=1, description="between the cells of a text file; found out when absent"),
    ] = None
    decimal: Annotated[
        Literal[".", ","] | None, Field(description="decimal mark of a text file; found out when absent")
    ] = None
    encoding: Annotated[str | None, Field(description="character encoding of a text file; found out when absent")] = (
        None
    )
    skip_rows: Annotated[int | None, Field(ge=0, description="lines above the header; found out when absent")] = None
    empty: Annotated[
        Literal["missing", "unchanged"],
        Field(description="an empty cell is a missing sample, or (recorded on change) the value before it"),
    ] = "missing"
    quality: Annotated[
        str, Field(description="name of a tag's quality column with {tag} in it; found by usual names when empty")
    ] = ""
    good: Annotated[
        tuple[str, ...], Field(description="words or codes that mean good; anything else is a bad sample")
    ] = GOOD

    @model_validator(mode="after")
    def _names_a_tag(self) -> ExportSettings:
        if self.quality and "{tag}" not in self.quality:
            raise ValueError('quality must contain {tag}, for example "{tag}.quality"')
        return self

    def form(self) -> FileForm:
        """Return what is said of how the files are written."""
        return FileForm(
            delimiter=self.delimiter, decimal=self.decimal, encoding=self.encoding, skip_rows=self.skip_rows,
            time_format=self.time_format, time_unit_s=self.time_unit_s, quality=self.quality or None, good=self.good,
            empty_unchanged=self.empty == "unchanged",
        )  # fmt: skip


class RoutineSettings(Section):
    """What is asked of a finding before a valve is blamed, where loops are looked at in operation."""

    chance: Annotated[
        float, Field(ge=0.0025, le=0.05, description="largest probability that a linear valve looks as faulty")
    ] = 0.005
    least_reversals: Annotated[
        int, Field(ge=6, le=10_000, description="reversals of the command, fewer of which name no valve's fault")
    ] = 6


class CampaignSettings(Section):
    """What is asked of every loop, and how their files are read."""

    name: Annotated[Text, Field(description="title of the campaign")]
    task: Annotated[
        Literal["identify", "design", "diagnose", "routine"],
        Field(
            description="identify: points; design: points, reduced model, controller; diagnose: missing physics;"
            " routine: why loops in operation oscillate"
        ),
    ] = "design"
    method: Annotated[
        Literal["frequency", "closed-loop"],
        Field(description="how points are identified: from spectra, or by subspace from a loop under control"),
    ] = "frequency"
    longest_gap_s: Annotated[
        Time | None,
        Field(description="a longer gap cuts the record in two [s]; default ten times the usual step"),
    ] = None
    export: ExportSettings | None = None
    design: DesignSettings = DesignSettings()
    routine: RoutineSettings | None = None


class _CampaignFile(CampaignSettings):
    folder: Annotated[str, Field(description="recordings, each a loop: a pattern such as recordings/*.csv")] = ""
    loops: Annotated[str, Field(description="table of the loops (CSV), one row each, keys as in [[loop]]")] = ""
    loop: Annotated[tuple[dict[str, Any], ...], Field(description="the loops themselves")] = ()
    defaults: Annotated[
        dict[str, Any], Field(default_factory=dict, description="keys that hold for every loop that does not have them")
    ]

    @model_validator(mode="after")
    def _one_source(self) -> _CampaignFile:
        if sum(map(bool, (self.folder, self.loops, self.loop))) != 1:
            raise ValueError("give the loops once: folder, loops or [[loop]]")
        return self

    @model_validator(mode="after")
    def _routine_alone(self) -> _CampaignFile:
        if self.routine is not None and self.task != "routine":
            raise ValueError(f'[routine] goes with task = "routine", and task is "{self.task}"')
        return self


def read_campaign(path: str | os.PathLike[str]) -> tuple[CampaignSettings, tuple[LoopSettings, ...]]:
    """Read a campaign file.

    Parameters
    ----------
    path : path
        TOML; paths in it are relative to its folder, those in a table of loops too.

    Returns
    -------
    settings : CampaignSettings
        What holds for all loops.
    loops : tuple of LoopSettings
        In the order of the file, or of the recordings' names; paths absolute.

    Raises
    ------
    InputError
        A file that cannot be read, a key that is refused, a name given twice, or no loop; names the row.
    """
    path = Path(path).absolute()
    file = validate(_CampaignFile, read_toml(path), str(path))
    settings = CampaignSettings(**{key: getattr(file, key) for key in CampaignSettings.model_fields})
    rows = [
        (where, {key: value for key, value in (file.defaults | row).items() if value != ""})
        for where, row in _rows(file, path)
    ]
    loops = tuple(validate(LoopSettings, row, where, texts=bool(file.loops)) for where, row in rows)
    if not loops:
        raise InputError("no loop", where=str(path), remedy=f"nothing matches {file.folder or file.loops}")
    twice = [name for name, times in Counter(loop.name for loop in loops).items() if times > 1]
    if twice:
        raise InputError(f"the loop {twice[0]!r} is there twice", where=str(path), remedy="give each its own name")
    if settings.task == "diagnose" and (without := [loop.name for loop in loops if not loop.model]):
        raise InputError(
            f"{without[0]!r} has no model ({len(without)} of {len(loops)} loops)",
            where=str(path),
            remedy="a diagnosis compares with a model: give the key model, or put it into [defaults]",
        )
    return settings, tuple(_absolute(loop, path.parent) for loop in loops)


def _rows(file: _CampaignFile, path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return the keys of every loop with the place they come from."""
    if file.loop:
        return [(f"{path} [[loop]] {i}", row) for i, row in enumerate(file.loop, start=1)]
    if file.folder:
        return [(str(found), {"name": found.stem, "file": str(found)}) for found in matches(path.parent / file.folder)]
    table = path.parent / file.loops
    reader = csv.DictReader(read_text(table).splitlines(), restkey="more cells than the header", restval="")
    try:
        return [(f"{table} line {reader.line_num}", row) for row in reader]
    except csv.Error as error:
        raise InputError(str(error), where=str(table), remedy="correct the line") from None


def matches(pattern: Path) -> list[Path]:
    """Return the files of a folder whose names match, sorted by name."""
    return sorted(found for found in pattern.parent.glob(pattern.name) if found.is_file())


def _absolute(loop: LoopSettings, folder: Path) -> LoopSettings:
    paths = {key: str(folder / value) for key in ("file", "model", "controller") if (value := getattr(loop, key))}
    return loop.model_copy(update=paths)
