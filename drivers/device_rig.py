"""A microcontroller that runs relay and PI by itself, a thousand times a second, and streams what they did."""

from __future__ import annotations

import math
from dataclasses import replace

from autotune.config.rig import SerialSettings
from autotune.controller import PIDController
from autotune.errors import InputError, LinkError
from autotune.experiment.relay import RelaySettings
from autotune.experiment.rig import Reading, Row
from drivers.kinds import Reach, Session
from drivers.line_protocol import Command, Frame, Kind
from drivers.probe import probe_line
from drivers.serial_rig import COMMAND, SerialLineRig

_LONGEST_TICKS = 2**32 - 1
_AREA_WRAP = 2**32
#: part of the dead-man time after which it is fed while rows come
_FEED = 0.25


class DeviceLawRig(SerialLineRig):
    """A :class:`~drivers.serial_rig.SerialLineRig` whose device runs the laws; see there for the parameters.

    Notes
    -----
    A row that was lost on the line shows as a gap of the device's count; the output's mean over the gap is exact, since
    the device sums it up. The first command of the host takes the actuator back.
    """

    #: readings in the longest average that the device's relay can look at
    smoothing_max = 32

    _law = Command.NOBODY
    _count, _ticks_per_row = 0, 1
    _area = _row_s = _row_at_s = _fed_s = 0.0

    def start_relay(
        self, settings: RelaySettings, *, row_s: float, time_s: float, y_range: tuple[float, float]
    ) -> Reading:
        """Have the device run the relay from its next tick on, or change the setting of one that runs.

        Parameters
        ----------
        settings : RelaySettings
            Delay in ticks of the device, see :attr:`tick_s`.
        row_s : float
            Time from row to row [s], a multiple of a tick.
        time_s : float
            Time after which the device ends it at the safe output [s].
        y_range : (float, float)
            Limits on y; the device goes safe where y passes them [y unit].

        Returns
        -------
        Reading
            The sample after which the relay begins; of unknown y where the request had to be repeated.

        Raises
        ------
        InputError
            ``row_s`` is no multiple of a tick.
        LinkError
            The device does not answer or refuses the setting.
        """
        y, u = self._y, self._u
        inverted = y.unit * u.unit < 0
        law = (
            (settings.y_centre - y.low) / y.unit,
            (settings.midpoint - u.low) / u.unit,
            settings.amplitude / abs(u.unit),
            settings.hysteresis / abs(y.unit),
            settings.delay_samples,
            settings.smoothing,
            -settings.plant_sign if inverted else settings.plant_sign,
        )
        return self._start(Command.RELAY, Kind.RELAY, law, row_s, time_s, y_range)

    def start_trial(
        self,
        controller: PIDController,
        *,
        setpoint: float,
        load: float,
        row_s: float,
        time_s: float,
        y_range: tuple[float, float],
    ) -> Reading:
        """Have the device run its PI on gains that it does not keep, or change what is asked of the one that runs.

        Parameters
        ----------
        controller : PIDController
            A PI without set-point weight.
        setpoint, load : float
            Set-point [y unit] and what is added to the PI's output [u unit].
        row_s, time_s, y_range
            As :meth:`start_relay`.
        """
        self._require_pi(controller)
        law = (
            controller.K * self._y.unit / self._u.unit,
            controller.Ti_s,
            (setpoint - self._y.low) / self._y.unit,
            load / self._u.unit,
        )
        return self._start(Command.REGULATOR, Kind.TRY, law, row_s, time_s, y_range)

    def row(self) -> Row:
        """Wait for the next row of the law that runs, and feed the dead-man meanwhile.

        Raises
        ------
        LinkError
            The law ended (a limit, its time, the dead-man), the device restarted, or no row came.
        """
        patience_s = max(self._settings.timeout_s, 4 * self._row_s)
        start_s = self._clock.now()
        while True:
            now_s = self._clock.now()
            if now_s - self._fed_s >= _FEED * self._settings.deadman_s:
                self._link.send(Kind.READ)
                self._fed_s = now_s
            frame = self._link.next_frame(min(_FEED * self._settings.deadman_s, patience_s))
            if frame is None or frame.kind not in (Kind.ROW, Kind.SAMPLE):
                self._require(self._clock.now() - start_s < patience_s, "no row came", "check cable and power")
                continue
            state = self._state(frame)
            if state & COMMAND != self._law:
                self._law = Command.NOBODY
                raise self._reason_of_end(state)
            if frame.kind == Kind.ROW:
                return self._row(frame)

    def exchange(self, u: float) -> Reading:
        """Take the actuator back where the device runs a law, command it, and return the sample at which that acts."""
        if self._law != Command.NOBODY:
            self._take()
            self._law = Command.NOBODY
        return super().exchange(u)

    def make_safe(self) -> None:
        """Have the device set the safe output and give the actuator back; see the base class."""
        self._law = Command.NOBODY
        super().make_safe()

    def _start(
        self,
        law: Command,
        kind: Kind,
        settings: tuple[float, ...],
        row_s: float,
        time_s: float,
        y_range: tuple[float, float],
    ) -> Reading:
        runs = self._law == law
        self._require(runs or self._is_commanding, "the host is not in command", "open the rig again")
        ticks = round(row_s / self._tick_s)
        if ticks < 1 or abs(ticks * self._tick_s - row_s) > 1e-6 * row_s:
            raise InputError(
                f"rows every {row_s:g} s are no multiple of the device's tick of {self._tick_s:g} s",
                where="signals.sample_time_s",
                remedy="give a multiple of it",
            )
        if not runs:
            self._link.forget()
        # beyond the converter's span no limit can be passed
        span = sorted((self._y.low, self._y.high))
        limits = sorted(self._y.count(min(max(limit, span[0]), span[1]), "y") for limit in y_range)
        longest = min(round(time_s / self._tick_s), _LONGEST_TICKS)
        frame, sent_s, repeated = self._link.ask(kind, *settings, ticks, longest, *limits)
        self._is_commanding = False
        received_s = self._fed_s = self._received_s = self._clock.now()
        self._latency_s = received_s - sent_s
        reading = self._reading(frame, self._unwrap_stamp(frame.values[0]), received_s, received_s - sent_s)
        if not runs:
            self._law, self._ticks_per_row, self._row_s = law, ticks, row_s
            self._count, self._area = 0, 0.0
            if repeated:  # the law may run since the request whose answer was lost
                reading = self._begin_law()
            self._row_at_s = reading.device_time_s
        return reading

    def _begin_law(self) -> Reading:
        """Return when the law began, counted back from its first row; what y was then is not known."""
        patience_s = max(self._settings.timeout_s, 4 * self._row_s)
        until_s = self._clock.now() + patience_s
        first: Frame | None = None
        while first is None or first.kind != Kind.ROW:
            self._require(self._clock.now() < until_s, "no row came", "check cable and power")
            first = self._link.next_frame(patience_s)
        self._link.put_back(first)
        ticks = first.sequence * self._ticks_per_row
        reading = self._reading(
            first, self._unwrap_stamp(first.values[0]) - ticks * self._tick_s, self._received_s, 0.0
        )
        return replace(reading, y=math.nan, latency_s=math.nan, suspect=True)

    def _row(self, frame: Frame) -> Row:
        count, area = frame.sequence, frame.values[5]
        ticks = (count - self._count) % 0x10000 * self._ticks_per_row
        before_s, at_s = self._row_at_s, self._unwrap_stamp(frame.values[0])
        if ticks == 0 or abs(at_s - before_s - ticks * self._tick_s) > 0.5 * self._tick_s:
            raise LinkError(
                f"the device's clock went {at_s - before_s:.4g} s over {ticks} ticks",
                where=self._link.where,
                remedy="check the device's power and oscillator; its time stamps are not to be relied on",
            )
        mean = (area - self._area) % _AREA_WRAP / ticks
        self._count, self._area, self._row_at_s = count, area, at_s
        self._received_s, self._latency_s = self._clock.now(), self._row_s
        reading = replace(self._reading(frame, at_s, self._received_s, 0.0), latency_s=math.nan)
        return Row(reading=reading, u_mean=self._u.value(mean))


def open_kind(settings: SerialSettings, session: Session) -> SerialLineRig:
    """Return the rig that ``[rig] kind = "serial"`` describes, its laws run by the host or by the device.

    Parameters
    ----------
    settings : SerialSettings
        The table ``[rig]``.
    session : Session
        What it is opened for.
    """
    on_line = DeviceLawRig if settings.relay == "device" else SerialLineRig
    return on_line(settings, u_range=session.u_range, u_safe=session.u_safe)


def reach_of(settings: SerialSettings) -> Reach:
    """Return the serial device."""
    return Reach(device=settings.device)


probe_kind = probe_line
