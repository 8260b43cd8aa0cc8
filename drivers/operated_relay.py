"""A PLC that runs the relay by itself, in every cycle; the host writes one array and reads another."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

from autotune.config.registers import RegisterMap
from autotune.config.rig import RelayNodes
from autotune.errors import ExperimentStopped, InputError, LinkError, NotTaken
from autotune.experiment.relay import RelaySettings
from autotune.experiment.rig import Reading, Row
from drivers.gain_rig import TypedGainRig
from drivers.register_link import RegisterLink

#: places of ROWS: number of the law, mode, rows so far, y as the relay ended; then rows in a ring, so many numbers each
_HEAD, _RING, _EACH = 4, 64, 4
#: numbers of LAW
_LAW = 14
#: mode in which the relay has the output
_RELAY = 2.0
#: numbers of laws, which begin again after the last
_NUMBERS = 1_000_000
#: part of the ring that may have been filled when it is read again, and time that is waited at least [s]
_SHARE, _SHORTEST_S = 0.125, 0.002
_MOST_CYCLES = 2**31 - 1


class Arrays(Protocol):
    """A link that carries arrays of numbers."""

    def read_numbers(self, place: str) -> list[float]:
        """Return the numbers of an array."""
        ...

    def may_write(self, place: str) -> bool:
        """Return whether a place may be written."""
        ...

    def write_numbers(self, place: str, numbers: Sequence[float]) -> None:
        """Write the numbers of an array.

        Parameters
        ----------
        place : str
            The array.
        numbers : sequence of float
            All of its elements.
        """
        ...


def tell_relay(arrays: Arrays, relay: RelayNodes) -> str:
    """Look at both arrays, write nothing, and return what the device says of its relay.

    Parameters
    ----------
    arrays : Arrays
        What reads them.
    relay : RelayNodes
        Where they are.

    Raises
    ------
    LinkError
        One is not there, has another length, or may not be written.
    """
    for place, name, count in ((relay.law, "LAW", _LAW), (relay.rows, "ROWS", _HEAD + _RING * _EACH)):
        numbers = arrays.read_numbers(place)
        if len(numbers) != count:
            raise LinkError(
                f"{place} has {len(numbers)} numbers, not {count}",
                remedy=f"map rig.relay.{name.lower()} to {name} of OPERATED_RIG",
            )
    if not arrays.may_write(relay.law):
        raise LinkError(f"{relay.law} is read-only", remedy="let the server's user write LAW of OPERATED_RIG")
    return f"a relay in the device, law {numbers[0]:g} taken, mode {numbers[1]:g}"


class OperatedRelayRig(TypedGainRig):
    """A device with the block OPERATED_RIG; further parameters as of :class:`drivers.register_rig.RegisterRig`.

    Parameters
    ----------
    arrays : Arrays
        The link once more.
    relay : RelayNodes
        Where the arrays are.

    Notes
    -----
    Rows have the device's own time: from one to the next it is the time between rows, however late the host reads
    them. They are read some at a time, and none is lost while the host is no more than a ring of 64 behind.
    """

    #: readings in the longest average that the block's relay can look at
    smoothing_max = 32

    def __init__(
        self, link: RegisterLink, registers: RegisterMap, *, arrays: Arrays, relay: RelayNodes, **settings: Any
    ) -> None:
        super().__init__(link, registers, **settings)
        self._arrays, self._relay = arrays, relay
        self._law = 0.0  # number of the law that the device runs; 0 where it runs none
        self._rows: deque[Row] = deque()
        self._count, self._area = 0, 0.0  # of the last row that was taken
        self._began_s = self._row_s = self._until_s = 0.0
        self._ticks = 1
        self._range = (-math.inf, math.inf)

    def open(self) -> None:
        """Look whether both arrays are there, then take command; see the base class.

        Raises
        ------
        NotTaken
            An array is missing, is another one, or may not be written; nothing was written.
        """
        try:
            self._link.connect()
            tell_relay(self._arrays, self._relay)
        except LinkError as error:
            self.close()
            raise NotTaken(error.what, where=error.where or self._link.where, remedy=error.remedy) from None
        super().open()

    @property
    def tick_s(self) -> float:
        """Cycle of the device's program [s]."""
        return self._scan_s

    def start_relay(
        self, settings: RelaySettings, *, row_s: float, time_s: float, y_range: tuple[float, float]
    ) -> Reading:
        """Have the device run the relay from its next cycle on, or change the setting of one that runs.

        Parameters
        ----------
        settings : RelaySettings
            Delay in cycles of the device, see :attr:`tick_s`.
        row_s : float
            Time from row to row [s], a multiple of a cycle.
        time_s : float
            Time after which the device ends it at the safe output [s].
        y_range : (float, float)
            Limits on y; the device goes safe where y passes them [y unit].

        Returns
        -------
        Reading
            The sample after which the relay begins.

        Raises
        ------
        InputError
            ``row_s`` is no multiple of a cycle.
        LinkError
            The device does not answer, or does not take the setting.
        """
        self._require(self._is_commanding, "the host is not in command", "open the rig again")
        ticks = round(row_s / self.tick_s)
        if ticks < 1 or abs(ticks * self.tick_s - row_s) > 1e-6 * row_s:
            raise InputError(
                f"rows every {row_s:g} s are no multiple of the device's cycle of {self.tick_s:g} s",
                where="signals.sample_time_s",
                remedy="give a multiple of rig.scan_time_s",
            )
        runs, reading = self._law != 0.0, self._ask()[0]
        self._range, self._until_s = y_range, self._clock.now() + time_s
        number = float(int(self._arrays.read_numbers(self._relay.rows)[0]) % _NUMBERS + 1)
        low, high = y_range
        cycles = min(round(time_s / self.tick_s), _MOST_CYCLES)
        law = (1.0, settings.y_centre, settings.midpoint, settings.amplitude, settings.hysteresis)
        further = (settings.delay_samples, settings.smoothing, settings.plant_sign, ticks, cycles, low, high)
        sent_s = self._clock.now()
        self._arrays.write_numbers(self._relay.law, [number, *law, *map(float, further), number])
        if not runs:
            self._began_s = 0.5 * (sent_s + self._clock.now())
            self._row_s, self._ticks, self._count, self._area = row_s, ticks, 0, 0.0
            self._rows.clear()
        self._await_law(number)
        self._law = number
        return reading

    def row(self) -> Row:
        """Wait for the next row of the relay that runs, and feed the dead-man meanwhile.

        Raises
        ------
        ExperimentStopped
            The device ended the relay: y passed a limit, or the time is over.
        LinkError
            It ended for another reason, or no row came.
        """
        start_s, patience_s = self._clock.now(), max(self._late_s, 4.0 * self._row_s, 4.0 * self._feed_s)
        while not self._rows:
            self.feed()
            numbers = self._arrays.read_numbers(self._relay.rows)
            self._take_rows(numbers)
            if self._rows:
                break
            if (numbers[0], numbers[1]) != (self._law, _RELAY):
                raise self._reason_of_end(numbers)
            self._require(
                self._clock.now() - start_s < patience_s, "no row came", "look whether the device's program runs"
            )
            wait_s = max(min(_SHARE * _RING * self._row_s, self._feed_s, self._row_s), _SHORTEST_S)
            self._clock.sleep_until(self._clock.now() + wait_s)
        return self._rows.popleft()

    def write(self, u: float) -> None:
        """Command the actuator [u unit], and end the relay that the device runs without a bump; see the base class."""
        super().write(u)
        if self._law == 0.0:
            return
        self._end_law()
        self._await_command(1.0)

    def make_safe(self) -> None:
        """Command the safe output, give the actuator back and see the relay end; see the base class."""
        runs, self._law = self._law != 0.0, 0.0
        super().make_safe()
        if runs:  # the echo of the heartbeat may be of a cycle before the one that gives the actuator back
            self._await_end()

    def hand_back(self) -> None:
        """Give the actuator back to the device's own controller; see the base class."""
        self._law = 0.0
        super().hand_back()

    def close(self) -> None:
        """Disconnect."""
        self._law = 0.0
        super().close()

    def _end_law(self) -> None:
        number = float(int(self._law) % _NUMBERS + 1)
        self._law = 0.0
        self._arrays.write_numbers(self._relay.law, [number, *[0.0] * 12, number])

    def _await_law(self, number: float) -> None:
        """Wait until the device has taken a law, and runs it."""
        start_s = self._clock.now()
        while (numbers := self._arrays.read_numbers(self._relay.rows))[:2] != [number, _RELAY]:
            waited_s = self._clock.now() - start_s
            self._require(
                waited_s < max(0.25, self._late_s),
                f"the device does not start its relay after {waited_s:.2g} s"
                f" (law {numbers[0]:g} of {number:g}, mode {numbers[1]:g})",
                "look whether rig.relay.law is the input LAW of OPERATED_RIG, and what tripped it",
            )
            self.feed()
            self._clock.sleep_until(self._clock.now() + 0.25 * self._scan_s)

    def _await_end(self) -> None:
        """Wait until the device's relay has let go of the output."""
        start_s = self._clock.now()
        while self._arrays.read_numbers(self._relay.rows)[1] == _RELAY:
            waited_s = self._clock.now() - start_s
            self._require(
                waited_s < max(0.25, self._late_s),
                f"the device's relay goes on {waited_s:.2g} s after it was to end",
                "stop the device by hand, and look whether its program runs",
            )
            self._clock.sleep_until(self._clock.now() + 0.25 * self._scan_s)

    def _take_rows(self, numbers: Sequence[float]) -> None:
        """Take the rows that are new; what the ring has lost is left out, the output's mean over it is exact."""
        newest = int(numbers[2])
        for number in range(max(self._count + 1, newest - _RING + 2), newest + 1):
            place = _HEAD + (number - 1) % _RING * _EACH
            held, y, u, area = numbers[place : place + _EACH]
            if held != number:  # written while it was read: it comes with the next reading
                break
            mean = (area - self._area) / ((number - self._count) * self._ticks)
            self._count, self._area = number, area
            t_s = self._began_s + number * self._row_s
            self._rows.append(Row(reading=Reading(t_s=t_s, y=y, u_applied=u, latency_s=math.nan), u_mean=mean))

    def _reason_of_end(self, numbers: Sequence[float]) -> ExperimentStopped | LinkError:
        """Return why the relay does not run any more."""
        (low, high), y = self._range, numbers[3]
        self._law = 0.0
        if not low <= y <= high:
            return ExperimentStopped(
                f"limit reached: the device ended its relay at y = {y:.4g}, outside {low:.4g}..{high:.4g}",
                where=self._link.where,
                remedy="look for a load on the rig, or widen limits.swing or y_min..y_max if the rig stands it",
            )
        if self._clock.now() >= self._until_s - self.tick_s:
            return ExperimentStopped(
                "time over: the device ended its relay", where=self._link.where, remedy="raise limits.time_s"
            )
        self._is_commanding = False
        return LinkError(
            "the device took the actuator back",
            where=self._link.where,
            remedy="its dead-man ran out, somebody disabled it, or y passed a limit of its own: look why",
        )
