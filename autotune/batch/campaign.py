"""A campaign on disk: what is done, what is left to do, and the table of all results."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet
from pydantic import BaseModel, ConfigDict, ValidationError

from autotune.batch.export import to_parquet
from autotune.batch.loop import Finding, Work
from autotune.batch.row import Row
from autotune.batch.settings import CampaignSettings, LoopSettings, matches
from autotune.errors import InputError
from autotune.outputs import Output, unwritable
from autotune.progress import Progress
from autotune.version import __version__
from autotune.whole_files import write_whole

RESULTS, REPORT = "results.parquet", "report.html"

_ARROW = {"str": pa.string(), "float": pa.float64(), "int": pa.int64(), "bool": pa.bool_(), "Attention": pa.string()}


class _Kept(BaseModel):
    """The result of a loop as its file holds it, and a digest of what it answers."""

    model_config = ConfigDict(strict=True, extra="forbid")

    asked: str
    row: Row
    points: list[dict[str, Any]]
    result: Any


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """A campaign and the folder in which it lies.

    Attributes
    ----------
    settings : CampaignSettings
        What holds for all loops.
    loops : tuple of LoopSettings
        The loops.
    out : Path
        Folder: ``loops/`` one small file per loop, ``tables/`` prepared exports, ``results.parquet``.
    """

    settings: CampaignSettings
    loops: tuple[LoopSettings, ...]
    out: Path

    def file(self, loop: str) -> Path:
        """Return where the result of a loop lies."""
        name = quote(loop, safe=" ()[]+,")
        if len(name) > 200:  # a file's name has at most 255 bytes
            name = f"{name[:160]}-{hashlib.sha256(loop.encode()).hexdigest()[:16]}"
        return self.out / "loops" / f"{name}.json"

    def claim(self) -> None:
        """Make the folder a campaign's, which has ``loops/`` from its first moment on.

        Raises
        ------
        InputError
            It cannot be made, or holds a report or a table that is not a campaign's.
        """
        loops = self.out / "loops"
        foreign = [name for name in (RESULTS, REPORT) if not loops.is_dir() and (self.out / name).exists()]
        if foreign:
            raise InputError(
                f"holds {foreign[0]}, which is not a campaign's", where=str(self.out), remedy="choose another --out"
            )
        try:
            loops.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise unwritable(error, self.out) from None

    def done(self, tell: Callable[[str], None]) -> dict[str, Row]:
        """Return the rows that lie there and still answer what the campaign asks, by loop.

        Parameters
        ----------
        tell : callable
            Told in a line of each file that is damaged; its loop is not done.

        Raises
        ------
        InputError
            A file cannot be read, or is a folder.
        """
        rows = {}
        for loop in self.loops:
            path = self.file(loop.name)
            try:
                kept = _Kept.model_validate_json(path.read_bytes())
            except FileNotFoundError:
                continue
            except OSError as error:  # found before the work, not after it
                raise unwritable(error, path) from None
            except ValidationError:
                tell(f"{path}: is damaged; the loop is done again")
                continue
            if kept.asked == self._digest(loop):
                rows[loop.name] = kept.row
        return rows

    def works(self, done: Iterable[str], advance: Progress) -> dict[str, Work]:
        """Return what is left to do, by loop.

        Parameters
        ----------
        done : iterable of str
            Loops that are done.
        advance : callable
            Told which export is being prepared and the share of it that is.

        Raises
        ------
        InputError
            An export that several loops share cannot be read.
        """
        skip = set(done)
        loops = [loop for loop in self.loops if loop.name not in skip]
        shared = [name for name in dict.fromkeys(loop.file for loop in loops) if self._is_shared(name)]
        prepared = {name: tuple(self._convert(path, name, advance) for path in matches(Path(name))) for name in shared}
        return {
            loop.name: Work(loop=loop, settings=self.settings, prepared=prepared.get(loop.file, ())) for loop in loops
        }

    def keep(self, loop: LoopSettings, finding: Finding) -> Row:
        """Write the result of a loop, whole or not at all; return its row as it will be read again.

        Parameters
        ----------
        loop : LoopSettings
            What was asked of the loop.
        finding : Finding
            What came of it.
        """
        path = self.file(loop.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        content: dict[str, Any] = {"asked": self._digest(loop)} | finding.to_json()
        write_whole(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
        return Row(**content["row"])

    def _is_shared(self, file: str) -> bool:
        loops = [loop for loop in self.loops if loop.file == file]
        return len(loops) > 1 and self.settings.export is not None and not file.endswith(".parquet")

    def _convert(self, path: Path, file: str, advance: Progress) -> Path:
        """Return a CSV export as Parquet, of which a loop reads its own tags without the others."""
        export = self.settings.export
        assert export is not None
        tags = {tag for loop in self.loops if loop.file == file for tag in (loop.u, loop.y, loop.r or "r")}
        wanted = sorted(tags | {export.quality.replace("{tag}", tag) for tag in tags} - {""})
        asked = json.dumps([_stamp(path), export.model_dump(), wanted], default=str)
        out = self.out / "tables" / f"{path.stem}-{hashlib.sha256(asked.encode()).hexdigest()[:16]}.parquet"
        if not out.exists():
            out.parent.mkdir(parents=True, exist_ok=True)
            to_parquet(path, out, wanted, export, advance)
        return out

    def _digest(self, loop: LoopSettings) -> str:
        """Return a digest of all that a loop's result follows from."""
        files = [str(path) for path in matches(Path(loop.file))] + [loop.model, loop.controller]
        stamps = [_stamp(Path(file)) for file in files if file]
        asked = [__version__, loop.model_dump(), self.settings.model_dump(exclude={"name"}), stamps]
        return hashlib.sha256(json.dumps(asked, sort_keys=True, default=str).encode()).hexdigest()


def _stamp(path: Path) -> list[Any]:
    try:
        found = path.stat()
    except OSError:
        return [str(path)]
    return [str(path), found.st_size, found.st_mtime_ns]


def failed(loop: LoopSettings, error: Exception) -> Row:
    """Return the row of a loop whose task could not be run; it is not kept, so that a continued campaign tries again.

    Parameters
    ----------
    loop : LoopSettings
        The loop.
    error : Exception
        What the task ended with.
    """
    return Row(
        loop=loop.name,
        attention="failed",
        reason=f"not analysed ({error or type(error).__name__}); run the campaign again to try once more",
        area=loop.area,
        file=loop.file,
        u_unit=loop.u_unit,
        y_unit=loop.y_unit,
    )


def write_results(rows: Iterable[Row], path: Path) -> tuple[Row, ...]:
    """Write the table of results, what needs attention first on top; return the rows in that order.

    Parameters
    ----------
    rows : iterable of Row
        In any order: the file depends on what is in them only.
    path : Path
        Parquet file.
    """
    ordered = tuple(sorted(rows, key=lambda row: row.order))
    schema = pa.schema([(f.name, _ARROW[str(f.type).removesuffix(" | None")]) for f in fields(Row)])
    table = pa.table({name: [getattr(row, name) for row in ordered] for name in schema.names}, schema=schema)
    Output(path, overwrite=True).by(lambda part: pyarrow.parquet.write_table(table, part))
    return ordered
