"""Results that go out: claimed before the work, written beside their place, moved there whole or not at all.

Nothing that exists is overwritten unless that is asked for, a file that the command reads is never overwritten, and a
name that cannot be written is refused before anything is computed. The files are made in a folder of their own beside
their place; when all are complete and on the disk they are moved. A full disk or a stop leaves what was there before.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from autotune.errors import InputError
from autotune.interrupts import interrupt_deferred
from autotune.text_files import reason
from autotune.whole_files import write_json

#: Errors of a file system that has no hard links.
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EACCES, errno.EMLINK, errno.ENOSYS, errno.EXDEV)


class Output:
    """The place of one result file: claimed when this is made, written once when the result is there.

    Parameters
    ----------
    out : Path
        Place of the file; a folder that is missing is made when it is written. A device such as ``/dev/stdout`` is
        written to.
    inputs : sequence of Path or None
        Files that the command reads; their sidecars count as well.
    overwrite : bool
        Whether a file that is there may be replaced; an input never is.

    Raises
    ------
    InputError
        The place is taken, is an input, or cannot be written.
    """

    def __init__(self, out: Path, *, inputs: Sequence[Path | None] = (), overwrite: bool = False) -> None:
        _claim(out, inputs, overwrite)
        self.path, self._overwrite = out, overwrite
        if not _is_special(out):
            _prove(out.parent)

    def by(self, write: Callable[[Path], object]) -> None:
        """Have a function write the file at the path that it is given; then move it to its place.

        Raises
        ------
        InputError
            It cannot be written; what was there before still is.
        """
        special = _is_special(self.path)
        with _beside(Path(tempfile.gettempdir()) if special else _folder(self.path.parent)) as folder:
            write(folder / self.path.name)
            if special:
                with _refuse_where_unwritable(self.path):
                    self.path.write_bytes((folder / self.path.name).read_bytes())
            else:
                _move(folder / self.path.name, self.path, self._overwrite)

    @contextmanager
    def growing(self) -> Iterator[TextIO]:
        """Yield a text that grows while the work goes on; it is moved to its place when the block ends, if not empty.

        Ctrl-C is such an end; what was there before stays where the work failed.

        Raises
        ------
        InputError
            It cannot be written; what was there before still is.
        """
        if _is_special(self.path):
            with _refuse_where_unwritable(self.path), self.path.open("w", encoding="utf-8") as stream:
                yield stream
            return
        with _beside(_folder(self.path.parent)) as folder:
            part = folder / self.path.name
            stopped: KeyboardInterrupt | None = None
            with part.open("x", encoding="utf-8") as stream:
                try:
                    yield stream
                except KeyboardInterrupt as error:
                    stopped = error
            if part.stat().st_size:
                _move(part, self.path, self._overwrite)
            if stopped is not None:
                raise stopped

    def text(self, content: str) -> None:
        """Write a text."""
        self.by(lambda part: part.write_text(content, encoding="utf-8"))

    def json(self, content: Any) -> None:
        """Write JSON; a number that is not finite is refused."""
        self.by(lambda part: write_json(part, content))


class OutputFolder:
    """The places of several result files in one folder, claimed together and filled together.

    Parameters
    ----------
    out : Path
        Folder; where it is missing it is made when it is filled. Other files in it stay as they are.
    names : sequence of str
        The files.
    inputs, overwrite
        As of :class:`Output`.

    Raises
    ------
    InputError
        One of the places is taken, is an input, or cannot be written.
    """

    def __init__(
        self, out: Path, names: Sequence[str], *, inputs: Sequence[Path | None] = (), overwrite: bool = False
    ) -> None:
        for name in names:
            _claim(out / name, inputs, overwrite)
        self.path, self._names, self._overwrite = out, tuple(names), overwrite
        _prove(out)

    @contextmanager
    def write_all(self) -> Iterator[Path]:
        """Yield a folder in which to write the files; they are moved to their places when the block ends well."""
        with _beside(_folder(self.path)) as folder:
            yield folder
            for name in self._names:
                if (folder / name).exists():
                    _move(folder / name, self.path / name, self._overwrite)


def claim(out: Path, *, inputs: Sequence[Path | None] = ()) -> None:
    """Refuse a place for a file that grows while the work goes on, as :class:`Output` does, before the work.

    Parameters
    ----------
    out : Path
        The file that will grow.
    inputs : sequence of Path or None
        Files that it must not be.

    Raises
    ------
    InputError
        The place is taken, is an input, or cannot be written.
    """
    _claim(out, inputs, overwrite=False)
    with _beside(_folder(out.parent)):
        pass


def _claim(out: Path, inputs: Sequence[Path | None], overwrite: bool) -> None:
    with _refuse_where_unwritable(out):
        try:
            found = os.stat(out)
        except FileNotFoundError:
            if out.is_symlink():
                raise InputError("is a link to nothing", where=str(out), remedy="choose another --out") from None
            return
    if stat.S_ISDIR(found.st_mode):
        raise InputError("is a folder", where=str(out), remedy="give --out the name of a file")
    for given in inputs:
        for read in (given, given.with_suffix(".toml")) if given is not None else ():
            if _is_same(found, read):
                raise InputError(
                    "is read by this command", where=str(out), remedy="choose another --out; an input is never replaced"
                )
    if not overwrite and not _is_special(out):
        raise InputError(
            "exists already", where=str(out), remedy="choose another --out, or give --overwrite to replace it"
        )


def _is_same(found: os.stat_result, read: Path) -> bool:
    try:
        return os.path.samestat(found, os.stat(read))
    except (OSError, ValueError):
        return False


def _is_special(out: Path) -> bool:
    try:
        mode = os.stat(out).st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def _folder(folder: Path) -> Path:
    with _refuse_where_unwritable(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def _prove(folder: Path) -> None:
    """Show that a folder can be made and written to, and leave nothing of it: what is refused later leaves none."""
    missing = []
    with _refuse_where_unwritable(folder):
        missing = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        with _beside(_folder(folder)):
            pass
    finally:
        with interrupt_deferred():
            for one in missing:
                with contextlib.suppress(OSError):  # somebody else may have begun to use it
                    one.rmdir()


@contextmanager
def _beside(folder: Path) -> Iterator[Path]:
    """Yield a new folder in the folder, which proves that it can be written, and leave nothing of it behind."""
    part: Path | None = None
    try:
        with _refuse_where_unwritable(folder), interrupt_deferred():
            part = Path(tempfile.mkdtemp(prefix=".part-", dir=folder))
        yield part
    except OSError as error:
        named = error.filename
        if part is None or error.errno == errno.EPIPE or not (named is None or str(named).startswith(str(part))):
            raise  # of standard output, or of a file that has nothing to do with this place
        raise unwritable(error, folder) from None
    finally:
        try:
            with interrupt_deferred():
                _remove(part)
        except KeyboardInterrupt:  # it may have come just before
            _remove(part)
            raise


def _remove(part: Path | None) -> None:
    if part is not None:
        shutil.rmtree(part, ignore_errors=True)


def _move(part: Path, out: Path, overwrite: bool) -> None:
    with _refuse_where_unwritable(out):
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        if overwrite:
            os.replace(part, out)
            return
        try:
            os.link(part, out)  # unlike a rename it never replaces what came there meanwhile
        except FileExistsError:
            raise InputError(
                "came to exist while this command worked", where=str(out), remedy="choose another --out"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            os.rename(part, out)


@contextmanager
def _refuse_where_unwritable(out: Path) -> Iterator[None]:
    """Turn an error of the operating system into one line; one of another file keeps that file's name."""
    try:
        yield
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        if not isinstance(error, OSError) and "null" not in str(error):
            raise
        raise unwritable(error, out) from None


def unwritable(error: Exception, out: Path) -> InputError:
    """Return the refusal of a place that cannot be written.

    Parameters
    ----------
    error : Exception
        What the system said.
    out : Path
        The place, where the error names none.
    """
    name = getattr(error, "filename", None)
    where = str(out) if not isinstance(name, str) or ".part-" in name else name
    remedies = {
        errno.ENOSPC: "free space on the disk; what was there before is unchanged",
        errno.EDQUOT: "free space of your quota; what was there before is unchanged",
        errno.ENAMETOOLONG: "give a shorter name",
    }
    remedy = remedies.get(getattr(error, "errno", 0) or 0, "choose another --out, or check the folder's permissions")
    return InputError(f"cannot be written ({reason(error)})", where=where, remedy=remedy)
