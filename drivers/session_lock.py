"""One session per rig address and user: a lock that the operating system takes back when a process dies.

The file lies in a folder that nobody else can write to: in one that all share, any user could lock a rig away from its
owner. A second user's session is found as any other master is, by the device.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import tempfile
from pathlib import Path

from autotune.errors import LinkError

try:
    import fcntl
except ImportError:  # outside POSIX there is no advisory lock; the look for another master remains
    fcntl = None  # type: ignore[assignment]  # a module there, nothing here


class SessionLock:
    """A lock on a device's address, held by one session at a time, in this process or another.

    Parameters
    ----------
    address : str
        The device, as messages name it.
    exclusive : bool
        Whether to lock at all; a look that writes nothing need not.
    """

    def __init__(self, address: str, *, exclusive: bool = True) -> None:
        self._address = address
        self._exclusive = exclusive and fcntl is not None
        self._file: int | None = None
        self._path = Path()

    def take(self) -> bool:
        """Take the lock; return whether it was not held already.

        Raises
        ------
        LinkError
            Another session holds it.
        """
        if not self._exclusive or self._file is not None:
            return False
        folder = _runtime_folder()
        digest = hashlib.sha256(self._address.encode()).hexdigest()[:16]
        self._path = folder / f"autotune-rig-{digest}.lock"
        while self._file is None:
            file = self._open_locked()
            # whoever had it before has removed it meanwhile: this lock is on a file that nobody else finds
            if _is_at(file, self._path):
                self._file = file
            else:
                os.close(file)
        return True

    def _open_locked(self) -> int:
        """Return a locked file, open."""
        try:
            file = os.open(self._path, os.O_RDONLY | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
        except OSError as error:
            raise LinkError(
                f"the lock of its address cannot be opened ({error.strerror})",
                where=str(self._path),
                remedy="remove that file",
            ) from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(file)
            raise LinkError(
                "another session on this computer has the rig",
                where=self._address,
                remedy="end it, or wait until it has",
            ) from None
        return file

    def give_back(self) -> None:
        """Give the lock back and remove its file; may be called more than once."""
        file, self._file = self._file, None
        if file is None:
            return
        with contextlib.suppress(OSError):
            if _is_at(file, self._path):
                self._path.unlink()
        with contextlib.suppress(OSError):
            os.close(file)

    def __del__(self) -> None:
        """Give the lock back with the session that forgot to."""
        self.give_back()


def _runtime_folder() -> Path:
    """Return the user's folder for what lives no longer than a session, made where the system has made none."""
    given = os.environ.get("XDG_RUNTIME_DIR", "")
    if given and _is_ours(Path(given)):
        return Path(given)
    own = Path(tempfile.gettempdir()) / f"autotune-{os.getuid()}"
    try:
        own.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise LinkError(
            f"no folder for locks ({error.strerror})", where=str(own), remedy="give TMPDIR a folder that can be written"
        ) from None
    if not _is_ours(own):
        raise LinkError(
            "belongs to somebody else, or others can write to it", where=str(own),
            remedy="have it removed, or set XDG_RUNTIME_DIR to a folder of your own (chmod 700)",
        )  # fmt: skip
    return own


def _is_ours(folder: Path) -> bool:
    """Return whether a folder is no link, is this user's, and nobody else can write to it."""
    try:
        found = folder.lstat()
    except (OSError, ValueError):
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022


def _is_at(file: int, path: Path) -> bool:
    """Return whether an open file is the one at the path."""
    try:
        found, own = path.stat(), os.fstat(file)
    except OSError:
        return False
    return (found.st_dev, found.st_ino) == (own.st_dev, own.st_ino)
