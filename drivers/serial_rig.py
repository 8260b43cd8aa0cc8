"""A rig behind a microcontroller: samples, commands, dead-man, the gains of the device's own PI.

A device that restarted, whose clock jumped, or that no longer lets the host command, says so in its next sample: that
is an error and no sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from autotune.config.rig import SerialSettings
from autotune.controller import PIDController
from autotune.errors import InputError, LinkError, NotTaken
from autotune.experiment.rig import Clock, Former, Reading
from drivers.clock import MonotonicClock
from drivers.line_protocol import PAYLOAD, Command, Frame, Kind
from drivers.serial_line import NOT_IN_COMMAND, UNKNOWN_REQUEST, DeviceRefused, Port, SerialLink, open_port

COMMAND, _DEADMAN, _LIMIT, _TIME, _OVERRUN = 0x03, 0x04, 0x08, 0x10, 0x20
_GAINS = PAYLOAD[Kind.SET_GAINS]
_WRAP_S = 2**32 * 1e-6
#: part of the dead-man time after which it is fed
_FEED = 0.25
#: how far the device's clock may be from the host's: a ceramic resonator and its temperature, and a tick or two [s]
_CLOCK_ERROR, _CLOCK_SLACK_S = 0.02, 0.003


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
            remedy="narrow the limits, or give the span that the converter really has",
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
    clock : Clock, optional
        Of the host; the monotonic one where absent.
    port : callable
        Opens the line.

    Notes
    -----
    Commands are rounded to the output's counts. A reading's time stamp is the middle between request and answer, its
    device time that of the device's tick, exactly.
    """

    def __init__(
        self,
        settings: SerialSettings,
        *,
        u_range: tuple[float, float],
        u_safe: float,
        clock: Clock | None = None,
        port: Callable[[SerialSettings], Port] = open_port,
    ) -> None:
        self._settings = settings
        self._clock = clock if clock is not None else MonotonicClock()
        self._link = SerialLink(settings, self._clock, port)
        self._u_range = u_range
        self._u_safe = u_safe
        # the counts at full scale are the device's to say; until then, whether the range fits
        self._y = _Scale(low=settings.y_span[0], high=settings.y_span[1], full=1)
        self._u = _Scale(low=settings.u_span[0], high=settings.u_span[1], full=1)
        if self._y.unit == 0.0 or self._u.unit == 0.0:
            raise InputError("the span is empty", where="rig.y_span, rig.u_span", remedy="give two different values")
        for u in (*u_range, u_safe):
            if not min(settings.u_span) <= u <= max(settings.u_span):
                raise self._u.refusal(u, "u")
        self._tick_s = 1e-3
        self._starts = -1
        self._device_time_s = 0.0
        self._received_s, self._latency_s = 0.0, 0.0  # of the sample whose device time that is, on the host's clock
        self._former: Former | None = None
        self._former_law: tuple[float, ...] = ()  # what LAW said of it
        self._is_open = False
        self._is_commanding = False

    @property
    def clock(self) -> Clock:
        """The host's clock."""
        return self._clock

    @property
    def tick_s(self) -> float:
        """Period of the device's own loop [s]; known once the rig has been opened."""
        return self._tick_s

    @property
    def former(self) -> Former | None:
        """Whether the device's own PI ran before the host took command, and at which set-point."""
        return self._former

    def open(self) -> None:
        """Connect and take command; the output stays until the first command.

        Raises
        ------
        NotTaken
            Nobody answers; nothing was written.
        LinkError
            The device does not let the host command.
        """
        try:
            self._connect()
            self._starts = -1
            frame, *_ = self._link.ask(Kind.READ)
            self._former = self._running() if self._state(frame) & COMMAND == Command.REGULATOR else None
        except LinkError as error:
            raise NotTaken(error.what, where=error.where, remedy=error.remedy) from None
        self._is_open = True
        self._take()

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
        """Command the actuator [u unit] and return the sample at which that begins to act, in one request.

        Raises
        ------
        InputError
            Outside the span of the output.
        LinkError
            The device did not acknowledge it, restarted or took the actuator back.
        """
        self._require(self._is_commanding, "the host is not in command", "open the rig again")
        return self._exchange(Kind.EXCHANGE, self._u.count(u, "u"))

    def feed(self) -> None:
        """Feed the device's dead-man where that is due; nothing where the host does not command."""
        if self._is_commanding and self._clock.now() - self._received_s > _FEED * self._settings.deadman_s:
            self._exchange(Kind.READ)

    def hand_back(self) -> None:
        """Give the actuator back to the device's own PI, at the set-point and within the limits it had, bumplessly.

        Raises
        ------
        LinkError
            The device could not be reached, or how its PI ran is not known: its firmware does not say it (before
            version 3), or it ran for another host.
        """
        self._require(bool(self._former_law), "how its own controller ran is not known", "start it at the rig")
        setpoint, ticks_per_row, _, y_low, y_high, *output = self._former_law
        self._link.ask(Kind.TAKE, *output, round(1e3 * self._settings.deadman_s))
        frame, *_ = self._link.ask(Kind.REGULATE, setpoint, ticks_per_row, 0, y_low, y_high)
        self._is_commanding = False
        runs = self._state(frame) & COMMAND == Command.REGULATOR
        self._require(runs, "the device's controller does not run", "start it at the rig")

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
        self._require_pi(controller)
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
                state, remedy = "the device may hold old or new gains", "stop it and check its gains before it runs"
            else:
                state, remedy = "the device holds its old gains again", error.remedy
            raise LinkError(
                f"the gains were not taken ({error.what}); {state}", where=self._link.where, remedy=remedy
            ) from None

    def start_controller(self, setpoint: float) -> None:
        """Give the actuator to the device's own PI, at a set-point [y unit], until the rig is made safe."""
        self._connect()
        y_low, y_high = 0, 0xFFFF
        self._link.ask(Kind.REGULATE, (setpoint - self._y.low) / self._y.unit, 0, 0, y_low, y_high)
        self._is_commanding = False

    def _take(self) -> None:
        """Take command; the output stays until the first command."""
        counts = [self._u.count(u, "u") for u in (self._u_safe, *self._u_range)]
        deadman_ms = round(1e3 * self._settings.deadman_s)
        frame, sent_s, _ = self._link.ask(Kind.TAKE, counts[0], *sorted(counts[1:]), deadman_ms)
        self._starts = int(frame.values[4])
        self._device_time_s = 1e-6 * frame.values[0]
        self._received_s = self._clock.now()
        self._latency_s = self._received_s - sent_s
        self._is_commanding = True

    def _running(self) -> Former:
        """Return how the device's PI runs; of its set-point what the device says."""
        self._former_law = ()
        try:
            law = self._link.ask(Kind.GET_LAW)[0].values
        except DeviceRefused as refusal:
            if refusal.reason not in (UNKNOWN_REQUEST, NOT_IN_COMMAND):
                raise
            return Former()
        if law[2] == 0:  # one that ends by itself belongs to another host's session
            self._former_law = law
        return Former(setpoint=self._y.value(law[0]))

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
        except DeviceRefused as refusal:
            self._is_commanding = False
            if refusal.reason != NOT_IN_COMMAND:
                raise
            frame, *_ = self._link.ask(Kind.READ)  # which says why
            raise self._reason_of_end(self._state(frame)) from None
        end_s = self._clock.now()
        state = self._state(frame)
        if self._is_commanding and state & COMMAND != Command.HOST:
            self._is_commanding = False
            raise self._reason_of_end(state)
        device_time_s = self._steady(frame.values[0], end_s, end_s - sent_s)
        reading = self._reading(frame, device_time_s, end_s, end_s - sent_s)
        return replace(reading, latency_s=end_s - start_s, suspect=suspect)

    def _reading(self, frame: Frame, device_time_s: float, received_s: float, latency_s: float) -> Reading:
        _, y, u, *_ = frame.values
        return Reading(
            t_s=received_s - 0.5 * latency_s,
            y=self._y.value(y),
            u_applied=self._u.value(u),
            device_time_s=device_time_s,
            latency_s=latency_s,
        )

    def _state(self, frame: Frame) -> int:
        """Return a sample's state, once it is known that the device is the one that was opened."""
        if self._starts >= 0 and frame.values[4] != self._starts:
            self._is_commanding = False
            raise LinkError("the device restarted", where=self._link.where, remedy="check its power, then start again")
        return int(frame.values[3])

    def _reason_of_end(self, state: int) -> LinkError:
        why = "the device took the actuator back"
        remedy = "somebody else commands it: look who, then start again"
        if state & _DEADMAN:
            remedy = "its dead-man ran out: unload the computer or raise rig.deadman_s"
        elif state & _LIMIT:
            why, remedy = "y passed its limit on the device", "look for a load on the rig, or widen limits.y_min..y_max"
        elif state & _TIME:
            why, remedy = "the device's law ended by itself: its time is over", "raise limits.time_s"
        elif state & _OVERRUN:
            why, remedy = "the relay decided too often for its delay", "raise smoothing or hysteresis"
        return LinkError(why, where=self._link.where, remedy=remedy)

    def _steady(self, stamp_us: float, received_s: float, latency_s: float) -> float:
        """Return the device time [s] of a sample, once it is known to have gone on with the host's."""
        before_s = self._device_time_s
        passed_s, host_s = self._unwrap_stamp(stamp_us) - before_s, received_s - self._received_s
        slack_s = self._latency_s + latency_s + _CLOCK_ERROR * host_s + _CLOCK_SLACK_S
        if abs(passed_s - host_s) > slack_s:
            raise LinkError(
                f"the device's clock went {passed_s:.4g} s while {host_s:.4g} s passed",
                where=self._link.where,
                remedy="check the device's power and oscillator; its time stamps are not to be relied on",
            )
        self._received_s, self._latency_s = received_s, latency_s
        return self._device_time_s

    def _unwrap_stamp(self, stamp_us: float) -> float:
        """Return the device time [s] whose low 32 bits of microseconds are given."""
        turns = round((self._device_time_s - 1e-6 * stamp_us) / _WRAP_S)
        self._device_time_s = 1e-6 * stamp_us + turns * _WRAP_S
        return self._device_time_s

    def _controller(self, frame: Frame) -> PIDController:
        K, Ti_s = frame.values
        return PIDController(K=K * self._u.unit / self._y.unit, Ti_s=Ti_s)

    def _require_pi(self, controller: PIDController) -> None:
        if controller.kind != "pi" or controller.setpoint_weight != 1.0:
            raise InputError(
                "the device holds a PI without set-point weight", where=self._link.where, remedy="design with --kind pi"
            )

    def _set_gains(self, K: float, Ti_s: float) -> None:
        held = self._link.ask(Kind.SET_GAINS, K, Ti_s)[0].values
        wanted = _GAINS.unpack(_GAINS.pack(K, Ti_s))
        if held != wanted:
            raise LinkError(f"read back {held} where {wanted} was written", where=self._link.where)

    def _require(self, holds: bool, what: str, remedy: str) -> None:
        if not holds:
            raise LinkError(what, where=self._link.where, remedy=remedy)
