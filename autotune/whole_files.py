"""Files written whole or not at all: a full disk or a stopped process leaves what was there before."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

from autotune.errors import InputError
from autotune.interrupts import interrupt_deferred


def write_whole(path: str | os.PathLike[str], content: str | bytes, *, sync: bool = True) -> None:
    """Write a file whole or not at all: beside its place, brought to the disk, renamed; an existing one is replaced.

    Parameters
    ----------
    path : path
        Place of the file; commands claim theirs by :class:`Output` or :class:`OutputFolder` first.
    content : str or bytes
        A text is written as UTF-8.
    sync : bool
        Whether to wait until it is on the disk, which takes 10 to 100 ms; without, it outlives a killed process and not
        a power failure. A control loop does not wait.

    Raises
    ------
    OSError
        It cannot be written; what was there before still is.
    """
    place = Path(path)
    data = content.encode() if isinstance(content, str) else content
    if place.exists() and not place.is_file():  # a device or a pipe has no place beside it
        place.write_bytes(data)
        return
    with interrupt_deferred():
        _write_beside(place, data, sync)


def _write_beside(place: Path, data: bytes, sync: bool) -> None:
    handle, part = tempfile.mkstemp(prefix=".part-", dir=place.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fchmod(file.fileno(), 0o666 & ~_umask())
            if sync:
                os.fsync(file.fileno())
        os.replace(part, place)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(part)
        raise


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def append_whole(file: io.FileIO, line: bytes) -> None:
    """Append a line to an unbuffered file, whole or not at all: a disk that fills leaves no half line behind.

    Parameters
    ----------
    file : io.FileIO
        Open for writing, unbuffered.
    line : bytes
        With its line end.

    Raises
    ------
    OSError
        It cannot be written; the file ends with the line before.
    """
    end = file.seek(0, os.SEEK_END)
    try:
        rest = memoryview(line)
        while rest:
            rest = rest[file.write(rest) :]
    except OSError:
        with contextlib.suppress(OSError):
            file.truncate(end)
        raise


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write JSON by :func:`write_whole`.

    Parameters
    ----------
    path : path
        Replaced where it exists.
    content : object
        Of dicts, lists, texts and finite numbers.

    Raises
    ------
    InputError
        A number in it is not finite: the result is none.
    """
    try:
        text = json.dumps(content, indent=2, allow_nan=False)
    except ValueError:
        raise InputError(
            "the result has a number that is not finite", where=Path(path).name, remedy="check the size of the inputs"
        ) from None
    write_whole(path, text + "\n")


def jsonable(value: Any) -> Any:
    """Replace what JSON has no number for by null, at any depth."""
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {key: jsonable(entry) for key, entry in value.items()}
        case list() | tuple():
            return [jsonable(entry) for entry in value]
    return value
