"""Run a command and keep what is on the disk before every change of it: what a kill at that moment would leave.

``python moments_of_writing.py FOLDER SNAPSHOTS COMMAND...`` works in FOLDER and copies it to SNAPSHOTS/0, 1, ... A file
that is opened for writing at its own place, where a kill leaves half of it, is named in SNAPSHOTS/opened.txt.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import Any

CHANGES = ("os.rename", "os.link", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "open")
WRITES = os.O_WRONLY | os.O_RDWR


class Moments:
    """An audit hook that copies a folder before each change in it."""

    def __init__(self, folder: Path, snapshots: Path) -> None:
        self.folder, self.snapshots = folder, snapshots
        self.count, self.copying = 0, False

    def __call__(self, event: str, args: tuple[Any, ...]) -> None:
        """Copy the folder where the event is a change of it."""
        if event not in CHANGES or self.copying or not isinstance(args[0], (str, bytes, os.PathLike)):
            return
        path = Path(os.path.abspath(os.fsdecode(args[0])))
        if not path.is_relative_to(self.folder) or (event == "open" and not args[2] & WRITES):
            return
        self.copying = True
        try:
            if event == "open" and ".part-" not in str(path):
                with (self.snapshots / "opened.txt").open("a") as opened:
                    opened.write(f"{path.relative_to(self.folder)}\n")
            self.keep()
        finally:
            self.copying = False

    def keep(self) -> None:
        """Copy the folder."""
        shutil.copytree(self.folder, self.snapshots / str(self.count), symlinks=True)
        self.count += 1


def main() -> None:
    """Run the command of the arguments."""
    folder, snapshots = (Path(place).resolve() for place in sys.argv[1:3])
    from autotune.cli import app

    os.chdir(folder)
    moments = Moments(folder, snapshots)
    sys.addaudithook(moments)
    app(sys.argv[3:], standalone_mode=False)
    moments.copying = True
    moments.keep()


if __name__ == "__main__":
    main()
