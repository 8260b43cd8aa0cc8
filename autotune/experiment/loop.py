"""The one loop that talks to a rig: wait, read, check, write the row to disk, command; safe from every exit."""

from __future__ import annotations

import contextlib
import math
import signal
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import AutotuneError, ExperimentStopped, LinkError, OperatorStop
from autotune.experiment.foreign import describe_foreign
from autotune.experiment.leaving import leave, say, verdict_on
from autotune.experiment.limits import Envelope, Watch
from autotune.experiment.monitor import ReadingMonitor
from autotune.experiment.priority import GoesOn, raise_priority
from autotune.experiment.rig import Exchanges, Feeds, Reading, Rig, Row, RunsRelay
from autotune.experiment.rows import KEPT_ROWS, RecentRows
from autotune.experiment.timing import Tick, Timing
from autotune.experiment.warm import warm_up
from autotune.interrupts import signals_heard
from autotune.recording import RecordingWriter, as_written

#: longest wait without looking for a stop signal [s]
SLICE_S = 0.1
#: what an onlooker's Abort arrives as; Ctrl-C itself where the system has no signal to spare
ABORT: signal.Signals = getattr(signal, "SIGUSR1", signal.SIGINT)
#: the signals that end an experiment, as the operator knows them
_SIGNALS = {ABORT: "Abort on the live page", signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}
#: sample times that the loop may always be behind its schedule, however short limits.late_s is
LATE_SAMPLES = 5
#: rows over which the share of missed samples is counted
LOOK_BACK_ROWS = 100
#: what lies at least between two rows [s], where a virtual clock stands still
SHORTLY_S = 1e-6

__all__ = ["ABORT", "ControlLoop", "Tick", "Timing"]


class ControlLoop:
    """A session with a rig, as a context manager; every experiment and every verification runs in one.

    Use it like this: the law asks for the allowed command nearest to what it wants (and feeds it back to its
    anti-windup), then steps; a step returns at the next sample ::

        with ControlLoop(rig=rig, envelope=envelope, writer=writer) as loop:
            tick = loop.tick                                  # the first sample
            while tick.t_s < 10.0:
                u = loop.nearest(law(tick.y))
                tick = loop.step(u, extra={"r": setpoint})

    A step checks the command against the envelope, brings the row to disk, commands the rig, waits for the next
    sample's absolute deadline, reads, and checks the reading and the limits on y that :attr:`watch` names. On a rig
    that :class:`~autotune.experiment.rig.Exchanges` it waits first, and command and reading are one: a row holds that
    reading and the command that acts from its instant on, which was computed from the sample before. Leaving
    the block in any way (end, limit, fault, exception, Ctrl-C, SIGTERM) commands the safe output, gives the actuator
    back, and writes the reason into the recording's sidecar together with what was put into :attr:`metadata`.

    Parameters
    ----------
    rig : Rig
        Closed; the loop opens and closes it.
    envelope : Envelope
        Limits, sample time and command resolution.
    writer : RecordingWriter
        Opened with the columns ``t, u, y`` and the names of ``extra``; the loop finishes it.
    extra : sequence of str
        Names of further columns, in the writer's order; ``u_applied`` among them is filled by the loop itself: what
        the device said it applied when the row's ``y`` was read, before the row's ``u`` acts.

    Attributes
    ----------
    tick : Tick
        The latest sample.
    watch : Watch
        Which limits on y apply; the procedure sets it as it goes from state to state.
    monitor : ReadingMonitor
        Judges readings; the procedure tells it what noise to expect.
    metadata : dict
        Goes into the sidecar at the end.
    restore : callable or None
        Puts back what the procedure changed in the rig, see :func:`~autotune.experiment.leaving.leave`.

    Raises
    ------
    ExperimentStopped, LinkError, OperatorStop
        From any step, as named verdicts; the block's exit has made the rig safe before a caller sees them.
    """

    def __init__(self, *, rig: Rig, envelope: Envelope, writer: RecordingWriter, extra: Sequence[str] = ()) -> None:
        self.rig = rig
        self.envelope = envelope
        self.watch = Watch()
        self.monitor = ReadingMonitor(envelope.patience, envelope.sample_time_s)
        self.metadata: dict[str, Any] = {}
        self.restore: Callable[[], None] | None = None
        self._writer = writer
        self._extra = tuple(extra)
        self._rows = RecentRows(writer.path)
        self._latency: deque[float] = deque(maxlen=KEPT_ROWS)
        self._lateness: deque[float] = deque(maxlen=KEPT_ROWS)
        self._decisions: deque[float] = deque(maxlen=KEPT_ROWS)
        self._exchange = rig.exchange if isinstance(rig, Exchanges) else None
        self._feed = rig.feed if isinstance(rig, Feeds) else None
        # a virtual clock lets nobody wait for a signal: slices would only be work for the plant
        waits = self._feed is not None or (isinstance(rig.clock, GoesOn) and rig.clock.goes_on)
        self._slice_s = SLICE_S if waits else math.inf
        self._missed, self._slots = 0, 1
        self._recent_slots: deque[int] = deque(maxlen=LOOK_BACK_ROWS)
        self._stop_signal = ""
        self._start_s = self._device_start_s = 0.0
        self._deadline_s = 0.0
        self._exits = contextlib.ExitStack()
        self.tick = Tick(k=-1, t_s=0.0, y=math.nan, usable=False, u=math.nan, slot=-1)
        self._reading = Reading(t_s=0.0, y=math.nan)

    @property
    def sample_time_s(self) -> float:
        """Control period [s]."""
        return self.envelope.sample_time_s

    @property
    def is_exact(self) -> bool:
        """Whether the rows of a sweep carry the device's own stamps, in which the link has no part."""
        return self._exchange is not None or isinstance(self.rig, RunsRelay)

    @property
    def patience_s(self) -> float:
        """How far the loop may be behind its schedule [s]."""
        return max(self.envelope.settings.late_s, LATE_SAMPLES * self.sample_time_s)

    @property
    def recording(self) -> Path:
        """File that the rows are written to."""
        return self._writer.path

    def __enter__(self) -> Self:
        warm_up()
        # a flag the loop looks at, so that no frame on the link is torn in two
        self._exits.enter_context(signals_heard(*_SIGNALS, by=lambda number: self._on_signal(_SIGNALS[number])))
        self._exits.enter_context(raise_priority(self.rig.clock))
        try:
            self.rig.open()
            self._start_s = self._deadline_s = self.rig.clock.now()
            self.monitor.commands.start_s = self._start_s
            limits = self.envelope.settings
            self._reading = self.rig.read()
            held = self._reading.u_applied if math.isfinite(self._reading.u_applied) else limits.u_safe
            self._device_start_s = self._reading.device_time_s
            self.tick = self._judge(self._reading, u=min(max(held, limits.u_min), limits.u_max))
            if self._exchange is not None:
                self._write_row(held, {})
        except BaseException as error:
            verdict = verdict_on(error)
            self._leave(verdict or error)
            if verdict is None:
                raise
            raise verdict from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        verdict = verdict_on(error)
        self._leave(verdict or error)
        if verdict is not None:
            raise verdict from error

    def nearest(self, u: float) -> float:
        """Return the allowed command nearest to ``u``: range, rate, resolution [u unit]."""
        return self.envelope.nearest(u, self.tick.u)

    def step(self, u: float, *, extra: Mapping[str, float] | None = None) -> Tick:
        """Hold ``u`` [u unit] until the next sample and return that sample."""
        self.envelope.check_command(u, self.tick.u)
        if self._exchange is not None:
            if not self._is_written:
                self._write_row(self.tick.u, {})
            self._wait()
            applied = self._reading.u_applied
            self._reading = self._exchange(u)
            self.tick = self._judge(self._reading, u=u)
            # what acts, to the converter's last count
            acting = self._reading.u_applied if math.isfinite(self._reading.u_applied) else u
            self._write_row(acting, {"u_applied": applied, **(extra or {})})
            return self.tick
        self._write_row(u, extra or {})
        self.rig.write(u)
        self._decisions.append(self.rig.clock.now() - self._reading.t_s)
        self._wait()
        self._reading = self.rig.read()
        self.tick = self._judge(self._reading, u=u)
        return self.tick

    @property
    def shows_applied(self) -> bool:
        """Whether the device said what it applied when the latest sample was taken."""
        return math.isfinite(self._reading.u_applied)

    @property
    def applied(self) -> float:
        """Output that the device applied when the latest sample was taken; the command where it does not say."""
        shown = self._reading.u_applied
        return shown if math.isfinite(shown) else self.tick.u

    def observe(self, *, extra: Mapping[str, float] | None = None) -> Tick:
        """Leave the output to the rig's own controller until the next sample, and return that sample.

        Raises
        ------
        ExperimentStopped
            From the limits on y, which hold as ever; or its output is beyond those of the command.
        """
        limits, applied = self.envelope.settings, self.applied
        slack = min(self.monitor.u_tolerance, 0.02 * (limits.u_max - limits.u_min))
        if not limits.u_min - slack <= applied <= limits.u_max + slack:
            raise ExperimentStopped(
                f"limit reached: the device's own controller puts out {applied:.4g},"
                f" outside {limits.u_min:g}..{limits.u_max:g}",
                remedy="limit its output in the device as limits.u_min..u_max do here",
            )
        self._write_row(applied, extra or {})
        self._wait()
        self._reading = self.rig.read()
        self.tick = self._judge(self._reading, u=self.applied)
        return self.tick

    def hold_while(self, action: Callable[[], None]) -> Tick:
        """Hold the command while something on the rig takes longer than a sample may, and return the sample after it.

        The samples meanwhile are not taken and none of the losses; the rows' times show the gap. The command is
        repeated before and after, which feeds the dead-man; the rig's own ends a gap that is too long.
        """
        u = self.tick.u
        self._write_row(u, {})
        self.rig.write(u)
        action()
        self.rig.write(u)
        gap = max(0, int((self.rig.clock.now() - self._deadline_s) / self.sample_time_s))
        self._deadline_s += gap * self.sample_time_s
        self.tick = replace(self.tick, slot=self.tick.slot + gap)
        self._wait()
        self._reading = self.rig.read()
        self.tick = self._judge(self._reading, u=u)
        return self.tick

    def begin(self, reading: Reading) -> None:
        """Take the sample after which a law on the device begins; its row is written with the one that follows."""
        if self._time_of(reading) > self.tick.t_s:
            if not self._is_written:
                self._write_row(self.tick.u, {})
            self._reading, self._slots = reading, 1
            self.tick = self._judge(reading, u=reading.u_applied)

    def follow(self, row: Row, *, extra: Mapping[str, float] | None = None) -> Tick:
        """Take a row of a law that the device runs by itself, and return its sample; a row lost on the line is NaN."""
        self._look_for_stop()
        if not self._is_written:
            self._write_row(row.u_mean, extra or {})
        lost = round((self._time_of(row.reading) - self.tick.t_s) / self.sample_time_s) - 1
        for _ in range(lost):
            before = self.tick
            t_s = before.t_s + self.sample_time_s
            self.tick = replace(before, k=before.k + 1, t_s=t_s, usable=False, slot=before.slot + 1)
            self._write_row(row.u_mean, extra or {})
        self._reading, self._slots = row.reading, 1  # what the host missed before is none of the device's
        self._deadline_s = self.rig.clock.now()
        self.tick = self._judge(row.reading, u=row.reading.u_applied)
        return self.tick

    @property
    def foreign(self) -> tuple[str, ...]:
        """What is to be said of commands that were not the loop's own, one sentence each."""
        return describe_foreign(self.monitor.commands.found)

    def history(self, start: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return t, u, y of the rows from number ``start`` on, (N,) each; y is NaN where a sample was unusable."""
        return self._rows.since(start)

    @property
    def timing(self) -> Timing:
        """Losses so far, latency and lateness of the latest samples."""

        def spread(values: Collection[float]) -> tuple[float, float, float]:
            if not values:
                return math.nan, math.nan, math.nan
            data = np.array(list(values))
            return float(np.median(data)), float(np.quantile(data, 0.99)), float(data.max())

        return Timing(
            latency_s=spread(self._latency),
            lateness_s=spread(self._lateness),
            decision_s=spread(self._decisions),
            missed=self._missed,
            unusable=self._rows.unusable,
            rows=len(self._rows),
        )

    def slower_than(self, latency_s: float) -> float:
        """Return the share of the latest readings that took longer [s]."""
        return sum(value > latency_s for value in self._latency) / max(len(self._latency), 1)

    @property
    def missed_share(self) -> float:
        """Share of the latest sample times whose sample was missed."""
        return 1.0 - len(self._recent_slots) / max(sum(self._recent_slots), 1)

    def comment(self, text: str) -> None:
        """Write a line into the recording for a person who reads it."""
        self._writer.comment(text)

    def note(self, **content: Any) -> None:
        """Put content into :attr:`metadata` and on the disk at once, for whoever goes on after a killed process."""
        self.metadata |= content
        try:
            self._writer.note(self.metadata)
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> ExperimentStopped:
        return ExperimentStopped(
            f"the recording cannot be written ({error.strerror})",
            where=str(self._writer.path),
            remedy="free space on the disk; no command is sent that is not on it first",
        )

    def _write_row(self, u: float, extra: Mapping[str, float]) -> None:
        y = self.tick.y if self.tick.usable else math.nan
        known = {"u_applied": self._reading.u_applied, **extra}
        try:
            self._writer.append((self.tick.t_s, u, y, *(known.get(name, math.nan) for name in self._extra)))
        except OSError as error:
            raise self._unwritable(error) from error
        self._rows.append(self.tick.t_s, u, y)

    def _wait(self) -> None:
        """Wait for the next absolute deadline; a missed one is counted and left out, the grid stays."""
        clock, step = self.rig.clock, self.sample_time_s
        self._deadline_s += step
        self._slots = 1
        behind_s = clock.now() - self._deadline_s
        if behind_s > self.patience_s:
            raise LinkError(
                f"link too slow: {behind_s:.3g} s behind the schedule of a sample every {step:g} s",
                remedy="raise signals.sample_time_s, or unload the computer or the link; autotune doctor measures it",
            )
        lost = max(0, int(behind_s / step + 1e-6))  # a deadline that is reached just now is not met a second time
        self._slots += lost
        self._missed += lost
        self._deadline_s += step * lost
        while True:
            self._look_for_stop()
            clock.sleep_until(min(self._deadline_s, clock.now() + self._slice_s))
            if clock.now() >= self._deadline_s - 1e-9:
                break
            if self._feed is not None:
                self._feed()
        self._lateness.append(max(0.0, clock.now() - self._deadline_s))
        self._recent_slots.append(self._slots)

    def _look_for_stop(self) -> None:
        if self._stop_signal:
            raise OperatorStop(f"stopped by {self._stop_signal}", remedy="run it again when ready")

    @property
    def _is_written(self) -> bool:
        """Whether the latest sample's row is on the disk."""
        return self.tick.k < len(self._rows)

    def _judge(self, reading: Reading, *, u: float) -> Tick:
        if math.isfinite(reading.latency_s):
            self._latency.append(reading.latency_s)
        t_s = self._time_of(reading)
        y, usable = self.monitor.judge(reading, u)
        tick = Tick(k=self.tick.k + 1, t_s=t_s, y=y, usable=usable, u=u, slot=self.tick.slot + self._slots)
        if self.monitor.recent:
            self.envelope.check_measurement(self.monitor.recent, self.watch, self.monitor.noise)
        self.envelope.check_time(t_s)
        return tick

    def _time_of(self, reading: Reading) -> float:
        """Return the time since the loop began [s], on the device's clock where that is exact."""
        if self._exchange is not None:
            return reading.device_time_s - self._device_start_s
        return reading.t_s - self._start_s

    def _on_signal(self, name: str) -> None:
        self._stop_signal = name

    def _leave(self, error: BaseException | None) -> None:
        """Leave the rig, and write down how and why; raises only where the end itself has to be one."""
        farewell = leave(self.rig, error, self.restore)
        unconfirmed = None
        if error is None and not farewell.is_confirmed:
            error = unconfirmed = LinkError(
                f"the safe output could not be confirmed ({farewell.error})",
                where="hand back",
                remedy="its dead-man timer has to act",
            )
        if error is not None:
            say(error, farewell.note)
        if self.tick.k >= 0:
            with contextlib.suppress(OSError):
                self._write_last_row()
        self.metadata["ended"] = _reason(error) | {"output": farewell.output}
        if farewell.note:
            self.metadata["ended"]["note"] = farewell.note
        self.metadata["timing"] = self.timing.to_table()
        if self.foreign:
            self.metadata["foreign_commands"] = list(self.foreign)
        with contextlib.suppress(OSError):  # a full disk must not hide why the loop ended
            self._writer.finish(self.metadata)
        self._exits.close()
        if unconfirmed is not None:
            raise unconfirmed

    def _write_last_row(self) -> None:
        """Write the last sample, which only the safe command followed; NaN where the link broke first."""
        t_s, y = self._time_of(self._reading), self._reading.y
        written_s = self._rows.last_s
        if as_written(t_s) <= written_s:
            t_s, y = max(t_s + self.rig.clock.now() - self._reading.t_s, written_s + SHORTLY_S), math.nan
        self._writer.append((t_s, self.envelope.settings.u_safe, y, *(math.nan for _ in self._extra)))


def _reason(error: BaseException | None) -> dict[str, Any]:
    if error is None:
        return {"reason": "completed", "exit_status": 0}
    if isinstance(error, AutotuneError):
        return {"reason": str(error), "verdict": type(error).__name__, "exit_status": error.exit_status}
    return {"reason": f"{type(error).__name__}: {error}", "verdict": type(error).__name__, "exit_status": 1}
