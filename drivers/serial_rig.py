"""A rig behind a microcontroller: samples, commands, dead-man, the device's own relay and PI.

A device that restarted, or that no longer lets the host command, says so in its next sample: that is an error and no
sample.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

from autotune.config.rig import SerialSettings
from autotune.controller import PIDController
from autotune.errors import InputError, LinkError
from autotune.experiment.relay import RelaySettings
from autotune.experiment.rig import Clock, Reading
from drivers.clock import MonotonicClock
from drivers.line_protocol import PAYLOAD, Command, Frame, Kind
from drivers.serial_line import DeviceRefused, SerialLink

_COMMAND, _DEADMAN, _LIMIT, _TIME, _OVERRUN = 0x03, 0x04, 0x08, 0x10, 0x20
_GAINS = PAYLOAD[Kind.SET_GAINS]
_WRAP_S = 2**32 * 1e-6
_LONGEST_TICKS = 2**32 - 1


@dataclass(frozen=True, kw_only=True)
class DeviceRow:
    """One row that the device streams.

    Attributes
    ----------
    count : int
        The device's own count of rows, modulo 65536; a gap is a row that was lost on the line.
    device_time_s : float
        Device time of the measurement [s].
    y : float
        Measurement [y unit].
    u : float
        Output in effect when ``y`` was taken [u unit].
    """

    count: int
    device_time_s: float
    y: float
    u: float


@dataclass(frozen=True, kw_only=True)
class _Scale:
    """Engineering value of a count."""

    low: float
    high: float
    full: int

    @property
    def unit(self) -> float:
        return (self.high - self.low) / self.full

    def value(self, count: float) -> float:
        return self.low + count * self.unit

    def count(self, value: float, name: str) -> int:
        exact = (value - self.low) / self.unit
        if not -0.5 <= exact <= self.full + 0.5:  # also where it is not a number
            raise self.refusal(value, name)
        return min(max(round(exact), 0), self.full)

    def refusal(self, value: float, name: str) -> InputError:
        return InputError(
            f"{name} = {value:g} is outside {self.low:g}..{self.high:g}",
            where=f"rig.{name}_span",
            mend="narrow the limits, or give the span that the converter really has",
        )


class SerialLineRig:
    """A microcontroller, commanded by the host or running relay or PI by itself.

    Parameters
    ----------
    settings : SerialSettings
        Line and scales.
    u_range : (float, float)
        Lowest and highest command; the device lets none beyond through [u unit].
    u_safe : float
        Command that ``make_safe`` and the device's dead-man leave [u unit].

    Notes
    -----
    Commands are rounded to the output's counts. A sample's time stamp is the middle between request and answer; its
    measurement is that of the device's last tick, at most one tick older.
    """

    def __init__(self, settings: SerialSettings, *, u_range: tuple[float, float], u_safe: float) -> None:
        self._settings = settings
        self._link = SerialLink(settings)
        self._clock = MonotonicClock()
        self._u_range = u_range
        self._u_safe = u_safe
        # the counts at full scale are the device's to say; until then, whether the range fits
        self._y = _Scale(low=settings.y_span[0], high=settings.y_span[1], full=1)
        self._u = _Scale(low=settings.u_span[0], high=settings.u_span[1], full=1)
        if self._y.unit == 0.0 or self._u.unit == 0.0:
            raise InputError("the span is empty", where="rig.y_span, rig.u_span", mend="give two different values")
        for u in (*u_range, u_safe):
            if not min(settings.u_span) <= u <= max(settings.u_span):
                raise self._u.refusal(u, "u")
        self._tick_s = 1e-3
        self._starts = -1
        self._device_time_s = 0.0
        self._is_open = False
        self._is_commanding = False

    @property
    def clock(self) -> Clock:
        """The monotonic clock."""
        return self._clock

    @property
    def tick_s(self) -> float:
        """Period of the device's own loop [s]; known once the rig has been opened."""
        return self._tick_s

    def open(self) -> None:
        """Connect and take command; the output stays until the first command."""
        self._connect()
        self._is_open = True
        counts = [self._u.count(u, "u") for u in (self._u_safe, *self._u_range)]
        frame, *_ = self._link.ask(Kind.TAKE, counts[0], *sorted(counts[1:]), round(1e3 * self._settings.deadman_s))
        self._starts = int(frame.values[4])
        self._device_time_s = 1e-6 * frame.values[0]
        self._is_commanding = True

    def read(self) -> Reading:
        """Take one sample and feed the dead-man.

        Raises
        ------
        LinkError
            No answer, or the device restarted or took the actuator back.
        """
        self._require(self._is_open, "the rig is not open", "open it before the first sample")
        return self._exchange(Kind.READ)

    def write(self, u: float) -> None:
        """Command the actuator [u unit] and feed the dead-man; the answer is a sample too, see :meth:`exchange`."""
        self.exchange(u)

    def exchange(self, u: float) -> Reading:
        """Command the actuator [u unit] and return the sample of just before, in one request.

        Raises
        ------
        InputError
            Outside the span of the output.
        LinkError
            The device did not acknowledge it, restarted or took the actuator back.
        """
        self._require(self._is_commanding, "the host is not in command", "open the rig again")
        return self._exchange(Kind.EXCHANGE, self._u.count(u, "u"))

    def make_safe(self) -> None:
        """Have the device set the safe output and give the actuator back.

        Raises
        ------
        LinkError
            The device could not be reached, also over the line opened anew; its dead-man sets the safe output.
        """
        if not self._is_open:
            return
        self._is_commanding = False
        try:
            self._link.ask(Kind.SAFE)
        except LinkError:
            self._link.disconnect()
            self._connect()
            self._link.ask(Kind.SAFE)

    def close(self) -> None:
        """Close the line."""
        self._is_open = self._is_commanding = False
        self._link.disconnect()

    def read_gains(self) -> PIDController:
        """Return the gains the device's PI holds now."""
        self._connect()
        return self._controller(self._link.ask(Kind.GET_GAINS)[0])

    def write_gains(self, controller: PIDController) -> None:
        """Write gains and compare what the device then holds; where that fails the old ones are written again.

        Raises
        ------
        InputError
            The controller is no PI without set-point weight; nothing was written.
        LinkError
            What is read back differs, or the link broke; says what the device holds, as far as it is known.
        """
        if controller.kind != "pi" or controller.setpoint_weight != 1.0:
            raise InputError(
                "the device holds a PI without set-point weight", where=self._link.where, mend="design with --kind pi"
            )
        self._connect()
        old = self._link.ask(Kind.GET_GAINS)[0].values
        try:
            self._set_gains(controller.K * self._y.unit / self._u.unit, controller.Ti_s)
        except LinkError as error:
            try:
                self._link.disconnect()
                self._connect()
                self._set_gains(*old)
            except LinkError:
                state, mend = "the device may hold old or new gains", "stop it and check its gains before it runs"
            else:
                state, mend = "the device holds its old gains again", error.mend
            raise LinkError(
                f"the gains were not taken ({error.what}); {state}", where=self._link.where, mend=mend
            ) from None

    def start_controller(self, setpoint: float) -> None:
        """Give the actuator to the device's own PI, at a set-point [y unit], until the rig is made safe."""
        self._connect()
        y_low, y_high = 0, 0xFFFF
        self._link.ask(Kind.REGULATE, (setpoint - self._y.low) / self._y.unit, 0, 0, y_low, y_high)
        self._is_commanding = False

    def run_relay(
        self, settings: RelaySettings, *, time_s: float, y_range: tuple[float, float], ticks_per_row: int = 10
    ) -> Iterator[DeviceRow]:
        """Have the device run the relay by itself, and yield its rows until the time is over; then it is safe.

        Parameters
        ----------
        settings : RelaySettings
            Delay in ticks of the device, see :attr:`tick_s`.
        time_s : float
            Time after which the device ends it [s].
        y_range : (float, float)
            Limits on y; the device goes safe where y passes them [y unit].
        ticks_per_row : int
            Ticks from row to row.

        Raises
        ------
        LinkError
            A limit was passed, the device restarted, or no row came.
        """
        self._require(self._is_commanding, "the host is not in command", "open the rig again")
        y, u = self._y, self._u
        inverted = y.unit * u.unit < 0
        self._link.forget()
        frame, *_ = self._link.ask(
            Kind.RELAY,
            (settings.y_centre - y.low) / y.unit,
            (settings.midpoint - u.low) / u.unit,
            settings.amplitude / abs(u.unit),
            settings.hysteresis / abs(y.unit),
            settings.delay_samples,
            settings.smoothing,
            -settings.plant_sign if inverted else settings.plant_sign,
            ticks_per_row,
            min(round(time_s / self._tick_s), _LONGEST_TICKS),
            *sorted(y.count(limit, "y") for limit in y_range),
        )
        self._is_commanding = False
        self._unwrapped(frame.values[0])
        yield from self._rows(max(self._settings.timeout_s, 4 * ticks_per_row * self._tick_s))

    def _rows(self, patience_s: float) -> Iterator[DeviceRow]:
        feed_s = 0.25 * self._settings.deadman_s
        fed_s = last_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            if now_s - fed_s >= feed_s:
                self._link.send(Kind.READ)
                fed_s = now_s
            frame = self._link.arrived(min(feed_s, patience_s))
            if frame is None or frame.kind not in (Kind.ROW, Kind.SAMPLE):
                self._require(time.monotonic() - last_s < patience_s, "no row came", "check cable and power")
                continue
            state = self._state(frame)
            if state & _COMMAND != Command.RELAY:
                if state & _TIME:
                    return
                raise self._ended(state)
            if frame.kind == Kind.ROW:
                last_s = time.monotonic()
                stamp, y, u, *_ = frame.values
                yield DeviceRow(
                    count=frame.sequence, device_time_s=self._unwrapped(stamp), y=self._y.value(y), u=self._u.value(u)
                )

    def _connect(self) -> None:
        """Open the line where it is not; learn the device's counts."""
        if self._link.is_connected:
            return
        info = self._link.connect()
        _, ticks, y_full, u_full, _ = (int(value) for value in info.values)
        self._require(min(ticks, y_full, u_full) > 0, "the device says it has no counts", "flash its firmware again")
        self._tick_s = 1.0 / ticks
        low, high = self._settings.y_span
        self._y = _Scale(low=low, high=high, full=y_full)
        low, high = self._settings.u_span
        self._u = _Scale(low=low, high=high, full=u_full)

    def _exchange(self, kind: Kind, *values: float) -> Reading:
        start_s = self._clock.now()
        try:
            frame, sent_s, suspect = self._link.ask(kind, *values)
        except DeviceRefused:
            self._is_commanding = False
            raise
        end_s = self._clock.now()
        state = self._state(frame)
        if self._is_commanding and state & _COMMAND != Command.HOST:
            self._is_commanding = False
            raise self._ended(state)
        stamp, y, u, *_ = frame.values
        return Reading(
            t_s=end_s - 0.5 * (time.perf_counter() - sent_s),
            y=self._y.value(y),
            u_applied=self._u.value(u),
            device_time_s=self._unwrapped(stamp),
            latency_s=end_s - start_s,
            suspect=suspect,
        )

    def _state(self, frame: Frame) -> int:
        """Return a sample's state, once it is known that the device is the one that was opened."""
        if self._starts >= 0 and frame.values[4] != self._starts:
            self._is_commanding = False
            raise LinkError("the device restarted", where=self._link.where, mend="check its power, then start again")
        return int(frame.values[3])

    def _ended(self, state: int) -> LinkError:
        why = "the device took the actuator back"
        mend = "somebody else commands it: look who, then start again"
        if state & _DEADMAN:
            mend = "its dead-man ran out: unload the computer or raise rig.deadman_s"
        elif state & _LIMIT:
            why, mend = "y passed its limit on the device", "look for a load on the rig, or widen limits.y_min..y_max"
        elif state & _OVERRUN:
            why, mend = "the relay decided too often for its delay", "raise smoothing or hysteresis"
        return LinkError(why, where=self._link.where, mend=mend)

    def _unwrapped(self, stamp_us: float) -> float:
        """Return the device time [s] whose low 32 bits of microseconds are given."""
        turns = round((self._device_time_s - 1e-6 * stamp_us) / _WRAP_S)
        self._device_time_s = 1e-6 * stamp_us + turns * _WRAP_S
        return self._device_time_s

    def _controller(self, frame: Frame) -> PIDController:
        K, Ti_s = frame.values
        return PIDController(K=K * self._u.unit / self._y.unit, Ti_s=Ti_s)

    def _set_gains(self, K: float, Ti_s: float) -> None:
        held = self._link.ask(Kind.SET_GAINS, K, Ti_s)[0].values
        wanted = _GAINS.unpack(_GAINS.pack(K, Ti_s))
        if held != wanted:
            raise LinkError(f"read back {held} where {wanted} was written", where=self._link.where)

    def _require(self, holds: bool, what: str, mend: str) -> None:
        if not holds:
            raise LinkError(what, where=self._link.where, mend=mend)
