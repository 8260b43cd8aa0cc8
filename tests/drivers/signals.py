"""Stop or kill a session's process at any sample, or fill its disk, and look at the rig's own side."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from autotune.recording import read_recording
from tests.drivers.bench import LIMIT_S
from tests.drivers.campaign import ATTEMPTS, NeverBegunError, Outcome, bad_samples, beyond_limits, safe_after
from tests.drivers.lines import Line, tcp_line

#: how often the rig's own side is asked how many commands it got [s]
ASKED_S = 0.02


def strike_process(
    number: signal.Signals | None, seed: int, line: Callable[[int], AbstractContextManager[Line]] = tcp_line
) -> Outcome:
    """Start a session in a child process, send it a signal after a random number of commands, and wait for the end.

    Without a signal the disk is full after as many rows. The recording is read back as the child left it.
    ``safe_after_s`` counts from the last command that was taken.
    """
    for _ in range(ATTEMPTS):
        try:
            with line(seed) as on_line:
                return _session(on_line, number, seed)
        except NeverBegunError:
            continue
    raise NeverBegunError


def _session(line: Line, number: signal.Signals | None, seed: int) -> Outcome:
    strike_after = random.Random(seed).randrange(5, 60)
    assert line.settings is not None
    asked = {
        "rig": line.settings.model_dump(mode="json", exclude_none=True),
        "limits": line.limits.model_dump(mode="json", exclude_none=True),
        "relay": line.relay,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.csv"
        command = [sys.executable, "-m", "tests.drivers.child_session", json.dumps(asked), str(path)]
        if number is None:
            command.append(str(ROW_BYTES * strike_after))
        root = Path(__file__).parents[2]
        with subprocess.Popen(command, cwd=root, stderr=subprocess.PIPE, text=True) as child:
            if number is not None:
                while sum(change.cause == "command" for change in list(line.device.history)) < strike_after:
                    if child.poll() is not None:
                        raise NeverBegunError
                    threading.Event().wait(ASKED_S)
                child.send_signal(number)
            _, said = child.communicate(timeout=3 * LIMIT_S)
        if number is None and "link too slow" in said:
            raise NeverBegunError
        line.settle()
        recording = read_recording(path)
    return Outcome(
        ended=said.strip(),
        exit_status=child.returncode,
        safe_after_s=safe_after(line.device, line.limits.u_safe),
        beyond_limits=beyond_limits(line.device, line.limits),
        bad_samples=bad_samples(line.plant, recording.t, recording.y),
        rows=len(recording),
    )


#: about what a row of the recording takes
ROW_BYTES = 40

#: signal (none: the disk is full), exit status, the one line
SIGNALS: tuple[tuple[signal.Signals | None, int, str], ...] = (
    (None, 3, "the recording cannot be written"),
    (signal.SIGKILL, -signal.SIGKILL, ""),
    (signal.SIGTERM, 130, "stopped by SIGTERM"),
    (signal.SIGINT, 130, "stopped by Ctrl-C"),
)


def is_right(number: signal.Signals | None, outcome: Outcome) -> bool:
    """Return whether exit status and line are the signal's, and rig and data came through."""
    status, line = next((status, line) for each, status, line in SIGNALS if each == number)
    return outcome.exit_status == status and line in outcome.ended and outcome.is_good
