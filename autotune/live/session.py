"""The run's side of the live page: starts its process, hears its actions, and never waits for it while the rig moves.

The page is another process, with a lower priority, that reads the run's files; what a browser does cannot hold up the
control loop. Only actions come back, each a line on a pipe: a thread that sleeps on it stops the loop as Ctrl-C does.
"""

from __future__ import annotations

import _thread
import os
import queue
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console

from autotune.errors import InputError, require_extra
from autotune.experiment.loop import ABORT
from autotune.interrupts import raise_interrupt
from autotune.text_files import read_text

#: what the page may ask; anything else on the pipe is no action
ACTIONS = ("abort", "keep", "restore")


def read_token(file: Path | None) -> str | None:
    """Return the word that visitors need, from a file or the environment, None where neither has one.

    Never from the command line, which every user of the machine can read.
    """
    if file is None:
        return os.environ.get("AUTOTUNE_LIVE_TOKEN")
    return read_text(file).strip()


class LivePage:
    """The page beside a run, as a context manager; leaving it waits until the last open page is closed, or Ctrl-C.

    Parameters
    ----------
    folder : Path
        Of the run.
    listen, port : str, int
        Address and port; port 0 takes a free one.
    token : str or None
        What visitors need; made up where None.

    Attributes
    ----------
    url : str
        Where the page is.
    process : Popen
        The page's process.

    Raises
    ------
    InputError
        The page's library is missing, or the address cannot be listened on.
    """

    def __init__(self, folder: Path, listen: str, port: int, token: str | None) -> None:
        require_extra("live", "nicegui")
        self._command = [
            sys.executable, "-m", "autotune.cli", "live", str(folder), "--beside-run",
            "--listen", listen, "--port", str(port),
        ]  # fmt: skip
        # not among the arguments, which every user of the machine can read
        self._environment = os.environ | ({"AUTOTUNE_LIVE_TOKEN": token} if token else {})
        self._console = Console(highlight=False, soft_wrap=True)
        self._answers: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.url = ""

    def __enter__(self) -> Self:
        self.process = subprocess.Popen(
            self._command,
            env=self._environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # a Ctrl-C in the shell is for the run, which tells the page how it ended
        )
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()
        if not self.url:
            self.process.wait()
            raise InputError(
                "did not start, its reason is above", where="live page", remedy="give another --listen or --port"
            )
        # outside the control loop, which has a handler of its own, Abort ends the command as Ctrl-C does
        self._handler = signal.signal(ABORT, raise_interrupt)
        self._hearing = threading.Thread(target=self._hear, daemon=True)
        self._hearing.start()
        self._console.print(f"live page: {self.url}", markup=False)
        return self

    def keep(self, patience_s: float) -> bool:
        """Wait for the operator's decision on the new gains; without one, or without a page, they stay.

        Parameters
        ----------
        patience_s : float
            Longest wait [s].
        """
        try:
            return self._answers.get(timeout=patience_s) != "restore"
        except (queue.Empty, KeyboardInterrupt):
            return True

    def _hear(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            action = line.strip()
            if action == "abort":
                _thread.interrupt_main(ABORT)
            elif action in ACTIONS:
                self._answers.put(action)
        self._answers.put("keep")  # the page is gone: nobody will answer

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        try:
            if self.process.poll() is None:
                self._console.print(f"live page: {self.url} stays while it is open; Ctrl-C here ends it", markup=False)
            self.process.wait()
        except KeyboardInterrupt:
            self.process.terminate()
            self.process.wait()
        self._hearing.join()
        signal.signal(ABORT, self._handler)
        self.process.stdout.close()
