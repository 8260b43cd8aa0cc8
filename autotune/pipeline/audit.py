"""Who changed a rig's gains, when and from where: one line for each step, appended and never rewritten."""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import socket
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from autotune.config import Config
from autotune.controller import PIDController
from autotune.errors import InputError
from autotune.whole_files import jsonable

AUDIT = "audit.jsonl"
#: Of every line.
_BEGINNING = b'{"at": "'


@dataclass(frozen=True, kw_only=True)
class AuditLog:
    """A file of JSON lines that outlives runs; several processes may append to it.

    Attributes
    ----------
    path : Path
        The file; made by the first line.
    rig : str
        Name of the rig's configuration.
    configuration : str
        SHA-256 of the configuration with every default filled in.
    command : str
        What is done: run, deploy.
    approval : mapping of str to str, optional
        Name and reason of the second person who approved it.
    """

    path: Path
    rig: str
    configuration: str
    command: str
    approval: Mapping[str, str] | None = None

    def note(self, verdict: str, *, old: PIDController, new: PIDController, why: str = "") -> None:
        """Append a line and bring it to the disk.

        Parameters
        ----------
        verdict : str
            What becomes of the gains with this line.
        old, new : PIDController
            What the rig held before the hand-over, and what it is to hold.
        why : str
            The verification's own words, where there was one.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        line = {
            "at": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "who": user(),
            "host": socket.gethostname(),
            "rig": self.rig,
            "command": self.command,
            "configuration": self.configuration,
            "old": asdict(old),
            "new": asdict(new),
            "verdict": verdict,
            "why": why,
        }
        if self.approval is not None:
            line["approval"] = dict(self.approval)
        # one write on a file opened for appending: lines of other processes come before or after it, never within
        file = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            text = json.dumps(jsonable(line), ensure_ascii=False) + "\n"
            size = os.fstat(file).st_size
            if size and os.pread(file, 1, size - 1) != b"\n":  # a line that a full disk cut off stays as it is
                text = "\n" + text
            data = text.encode()
            if os.write(file, data) != len(data):
                raise OSError(28, "No space left on device")
            os.fsync(file)
        finally:
            os.close(file)


def audit_log(config: Config, folder: Path, command: str, approval: Mapping[str, str] | None = None) -> AuditLog:
    """Return the log that the configuration names; by default ``audit.jsonl`` in the folder of the journal.

    Parameters
    ----------
    config : Config
        Names the log and the rig; its hash is in every line.
    folder : Path
        The journal's.
    command : str
        What hands over, "run" or "deploy".
    approval : mapping of str to str, optional
        Name and reason of the second person who approved it.

    Raises
    ------
    InputError
        What is there is not a file of such lines: nothing is appended to somebody else's.
    """
    path = Path(config.audit_log) if config.audit_log else folder / AUDIT
    if not _is_own(path):
        raise InputError("is not an audit log", where=str(path), remedy="give audit_log another name")
    canonical = json.dumps(config.model_dump(mode="json"), sort_keys=True, ensure_ascii=False)
    return AuditLog(
        path=path,
        rig=config.name,
        configuration=hashlib.sha256(canonical.encode()).hexdigest(),
        command=command,
        approval=approval,
    )


def _is_own(path: Path) -> bool:
    """Return whether nothing is there, or a file whose first line is one of such a log."""
    if not path.exists():
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        line = file.read(len(_BEGINNING))  # shorter where a full disk cut it off
    return _BEGINNING.startswith(line)


def user() -> str:
    """Return who calls; behind sudo also as whom."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError):  # a container's user without a name
        name = str(os.getuid())
    real = os.environ.get("SUDO_USER")
    return f"{real} as {name}" if real and real != name else name
