"""What an onlooker knows of a run: read from its folder as the files grow, and as well when they have ended."""

from __future__ import annotations

import math
import time
from array import array
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.errors import InputError
from autotune.experiment.monitor import RECENT
from autotune.experiment.result import State
from autotune.live.events import (
    Analysed,
    Ended,
    Event,
    GainsKnown,
    InProgress,
    RecordingBegins,
    Relay,
    RunBegins,
    Told,
    Verified,
    Waiting,
    read_event,
)
from autotune.models import TransferFunction
from autotune.pipeline import PROGRESS
from autotune.points import LARGEST, FrequencyPoint
from autotune.text_files import read_toml

#: part of limits.swing from which on y counts as near the limit
NEAR_SHARE = 0.95
#: time that nearness is judged over [s]
RECENT_S = 3.0


class Tail:
    """The whole lines of a file that grows; a line that is not finished waits for its end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def lines(self) -> list[str]:
        """Return the lines that have been finished since the last call; none while there is no file."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                text = file.read()
        except FileNotFoundError:
            return []
        whole = text[: text.rfind(b"\n") + 1]
        self._offset += len(whole)
        return whole.decode("utf-8", errors="replace").splitlines()


@dataclass(kw_only=True)
class Rows:
    """Rows of all recordings of a run, one after the other on one axis of time."""

    t: array[float] = field(default_factory=lambda: array("d"))
    u: array[float] = field(default_factory=lambda: array("d"))
    y: array[float] = field(default_factory=lambda: array("d"))
    r: array[float] = field(default_factory=lambda: array("d"))

    def since(self, t_s: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return t, u, y, r of the rows from ``t_s`` [s] on, (N,) each."""
        t = np.array(self.t)
        first = int(np.searchsorted(t, t_s))
        return t[first:], np.array(self.u[first:]), np.array(self.y[first:]), np.array(self.r[first:])


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Old and new gains, and whether the rig holds the new ones."""

    old: PIDController | None
    new: PIDController
    deployed: bool


class Story:
    """A run as far as its folder tells.

    Attributes
    ----------
    rows : Rows
        Samples so far.
    marks : list of (float, str)
        Times at which a state or a recording began [s].
    news : int
        Counts what changed beside the rows.
    state, message : str
        Where the procedure is, and what happens.
    sign : int
        Sign of the plant's gain as far as known.
    points, plant, reduced, controller, steps, accepted, verdict, gains
        What was found so far; None, empty or False before.
    waiting_s : float
        How long the operator may decide otherwise [s], 0 while there is nothing to decide.
    ended : str or None
        Reason.
    output : str
        How the rig was left, once that is known.

    unread : int
        Lines that were no events or rows.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._events = Tail(folder / PROGRESS)
        self._recording: Tail | None = None
        self._columns: list[str] = []
        self._sidecar: Path | None = None
        self._start_s = 0.0
        self._remaining_s, self._told_s = math.nan, 0.0
        self._relay: Relay | None = None
        self.rows = Rows()
        self.config: Told | None = None
        self.unread = 0
        self.marks: list[tuple[float, str]] = []
        self.news = 0
        self.state, self.message = "connect", "waiting for the run to begin"
        self._told: list[str] = []
        self.sign = 1
        self.points: tuple[FrequencyPoint, ...] = ()
        self.plant: TransferFunction | None = None
        self.reduced: TransferFunction | None = None
        self.controller: PIDController | None = None
        self.steps: dict[str, list[float]] = {}
        self.accepted, self.verdict = False, ""
        self.gains: Gains | None = None
        self.waiting_s = 0.0
        self._asked_s = 0.0
        self.ended: str | None = None
        self.output = ""

    def poll(self) -> bool:
        """Read what is new, and say whether there was anything."""
        lines = self._events.lines()
        for line in lines:
            event = read_event(line)
            if event is None:
                self.unread += 1
            else:
                self._take(event)
        self.news += len(lines)
        return self._read_rows() or bool(lines)

    def _take(self, event: Event) -> None:
        match event:
            case RunBegins():
                self.config, self.ended = event.config, None
            case RecordingBegins():
                self._begin_recording(event.file)
            case InProgress():
                self._progress(event)
            case Analysed():
                self.points = event.points
                self.plant = event.plant.transfer_function()
                self.reduced = event.reduced.transfer_function() if event.reduced is not None else None
                self.controller = event.controller.controller()
                self.sign = 1 if self.controller.K > 0 else -1
                self.message = "controller designed"
            case Verified():
                self.steps = {str(n): [math.nan if v is None else v for v in c] for n, c in event.steps.items()}
                self.accepted, self.verdict = event.accepted, event.reason
            case GainsKnown():
                old = event.old.controller() if event.old is not None else None
                self.gains = Gains(old=old, new=event.new.controller(), deployed=event.deployed)
                self.waiting_s = 0.0
            case Waiting():
                self.waiting_s, self._asked_s = event.patience_s, time.monotonic()
            case Ended():
                self.ended, self.waiting_s = event.reason, 0.0
                self.output = self._output()

    def _begin_recording(self, name: str) -> None:
        self._read_rows()  # the one before is complete
        self._start_s = self.now_s
        path = self._folder / name
        if path.is_symlink():  # a run makes none, and what it leads to is not of this run
            self.unread += 1
            return
        self._recording, self._columns, self._sidecar = Tail(path), [], path.with_suffix(".toml")
        if self.controller is not None:
            self._enter(State.VERIFY.value, self._start_s)
            self.message = "bringing the rig to its operating point under the new gains"
            self._remaining_s = math.nan

    def _output(self) -> str:
        """Return how the last recording says the rig was left."""
        if self._sidecar is None or not self._sidecar.is_file():
            return ""
        try:
            ended = read_toml(self._sidecar).get("ended")
        except InputError:
            return ""
        return str(ended.get("output", ""))[:80] if isinstance(ended, dict) else ""

    def _progress(self, event: InProgress) -> None:
        at_s = self._start_s + event.elapsed_s
        self._enter(event.state, at_s)
        self.message = event.message
        self._remaining_s = math.nan if event.remaining_s is None else event.remaining_s
        self._told_s = at_s
        self._relay = event.relay
        self.sign = self._relay.plant_sign if self._relay is not None else self.sign
        self._told = list(event.warnings) or self._told
        if event.points:
            self.points = event.points

    def _enter(self, state: str, at_s: float) -> None:
        if state != self.state:
            self.marks.append((at_s, state))
        self.state = state

    def _read_rows(self) -> bool:
        lines = self._recording.lines() if self._recording is not None else []
        for line in lines:
            if line.startswith("#") or not line:
                continue
            if not self._columns:
                self._columns = line.split(",")
            elif not self._add_row(line.split(",")):
                self.unread += 1
        return bool(lines)

    def _add_row(self, cells: list[str]) -> bool:
        """Take a row, and say whether it is one: numbers in every column, at a time that goes on."""
        try:
            row = dict(zip(self._columns, map(float, cells), strict=True))
            t, u, y = self._start_s + row["t"], row["u"], row["y"]
        except (ValueError, KeyError):
            return False
        if not (abs(t) <= LARGEST and t >= self.now_s):
            return False
        for column, value in ((self.rows.t, t), (self.rows.u, u), (self.rows.y, y)):
            column.append(value)
        self.rows.r.append(row.get("r", self.centre))
        return True

    @property
    def now_s(self) -> float:
        """Rig time of the last row [s]."""
        return self.rows.t[-1] if self.rows.t else 0.0

    @property
    def centre(self) -> float:
        """Operating point [y unit]; NaN while unknown."""
        return self.config.operating_point.y if self.config is not None else math.nan

    @property
    def limits(self) -> dict[str, float]:
        """The configuration's limits; empty while unknown."""
        return self.config.limits.model_dump() if self.config is not None else {}

    @property
    def units(self) -> tuple[str, str]:
        """Units of u and y."""
        return (self.config.signals.u_unit, self.config.signals.y_unit) if self.config is not None else ("", "")

    @property
    def remaining_s(self) -> float:
        """Rig time that the present state is still expected to take [s]; NaN while nobody can know."""
        return max(0.0, self._remaining_s - (self.now_s - self._told_s))

    @property
    def decision_s(self) -> float:
        """Time left to decide otherwise, counted from when this process heard of it [s]."""
        return max(0.0, self.waiting_s - (time.monotonic() - self._asked_s))

    def relay_text(self) -> str:
        """Return what the relay does now, in words; nothing while none runs."""
        if self.config is None or self._relay is None or self.state != State.SWEEP.value or not self.rows.u:
            return ""
        u_unit, y_unit = self.units
        relay = self._relay
        delay_s = (relay.delay_samples + 0.5 * (relay.smoothing - 1)) * self.config.signals.sample_time_s
        side = "high" if self.rows.u[-1] > relay.midpoint else "low"
        return (
            f"Relay {side}: {relay.midpoint:.4g} ± {relay.amplitude:.3g} {u_unit}, inserted delay"
            f" {delay_s:.3g} s, hysteresis {relay.hysteresis:.2g} {y_unit}"
        )

    def limits_text(self) -> str:
        """Return the limits in words; nothing while they are unknown."""
        if not self.limits:
            return ""
        limits, (u_unit, y_unit) = self.limits, self.units
        return (
            f"Limits: u {limits['u_min']:g} to {limits['u_max']:g} {u_unit}, safe {limits['u_safe']:g} {u_unit};"
            f" y {limits['y_min']:g} to {limits['y_max']:g} {y_unit},"
            f" within {limits['swing']:g} {y_unit} of {self.centre:g} {y_unit} (shaded); {limits['time_s']:g} s in all"
        )

    def outcome_text(self) -> str:
        """Return what came of the new gains: how they were tried, and which ones the rig holds."""
        tried = f"{'Accepted' if self.accepted else 'Not accepted'}: {self.verdict}."
        if not self.verdict:
            tried = "Designed, not tried on the rig."
        if self.gains is None:
            return tried
        if self.gains.old is None:
            return f"{tried} The rig has no controller of its own: the gains are in result.json."
        simulated = "simulated " if self.config is not None and self.config.rig.kind == "simulated" else ""
        return f"{tried} The {simulated}rig holds the {'new' if self.gains.deployed else 'old'} gains."

    def warnings(self) -> list[str]:
        """Return what an onlooker should know, in words."""
        found = list(self._told)
        if self.unread:
            found.append(f"{self.unread} damaged lines of the run's files are left out: this page may lack something")
        swing = self.limits.get("swing", math.inf)
        floats = self.state == State.SWEEP.value and self.ended is None
        y = self.rows.since(self.now_s - RECENT_S)[2] if floats else np.empty(0)
        if y.size > RECENT:
            medians = np.median(sliding_window_view(y, RECENT), axis=1)  # what the limits are judged on
            departure = float(np.nanmax(np.abs(medians - self.centre), initial=0.0))
            if departure > NEAR_SHARE * swing:
                share = 100 * departure / swing
                found.append(f"y comes near its limit: {share:.0f} % of the allowed swing of {swing:g} {self.units[1]}")
        return found
