"""The fault campaign: a short relay session on a real line, one fault at a random moment, and what came of it.

A session runs the servo behind the simulated device for about a second at 100 Hz through the same loop as every
experiment. Afterwards the rig's own side is asked: was the safe output reached, and when; was a command ever outside
the limits; was every recorded sample measured at its time.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autotune.config.procedure import LimitSettings
from autotune.errors import AutotuneError
from autotune.experiment.limits import Envelope
from autotune.experiment.loop import ControlLoop
from autotune.recording import RecordingWriter, read_recording
from tests.drivers.bench import DEADMAN_S
from tests.drivers.lines import (
    LIMITS,
    TIMEOUT_S,
    Device,
    Fate,
    Harm,
    Line,
    Measured,
    rtu_line,
    serial_line,
    tcp_line,
)

SAMPLE_S = 0.01
SESSION_S = 1.2
#: sessions that are begun where a busy computer ends them before the fault
ATTEMPTS = 10


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of one session.

    Attributes
    ----------
    ended : str
        ``completed``, or the one line that the loop ended with.
    exit_status : int
        0, or the error's.
    safe_after_s : float
        Device time from the fault (where the session outlived it: from its last command) to the safe output [s].
    beyond_limits, bad_samples : int
        Outputs outside the limits; recorded samples that nobody measured, or not then.
    rows : int
        Rows of the recording as it can be read.
    within_s : float
        How long that may take [s].
    """

    ended: str
    exit_status: int
    safe_after_s: float
    beyond_limits: int
    bad_samples: int
    rows: int
    within_s: float = DEADMAN_S

    @property
    def is_good(self) -> bool:
        """Whether the rig and the data came through."""
        return self.safe_after_s <= self.within_s + 1e-6 and not self.beyond_limits and not self.bad_samples


class NeverBegunError(AssertionError):
    """A session ended before the fault: this computer was too busy to hold the time-outs."""


def run_session(line: Line, fault: Fault, moment_s: float) -> Outcome:
    """Run one session and strike once at the moment [s]; return what came of it."""
    struck_s = float("inf")
    error: AutotuneError | None = None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.csv"
        writer = RecordingWriter(path, ("t", "u", "y", "u_applied"), {})
        level, above, below = line.relay
        envelope = Envelope(settings=line.limits, sample_time_s=SAMPLE_S)
        try:
            with ControlLoop(rig=line.rig, envelope=envelope, writer=writer, extra=("u_applied",)) as loop:
                tick = loop.tick
                while tick.t_s < fault.session_s:
                    if tick.t_s >= moment_s and struck_s == float("inf"):
                        struck_s = line.device.history[-1].t_s
                        fault.strike(line)
                    tick = loop.step(loop.nearest(above if tick.y > level else below))
        except AutotuneError as caught:
            error = caught
        line.settle()
        if struck_s == float("inf") and error is not None:
            raise NeverBegunError from error
        recording = read_recording(path)
    return Outcome(
        ended="completed" if error is None else str(error),
        exit_status=0 if error is None else error.exit_status,
        safe_after_s=safe_after(line.device, line.limits.u_safe, 0.0 if struck_s == float("inf") else struck_s),
        beyond_limits=beyond_limits(line.device, line.limits),
        bad_samples=bad_samples(line.plant, recording.t, recording.y),
        rows=len(recording),
        within_s=fault.within_s,
    )


def safe_after(device: Device, u_safe: float, struck_s: float = 0.0) -> float:
    """Return the time from the last command that was taken to the safe output [s]; infinite if it is not there."""
    history = list(device.history)
    if abs(device.output - u_safe) > 1e-9:
        return float("inf")
    reached = next(i for i in range(len(history)) if all(abs(c.output - u_safe) < 1e-9 for c in history[i:]))
    last_other = history[reached - 1].t_s if reached else history[reached].t_s
    return history[reached].t_s - max(last_other, struck_s)


def beyond_limits(device: Device, limits: LimitSettings = LIMITS) -> int:
    """Count outputs outside the limits, on the rig's side."""
    return sum(not limits.u_min <= change.output <= limits.u_max for change in device.history)


def bad_samples(plant: Measured, t: Any, y: Any) -> int:
    """Count samples that were not measured, or were measured longer ago than an answer may take."""
    # the line carries fewer digits than the file, and a few measurements look alike
    measured = plant.measured
    delays = [
        [float(t_k) - at for at in measured.get(plant.shown(float(y_k)), [])]
        for t_k, y_k in zip(t, y, strict=True)
        if np.isfinite(y_k)
    ]
    newest = min((one[0] for one in delays if len(one) == 1), default=0.0)  # the two clocks' difference
    return sum(not any(-1e-3 <= delay - newest <= TIMEOUT_S for delay in one) for one in delays)


def repeatedly(harm: Callable[[random.Random], Harm]) -> Callable[[Line], None]:
    """Return a strike that puts a harm on the line from the moment on."""
    return lambda line: line.set_harm(harm(line.random))


def _per_answer(share: float, fate: Callable[[bytes, random.Random], Fate]) -> Callable[[random.Random], Harm]:
    def made(draw: random.Random) -> Harm:
        def harm(frame: bytes, direction: str) -> Fate:
            hit = direction == "to host" and draw.random() < share
            return fate(frame, draw) if hit else ((0.0, frame),)

        return harm

    return made


def _flip(frame: bytes, draw: random.Random) -> Fate:
    at = draw.randrange(len(frame))
    return ((0.0, frame[:at] + bytes((frame[at] ^ 1 << draw.randrange(8),)) + frame[at + 1 :]),)


def _refuse(code: int, times: int) -> Callable[[Line], None]:
    return lambda line: line.refuse(code, times)


def _stale_first() -> Callable[[random.Random], Harm]:
    def made(draw: random.Random) -> Harm:
        kept: list[bytes] = []

        def harm(frame: bytes, direction: str) -> Fate:
            if direction == "to device":
                return ((0.0, frame),)
            kept.append(frame)
            return [(0.0, old) for old in kept[-2:]]

        return harm

    return made


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault, the line it belongs to, and the ends that are right for it (regular expressions of the one line)."""

    name: str
    line: Callable[[int], Any]
    strike: Callable[[Line], None]
    ends: tuple[str, ...]
    session_s: float = SESSION_S
    within_s: float = DEADMAN_S


_LOST = (
    "no answer",
    "connection was lost",
    "no connection",
    "link too slow",
    "answers unreliably",
    "took the actuator back",
    "echoes heartbeat",
    "restarted",
    "the line is gone",
    "takes nothing",
)
_RIDDEN = ("completed", *_LOST)


def _jitter(frame: bytes, draw: random.Random) -> Fate:
    return ((draw.uniform(0.0, 0.02), frame),)


def _slices(frame: bytes, draw: random.Random) -> Fate:
    return [(2e-4 * k, frame[k : k + 1]) for k in range(len(frame))]


def _late(frame: bytes, draw: random.Random) -> Fate:
    return ((draw.uniform(0.07, 0.15), frame),)


def _half(frame: bytes, draw: random.Random) -> Fate:
    return ((0.0, frame[: draw.randrange(1, len(frame))]),)


def _twice(frame: bytes, draw: random.Random) -> Fate:
    return ((0.0, frame), (0.0, frame))


def _lost(frame: bytes, draw: random.Random) -> Fate:
    return ()


def _cut(line: Line) -> None:
    line.set_harm(lambda frame, direction: ())


def _set_wall_clock(line: Line) -> None:
    """Let the computer's wall clock jump; who measures time by it is wrong by as much."""
    real, by_s = time.time, line.random.choice((-3600.0, 3600.0))
    line.undo.callback(setattr, time, "time", real)
    time.time = lambda: real() + by_s


def _jump(line: Line) -> None:
    line.jump(line.random.choice((-1.0, 1.0)) * line.random.uniform(0.2, 5.0))


def _both_ways(fate: Callable[[bytes, random.Random], Fate]) -> Callable[[Line], None]:
    def strike(line: Line) -> None:
        draw = line.random
        line.set_harm(lambda frame, direction: fate(frame, draw) if draw.random() < 0.05 else ((0.0, frame),))

    return strike


def _always(fate: Callable[[bytes, random.Random], Fate]) -> Callable[[Line], None]:
    return repeatedly(_per_answer(1.0, fate))


def _sometimes(fate: Callable[[bytes, random.Random], Fate]) -> Callable[[Line], None]:
    return repeatedly(_per_answer(0.05, fate))


FAULTS = (
    Fault(name="TCP latency 0-20 ms", line=tcp_line, ends=_RIDDEN, strike=_always(_jitter)),
    Fault(name="TCP sliced byte by byte", line=tcp_line, ends=_RIDDEN, strike=_always(_slices)),
    Fault(name="TCP late beyond time-out", line=tcp_line, ends=_RIDDEN, strike=_sometimes(_late)),
    Fault(name="TCP doubled answers", line=tcp_line, ends=_RIDDEN, strike=_always(_twice)),
    Fault(name="TCP older answers first", line=tcp_line, ends=_RIDDEN, strike=repeatedly(_stale_first())),
    Fault(name="TCP connection reset", line=tcp_line, ends=_RIDDEN, strike=lambda line: line.reset()),
    Fault(name="TCP half-open", line=tcp_line, ends=_LOST, strike=_always(_lost)),
    Fault(name="Modbus exception 4", line=tcp_line, ends=("failed to do it",), strike=_refuse(4, 10**9)),
    Fault(name="device busy once", line=tcp_line, ends=_RIDDEN, strike=_refuse(6, 1)),
    Fault(name="device busy for good", line=tcp_line, ends=("is busy",), strike=_refuse(6, 10**9)),
    Fault(
        name="device restarts",
        line=tcp_line,
        ends=("took the actuator back", "echoes heartbeat"),
        strike=lambda line: line.restart(),
    ),
    Fault(name="wall clock jumps an hour", line=tcp_line, ends=("completed",), strike=_set_wall_clock),
    Fault(name="RTU late beyond time-out", line=rtu_line, ends=_RIDDEN, strike=_sometimes(_late)),
    Fault(name="RTU lost answers", line=rtu_line, ends=_RIDDEN, strike=_sometimes(_lost)),
    Fault(name="RTU bit flips", line=rtu_line, ends=_RIDDEN, strike=_sometimes(_flip)),
    Fault(name="RTU cable cut", line=rtu_line, ends=_LOST, strike=_cut),
    Fault(name="serial bit flips", line=serial_line, ends=_RIDDEN, strike=_both_ways(_flip)),
    Fault(name="serial half frames", line=serial_line, ends=_RIDDEN, strike=_both_ways(_half)),
    Fault(name="serial late beyond time-out", line=serial_line, ends=_RIDDEN, strike=_sometimes(_late)),
    Fault(name="serial doubled answers", line=serial_line, ends=_RIDDEN, strike=_always(_twice)),
    Fault(name="serial lost frames", line=serial_line, ends=_RIDDEN, strike=_both_ways(_lost)),
    Fault(name="serial device reset", line=serial_line, ends=("restarted",), strike=lambda line: line.reset()),
    Fault(name="serial cable cut", line=serial_line, ends=_LOST, strike=_cut),
    Fault(name="serial port unplugged", line=serial_line, ends=_LOST, strike=lambda line: line.unplug()),
    Fault(name="device clock jumps", line=serial_line, ends=("the device's clock went",), strike=_jump),
)


def run_fault(fault: Fault, seed: int) -> Outcome:
    """Run one session with the fault at a moment drawn from the seed."""
    moment_s = random.Random(seed).uniform(0.1, 0.8 * SESSION_S)
    for _ in range(ATTEMPTS):
        with ExitStack() as stack:
            line = stack.enter_context(fault.line(seed))
            try:
                return run_session(line, fault, moment_s)
            except NeverBegunError:
                continue
    raise NeverBegunError
