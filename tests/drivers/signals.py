"""Stop or kill a session's process at any sample, or fill its disk, and look at the rig's own side."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from autotune.recording import read_recording
from sim.modbus_rig import ModbusRig, TcpTransport
from sim.register_device import OutputChange
from tests.drivers.bench import LIMIT_S, U_SAFE, register_device
from tests.drivers.campaign import ATTEMPTS, NeverBegunError, Outcome, bad_samples, beyond_limits
from tests.drivers.lines import LoggedServo


def strike_process(number: signal.Signals | None, seed: int) -> Outcome:
    """Start a session in a child process, send it a signal after a random number of commands, and wait for the end.

    Without a signal the disk is full after as many rows. The recording is read back as the child left it.
    ``safe_after_s`` counts from the last command that was taken.
    """
    for _ in range(ATTEMPTS):
        try:
            return _session(number, seed)
        except NeverBegunError:
            continue
    raise NeverBegunError


def _session(number: signal.Signals | None, seed: int) -> Outcome:
    strike_after = random.Random(seed).randrange(5, 60)
    plant = LoggedServo(seed)
    device = register_device(plant=plant)
    commanded, released = threading.Event(), threading.Event()
    commands = 0

    def note(change: OutputChange) -> None:
        nonlocal commands
        commands += change.cause == "command"
        if commands >= strike_after:
            commanded.set()
        if change.cause in ("dead-man", "given back"):
            released.set()

    device.on_change = note
    with tempfile.TemporaryDirectory() as folder, ModbusRig(device, TcpTransport()) as server:
        path = Path(folder) / "session.csv"
        command = [sys.executable, "-m", "tests.drivers.child_session", str(server.port), str(path)]
        if number is None:
            command.append(str(ROW_BYTES * strike_after))
        root = Path(__file__).parents[2]
        with subprocess.Popen(command, cwd=root, stderr=subprocess.PIPE, text=True) as child:
            if number is not None:
                while not commanded.wait(0.2):
                    if child.poll() is not None:
                        raise NeverBegunError
                child.send_signal(number)
            _, said = child.communicate(timeout=3 * LIMIT_S)
        if number is None and "link too slow" in said:
            raise NeverBegunError
        assert released.wait(LIMIT_S)
        recording = read_recording(path)
    history = list(device.history)
    last = max(change.t_s for change in history if change.cause == "command")
    safe = next(change.t_s for change in history if change.t_s >= last and abs(change.output - U_SAFE) < 1e-9)
    return Outcome(
        ended=said.strip(),
        exit_status=child.returncode,
        safe_after_s=safe - last,
        beyond_limits=beyond_limits(device),
        bad_samples=bad_samples(plant, recording.t, recording.y),
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
