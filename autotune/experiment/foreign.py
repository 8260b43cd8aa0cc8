"""Tells commands that are not the session's own: another master that writes the actuator now and then."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from autotune.errors import ExperimentStopped
from autotune.experiment.rig import Reading

#: so many foreign commands within so long are ridden through [s]
RIDDEN_THROUGH, WITHIN_S = 2, 30.0
#: how long, and for how many samples at least, a device may go on showing an earlier command [s]
LATE_S, LATE_SAMPLES = 0.1, 5
#: how many times its own rounding and noise an output is beyond the commands where it is none of the session, and how
#: many samples tell what these are; until then they count as large as they may be
BEYOND, LEARNT_FROM = 5.0, 50


@dataclass(frozen=True, kw_only=True)
class ForeignCommand:
    """A command that was not the session's own.

    Attributes
    ----------
    t_s : float
        When it was seen, since the session began [s].
    u, commanded : float
        What was there, and what had been commanded [u unit].
    """

    t_s: float
    u: float
    commanded: float


class CommandWatch:
    """Compares what the device says of its command and output with what was commanded.

    Notes
    -----
    The command's register, where the rig reads it back, tells every foreign write that it still holds. An output that
    the device shows is foreign where it was at one of the latest commands and leaves all of them, and what lies between
    them, although nothing was commanded: a slow actuator does not do that. A foreign command between the two levels of
    a relay that has just switched is not told from an actuator on its way.

    Attributes
    ----------
    found : list of ForeignCommand
        The oldest first.
    ridden_through : int
        How many within half a minute do not end the session.
    start_s : float
        When the session began, on the rig's clock [s].
    """

    def __init__(self) -> None:
        self.found: list[ForeignCommand] = []
        self.ridden_through = RIDDEN_THROUGH
        self.start_s = 0.0
        self._latest: deque[tuple[float, float]] = deque()
        self._was_own = False
        self._off, self._learnt = 0.0, 0  # largest distance of an output that was a command's, of how many

    def look(self, reading: Reading, u: float, tolerance: float) -> None:
        """Look at a sample.

        Parameters
        ----------
        reading : Reading
            The new sample.
        u : float
            Command that was held until now [u unit].
        tolerance : float
            Difference between commanded and applied output that is the device's rounding [u unit].

        Raises
        ------
        ExperimentStopped
            More foreign commands than are ridden through.
        """
        held = self._foreign_output(reading, u, tolerance)
        if math.isfinite(reading.foreign_u):
            held = reading.foreign_u
        if math.isnan(held):
            return
        now_s = reading.t_s - self.start_s
        self.found.append(ForeignCommand(t_s=now_s, u=held, commanded=u))
        recent = [one for one in self.found if one.t_s > now_s - WITHIN_S]
        if len(recent) > self.ridden_through:
            told = ", ".join(f"{one.u:.4g} at {one.t_s:.4g} s for {one.commanded:.4g}" for one in recent)
            raise ExperimentStopped(
                f"another master writes the command: it was {told}",
                where="actuator",
                remedy="end the other session; only one master may command",
            )

    def _foreign_output(self, reading: Reading, u: float, tolerance: float) -> float:
        """Return the output where it has left every command by itself; NaN where it has not, or nobody says it."""
        self._latest.append((reading.t_s, u))
        while len(self._latest) > LATE_SAMPLES and self._latest[0][0] < reading.t_s - LATE_S:
            self._latest.popleft()
        if not math.isfinite(reading.u_applied):
            return math.nan
        commands = [command for _, command in self._latest]
        off = min(abs(reading.u_applied - command) for command in commands)
        outside = max(min(commands) - reading.u_applied, reading.u_applied - max(commands), 0.0)
        was_own, self._was_own = self._was_own, off <= tolerance
        if self._was_own and math.isfinite(tolerance):
            self._off, self._learnt = max(self._off, off), self._learnt + 1
        usual = self._off if self._learnt >= LEARNT_FROM else tolerance
        return reading.u_applied if was_own and outside > max(tolerance, BEYOND * usual) else math.nan


def describe_foreign(found: Sequence[ForeignCommand]) -> tuple[str, ...]:
    """Return what the reader should know of foreign commands that were ridden through, each with its time."""
    return tuple(
        f"another master wrote the command: it was {one.u:.4g} at {one.t_s:.4g} s where {one.commanded:.4g} was"
        " commanded; the limit cycle that ran then was measured anew"
        for one in found
    )
