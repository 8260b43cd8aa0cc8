"""A recording as a rig: what was measured comes back row by row, on a virtual clock."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from autotune.config.rig import ReplaySettings
from autotune.errors import LinkError
from autotune.experiment.rig import Reading
from autotune.recording import Recording, read_recording
from drivers.kinds import Reach, Session


class ReplayClock:
    """Time as the recording tells it."""

    def __init__(self, start_s: float) -> None:
        self._now_s = start_s

    def now(self) -> float:
        """Return the time [s]."""
        return self._now_s

    def sleep_until(self, t_s: float) -> None:
        """Move the time to ``t_s`` [s]."""
        self._now_s = max(self._now_s, t_s)


class ReplayRig:
    """A recording that answers as the rig did.

    Parameters
    ----------
    recording : Recording
        What was recorded.
    tolerance : float
        Largest difference between a command and the recorded one [u unit].

    Notes
    -----
    The plant behind a recording cannot answer other commands than those it got, so a command that differs ends the
    replay: the procedure that is run must be the one that was recorded.
    """

    def __init__(self, recording: Recording, *, tolerance: float = 1e-6) -> None:
        self._recording = recording
        self._tolerance = tolerance
        self._clock = ReplayClock(float(recording.t[0]))
        self._row = -1
        self._is_open = False
        held = np.concatenate(([math.nan], recording.u[:-1]))
        self._u_applied = recording.extra.get("u_applied", held)
        self._device_time = recording.extra.get("device_time", np.full(len(recording), math.nan))

    @property
    def clock(self) -> ReplayClock:
        """The recording's clock."""
        return self._clock

    def open(self) -> None:
        """Start at the first row."""
        self._is_open = True
        self._row = -1

    def read(self) -> Reading:
        """Return the next row's measurement.

        Raises
        ------
        LinkError
            The recording has no further row.
        """
        self._require_open()
        if self._row + 1 >= len(self._recording):
            raise LinkError(
                f"the recording ends at t = {self._recording.t[-1]:g} s",
                where=self._recording.name,
                remedy="replay it with the settings it was recorded with",
            )
        self._row += 1
        t_s = float(self._recording.t[self._row])
        self._clock.sleep_until(t_s)
        return Reading(
            t_s=t_s,
            y=float(self._recording.y[self._row]),
            u_applied=float(self._u_applied[self._row]),
            device_time_s=float(self._device_time[self._row]),
        )

    def write(self, u: float) -> None:
        """Compare a command with the recorded one.

        Raises
        ------
        LinkError
            It differs, so that the recorded answers are no answers to it.
        """
        self._require_open()
        row = max(self._row, 0)
        recorded = float(self._recording.u[row])
        if not abs(u - recorded) <= self._tolerance:
            raise LinkError(
                f"command {u:g} at t = {self._recording.t[row]:g} s, where {recorded:g} was recorded",
                where=self._recording.name,
                remedy="replay it with the settings it was recorded with",
            )

    def make_safe(self) -> None:
        """Do nothing: a recording moves nothing."""

    def close(self) -> None:
        """End the replay."""
        self._is_open = False

    def _require_open(self) -> None:
        if not self._is_open:
            raise LinkError("the rig is not open", where=self._recording.name, remedy="open it before the first sample")


class ExchangeReplayRig(ReplayRig):
    """A recording of a rig that took commands and samples at one instant: a row's command comes from the row before."""

    def read(self) -> Reading:
        """Return the next row's measurement, with the command that acts from its instant on."""
        reading = super().read()
        return replace(reading, u_applied=float(self._recording.u[self._row]), device_time_s=reading.t_s)

    def exchange(self, u: float) -> Reading:
        """Return the next row, whose recorded command ``u`` [u unit] is compared with."""
        reading = self.read()
        self.write(u)
        return reading


def open_kind(settings: ReplaySettings, session: Session) -> ReplayRig:
    """Return the rig that ``[rig] kind = "replay"`` describes.

    Parameters
    ----------
    settings : ReplaySettings
        The table ``[rig]``.
    session : Session
        What it is opened for; not used.
    """
    recording = read_recording(settings.recording)
    kind = ExchangeReplayRig if recording.metadata.get("rig") == "serial" else ReplayRig
    return kind(recording, tolerance=settings.tolerance)


def reach_of(settings: ReplaySettings) -> Reach:
    """Return the recording."""
    return Reach(files=(settings.recording,))
