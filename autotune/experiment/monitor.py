"""Judges readings as they come: not a number, out of reach, frozen, garbled, and an actuator that does not follow."""

from __future__ import annotations

import math
from collections import deque
from statistics import median

from autotune.errors import ExperimentStopped, LinkError
from autotune.experiment.foreign import CommandWatch
from autotune.experiment.limits import Patience
from autotune.experiment.rig import Reading

#: readings whose median stands for y where limits are judged
RECENT = 5
#: share of unusable readings at which the signal is called garbled, among so many: more where a run that is ridden
#: through would be as much
GARBLED_SHARE, GARBLED_OF = 0.25, 100
#: fewest equal readings that a frozen sensor is told from a link that has nothing new by
FEWEST_REPEATS = 10


class ReadingMonitor:
    """State of what the last readings were like.

    Parameters
    ----------
    patience : Patience
        Without a usable reading; an actuator may be late for twice as long.
    sample_time_s : float
        Control period [s].

    Attributes
    ----------
    noise : float
        Half-width of the measurement noise as far as known [y unit].
    jump : float
        Largest credible change of y within a few samples, noise apart [y unit]; a reading beyond it is unusable. Where
        samples were lost, as much more as there are more of them.
    same_s : float
        Time of equal readings after which the sensor counts as frozen [s]; infinite while nobody knows what to expect.
    u_tolerance : float
        Difference between commanded and applied output that is the device's rounding [u unit].
    recent : tuple of float
        The last usable readings, the newest last.
    commands : CommandWatch
        Tells commands that are not the session's own.
    """

    def __init__(self, patience: Patience, sample_time_s: float) -> None:
        self.noise = 0.0
        self.jump = math.inf
        self.same_s = math.inf
        self.u_tolerance = math.inf
        self.recent: tuple[float, ...] = ()
        self.commands = CommandWatch()
        self._patience = patience
        self._bad_run = self._repeats = self._not_followed = 0
        # when a reading was last usable, y last changed, and the actuator first did not follow
        self._usable_s = self._changed_s = self._astray_s = math.nan
        self._last_device_time_s = self._last_s = math.nan
        self._sample_time_s = sample_time_s
        self._lost: deque[int] = deque(maxlen=RECENT)  # samples lost before each of the latest readings
        longest_run = min(patience.samples, patience.seconds / sample_time_s)
        self._usable: deque[bool] = deque(maxlen=max(GARBLED_OF, math.ceil(longest_run / GARBLED_SHARE)))

    def judge(self, reading: Reading, u: float) -> tuple[float, bool]:
        """Return the measurement to use, and whether it is this reading's own.

        Parameters
        ----------
        reading : Reading
            The new sample.
        u : float
            Command that was held until now [u unit].

        Raises
        ------
        ExperimentStopped, LinkError
            The verdict on a sensor, link or actuator that has failed.
        """
        self.commands.look(reading, u, self.u_tolerance)
        pace = (reading.t_s - self._last_s) / self._sample_time_s
        self._last_s = reading.t_s
        self._lost.append(max(0, round(pace) - 1) if math.isfinite(pace) else 0)
        reason = self._unusable(reading)
        self._usable.append(not reason)
        if math.isnan(self._usable_s):
            self._usable_s = self._changed_s = reading.t_s
        if reason:
            self._bad_run += 1
            blind_s = reading.t_s - self._usable_s
            if self._patience.is_over(blind_s, self._bad_run):
                said = f"{reason}, {self._bad_run} reading(s) in a row: nothing to go by for {blind_s:.3g} s"
                if reading.suspect:
                    remedy = "check cable and load of the line; limits.blind_s says how long this may last"
                    raise LinkError(said, where="link", remedy=remedy)
                remedy = "check the sensor, its wiring and its scaling in the configuration"
                raise ExperimentStopped(said, where="sensor", remedy=remedy)
            wrong, looked_at = self._usable.count(False), len(self._usable)
            if looked_at == self._usable.maxlen and wrong > looked_at * GARBLED_SHARE:
                raise ExperimentStopped(
                    f"garbled sensor: {wrong} of the last {looked_at} readings were unusable (last: {reason})",
                    where="sensor",
                    remedy="check the sensor's wiring and shielding",
                )
            return (self.recent[-1] if self.recent else math.nan), False
        self._bad_run, self._usable_s = 0, reading.t_s
        self._check_fresh(reading)
        self._check_followed(reading, u)
        self.recent = (*self.recent[1 - RECENT :], reading.y)
        return reading.y, True

    def _unusable(self, reading: Reading) -> str:
        if not math.isfinite(reading.y):
            return "the sensor answers not a number"
        if reading.suspect:
            return "the link answers unreliably"
        # near the last one or the median: the median is late where y turns within few samples, and one wild reading
        # that was let through does not make the next good one wild
        jump = self.jump * (1.0 + sum(self._lost) / RECENT) + 2.0 * self.noise
        if self.recent and min(abs(reading.y - near) for near in (self.recent[-1], median(self.recent))) > jump:
            return f"the sensor jumps from {median(self.recent):.4g} to {reading.y:.4g}"
        return ""

    def _check_fresh(self, reading: Reading) -> None:
        old_stamp = reading.device_time_s == self._last_device_time_s
        self._last_device_time_s = reading.device_time_s
        same = old_stamp or bool(self.recent and reading.y == self.recent[-1])
        if not same:
            self._repeats, self._changed_s = 0, reading.t_s
            return
        self._repeats += 1
        same_s = reading.t_s - self._changed_s
        if self._repeats >= FEWEST_REPEATS and same_s >= self.same_s:
            raise ExperimentStopped(
                f"stale sensor: y = {reading.y:.6g} has not changed for {same_s:.3g} s",
                where="sensor",
                remedy="check that the sensor runs and that the device sends new values",
            )

    def _check_followed(self, reading: Reading, u: float) -> None:
        off = math.isfinite(reading.u_applied) and abs(reading.u_applied - u) > self.u_tolerance
        self._not_followed = self._not_followed + 1 if off else 0
        if self._not_followed == 1:
            self._astray_s = reading.t_s
        if off and self._patience.is_over(reading.t_s - self._astray_s, self._not_followed, times=2.0):
            raise ExperimentStopped(
                f"the actuator does not follow: commanded {u:.4g}, the device applies {reading.u_applied:.4g}",
                where="actuator",
                remedy="look for saturation, a stuck actuator or a wrong scaling of the output",
            )
