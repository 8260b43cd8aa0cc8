"""A rig behind a register map: samples, commands, dead-man, the device's own controller."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace

from autotune.config.registers import RegisterMap
from autotune.config.rig import PermissiveSettings
from autotune.errors import ExperimentStopped, LinkError, NotTaken
from autotune.experiment.rig import Clock, Former, Reading
from drivers.clock import MonotonicClock
from drivers.heartbeat import Heartbeat
from drivers.register_link import RegisterLink
from drivers.registers import Block, Codec, blocks, codecs

_SAMPLE = ("y", "u_applied", "device_time", "heartbeat_echo", "in_command")
#: cycle of the device's program where it is not known [s], and how many of them its status is late at most: three, the
#: part of one that has passed when the host writes, and the one for which it is shown
_SCAN_S, _SCANS_LATE = 0.02, 5
#: time that a device gets at least to say that the host commands [s]
_TAKE_S = 0.25
#: how long the safe output is written again where the device does not take it, and the first wait between [s]
_SAFE_S, _SAFE_WAIT_S = 2.0, 0.05
#: part of the time that looks whether the command is still ours may take
_LOOK_SHARE = 0.125
#: longest time of a reading on a line that has the time for such looks [s]
_QUICK_S = 0.005
#: so many foreign commands within this time end the session [s]
_FOREIGN, _FOREIGN_S = 2, 30.0
#: how long another master's heartbeat is looked for, in times between two of our own
_WATCH_FEEDS = 3


class RegisterRig:
    """A device on a register map, commanded by the host.

    Parameters
    ----------
    link : RegisterLink
        How the registers are reached.
    registers : RegisterMap
        Which register holds which signal.
    u_range : (float, float)
        Lowest and highest command that the experiment may send [u unit].
    u_safe : float
        Command that ``make_safe`` leaves [u unit].
    feed_s : float
        Longest time between two heartbeats while the host commands [s].
    scan_time_s : float, optional
        Cycle of the device's program [s]; 20 ms where it is not known.
    permissives : sequence of PermissiveSettings
        Conditions that are read with every sample, and without which the rig is not moved.
    clock : Clock, optional
        Time as the device lives it; the monotonic clock where absent.

    Raises
    ------
    InputError
        The register of the command cannot hold the whole range of commands; or a limit lies between its counts and no
        count within the range is near it.

    Notes
    -----
    A device whose program runs in cycles shows the state of an earlier one: who commands and the echo of the heartbeat
    are up to three cycles late, and that is waited for and tolerated.

    A sample's time stamp is the middle between the request that was answered and its answer. The wait of one request is
    bounded by the link's time-outs and retries.
    """

    def __init__(
        self,
        link: RegisterLink,
        registers: RegisterMap,
        *,
        u_range: tuple[float, float],
        u_safe: float,
        feed_s: float = 0.1,
        scan_time_s: float | None = None,
        permissives: Sequence[PermissiveSettings] = (),
        clock: Clock | None = None,
    ) -> None:
        self._link = link
        self._codecs = codecs(registers.mapped())
        self._permissives = {f"permissive {one.name!r}": one for one in permissives}
        conditions = codecs(self._permissives)
        self._clock: Clock = clock if clock is not None else MonotonicClock()
        self._u_range = u_range
        self._u_safe = u_safe
        self._feed_s = feed_s
        for u in (*u_range, u_safe):
            self._codecs["u"].encode_within(u, *u_range)
        sample = [self._codecs[name] for name in _SAMPLE if name in self._codecs]
        self._sample_blocks = blocks([*sample, *conditions.values()])
        self._command_blocks = blocks([self._codecs[name] for name in ("u", "heartbeat") if name in self._codecs])
        first = [self._codecs[name] for name in ("u", "heartbeat", "safe") if name in self._codecs]
        self._first_blocks = blocks(first)
        self._checks_echo = "heartbeat_echo" in self._codecs
        self._scan_s = scan_time_s if scan_time_s is not None else _SCAN_S
        self._late_s = _SCANS_LATE * self._scan_s
        beats = int(self._codecs["heartbeat"].span[1]) + 1 if "heartbeat" in self._codecs else 1
        self._heart = Heartbeat(beats, late_s=self._late_s)
        self._u = u_safe
        self._former: Former | None = None
        self._is_open = False
        self._is_taken = False  # whether anything was written in this session
        self._is_commanding = False
        self._opened_s = 0.0
        self._trial_setpoint = math.nan  # of the device's own controller, as a trial began
        self._looks_s = math.inf  # when another master is looked for next; never where it cannot be
        self._foreign: deque[tuple[float, float]] = deque(maxlen=_FOREIGN)  # when it was not, and what was there
        self._released_s = math.nan  # when this session gave the actuator to the device's own controller

    @property
    def clock(self) -> Clock:
        """The monotonic clock."""
        return self._clock

    @property
    def shows_output(self) -> bool:
        """Whether the device says which output it applies."""
        return "u_applied" in self._codecs

    @property
    def former(self) -> Former | None:
        """Mode and set-point that the device's own controller had before the host took command, where it ran."""
        return self._former

    def open(self) -> None:
        """Connect, look before anything is written, and take command.

        Without a bump where the device says what it applies, else at the safe output.

        Raises
        ------
        NotTaken
            Nobody answers, another master commands, or a permissive is missing; nothing was written.
        LinkError
            The device does not let the host command.
        """
        try:
            self._link.connect()
            self._is_open = True
            self._heart.begin()
            reading, values = self._sample()
            self._check_permissives(values)
            held = self._read(("enable", "automatic", "trial"))
            self._refuse_other_master(held | values)
            on_trial = held.get("trial") == 1.0  # a session that was killed left it: nobody's controller to go back to
            runs = held.get("automatic") == 1.0 and not on_trial
            setpoint = self._read(("setpoint",)).get("setpoint", math.nan) if runs else math.nan
        except LinkError as error:
            self.close()
            raise NotTaken(error.what, where=error.where, remedy=error.remedy) from None
        self._former = Former(setpoint=setpoint) if runs else None
        self._opened_s, self._looks_s, self._trial_setpoint = self._clock.now(), math.inf, math.nan
        self._foreign.clear()
        self._is_taken = True
        left = [name for name in ("enable", "trial") if held.get(name, 0.0) != 0.0]
        if left:  # by a session that was killed; a device's trip clears on its edge
            for name in (["automatic"] if on_trial else []) + left:
                self._put(name, 0.0)
            self._clock.sleep_until(self._clock.now() + 2.0 * self._scan_s)
            reading, _ = self._sample()
        self._take(reading.u_applied, was_automatic=runs)
        # a device that holds another value than it was sent, or another's, has its command looked at no more
        self._looks_s = self._clock.now() if self._read_back("u") == self._command_held else math.inf

    def read(self) -> Reading:
        """Take one sample; feeds the dead-man when that is due.

        Raises
        ------
        LinkError
            No answer, or one that does not carry a recent heartbeat, also after the link was flushed; or the device
            says that it no longer lets the host command.
        ExperimentStopped
            A permissive is lost.
        """
        self._require(self._is_open, "the rig is not open", "open it before the first sample")
        self.feed()
        reading, values = self._sample()
        self._check_permissives(values)
        self._check_released(values)
        reading = self._look_for_master(reading)
        if self._is_commanding and values.get("in_command") == 0.0:
            self._is_commanding = False
            raise LinkError(
                "the device took the actuator back",
                where=self._link.where,
                remedy="its dead-man ran out or somebody disabled it: look why, then start again",
            )
        return reading

    def write(self, u: float) -> None:
        """Command the actuator [u unit] and feed the dead-man.

        Raises
        ------
        InputError
            The register cannot hold the value, or it is out of range.
        LinkError
            The device did not acknowledge it, or after a retry holds another value.
        """
        self._require(self._is_commanding, "the host is not in command", "open the rig again")
        self._u = u
        self._command()

    def feed(self) -> None:
        """Feed the device's dead-man where that is due, also while its own controller is watched on trial."""
        if (self._is_commanding or self._is_released) and self._clock.now() - self._heart.fed_s > self._feed_s:
            self._feed()

    def make_safe(self) -> None:
        """Command the safe output, stop the device's own controller and give the actuator back.

        Nothing where this session has taken nothing: the rig is somebody else's then. A device that does not take it
        is asked again for two seconds, over new connections.

        Raises
        ------
        LinkError
            The device could not be reached in that time; its dead-man sets the safe output.
        """
        if not self._is_taken:
            return
        until_s, wait_s = self._clock.now() + _SAFE_S, _SAFE_WAIT_S
        while True:
            try:
                self._go_safe()
            except LinkError:
                if self._clock.now() + wait_s > until_s:
                    raise
            else:
                return
            self._clock.sleep_until(self._clock.now() + wait_s)
            wait_s *= 2.0
            self._link.disconnect()
            with contextlib.suppress(LinkError):  # what follows says it
                self._link.connect()

    def hand_back(self) -> None:
        """Give the actuator back to the device's own controller, in the mode and at the set-point it had, bumplessly.

        Raises
        ------
        LinkError
            The device could not be reached, or does not hold what was written; it is not known who commands.
        """
        former = self._former
        self._require(
            (self._is_commanding or self._is_released) and former is not None, "no controller had the actuator", ""
        )
        self._release(former.setpoint if former is not None else math.nan, on_trial=False)
        self._await_command(0.0)
        self._is_commanding, self._released_s = False, math.nan
        held = self._read(("automatic",))
        self._require(held["automatic"] == 1.0, "the device's controller is not in automatic", "set it at the rig")

    def close(self) -> None:
        """Disconnect."""
        self._is_open = self._is_commanding = self._is_taken = False
        self._released_s = math.nan
        self._link.disconnect()

    @property
    def _is_released(self) -> bool:
        """Whether this session gave the actuator to the device's own controller and watches it."""
        return math.isfinite(self._released_s)

    @property
    def _takes_over(self) -> bool:
        """Whether that controller was given the actuator so lately that its program may not know it yet."""
        return self._clock.now() - self._released_s < max(_TAKE_S, self._late_s)

    def _take(self, applied: float, *, was_automatic: bool) -> None:
        """Take command at the output that the device applies, at the safe output where it does not say."""
        low, high = self._u_range
        self._u = applied if low <= applied <= high else self._u_safe  # NaN compares false
        self._is_commanding = True
        self._write(self._first_blocks)
        if "enable" in self._codecs:
            self._put("enable", 1.0)
        elif was_automatic:
            self._put("automatic", 0.0)
        self._await_command(1.0)

    def _release(self, setpoint: float, *, on_trial: bool) -> None:
        """Let the device's own controller have the actuator, without a load; NaN leaves its set-point."""
        if "load" in self._codecs:
            self._put("load", 0.0)
        if math.isfinite(setpoint):
            self._put("setpoint", setpoint)
        if "trial" in self._codecs:
            self._put("trial", float(on_trial))
        self._put("automatic", 1.0)
        if "enable" in self._codecs:
            self._put("enable", 0.0)

    def _check_released(self, values: Mapping[str, float]) -> None:
        """Refuse a device that is some program cycles later still not run by its own controller."""
        if not self._is_released or self._takes_over:
            return
        self._require(
            values.get("in_command", 0.0) == 0.0,
            "the device's own controller does not take the actuator",
            "look at the device's mode switch; enable at 0 and automatic at 1 were written",
        )

    def _go_safe(self) -> None:
        self._is_commanding, self._released_s = False, math.nan
        self._u = self._u_safe
        self._write(self._first_blocks)  # a device that restarted has forgotten its safe output
        for name in ("automatic", "enable", "load", "trial"):
            if name in self._codecs:
                self._put(name, 0.0)
        if math.isfinite(self._trial_setpoint):  # whoever puts it in automatic next finds the operating point
            self._put("setpoint", self._trial_setpoint)
        self._await_echo()

    def _await_echo(self) -> None:
        """Wait until the device's program has seen the last write, where it echoes the heartbeat."""
        start_s = self._clock.now()
        while self._checks_echo and self._ask()[1]["heartbeat_echo"] != self._heart.value:
            waited_s = self._clock.now() - start_s
            self._require(
                waited_s < max(_TAKE_S, self._late_s),
                f"the device does not echo the heartbeat of the safe output after {waited_s:.2g} s",
                "look whether its program runs",
            )
            self._clock.sleep_until(self._clock.now() + 0.25 * self._scan_s)

    def _refuse_other_master(self, shown: Mapping[str, float]) -> None:
        """Watch for a moving heartbeat where the device says, or may not say, that somebody commands it."""
        told = [shown[name] for name in ("enable", "in_command", "trial") if name in shown]
        if "heartbeat" not in self._codecs or (told and not any(told)):
            return
        start_s = self._clock.now()
        patience_s = max(_WATCH_FEEDS * self._feed_s, self._late_s)
        before = self._read(("heartbeat",))["heartbeat"]
        while self._clock.now() - start_s < patience_s:
            self._clock.sleep_until(self._clock.now() + self._scan_s)
            beat = self._read(("heartbeat",))["heartbeat"]
            self._require(
                beat == before,
                f"another master commands the rig: its heartbeat went from {before:g} to {beat:g}",
                "end the other session; only one master may command",
            )

    @property
    def _command_held(self) -> float:
        """The command as its register holds it."""
        return self._codecs["u"].decode(self._codecs["u"].encode_within(self._u, *self._u_range))

    def _read_back(self, name: str) -> float:
        """Return what a register holds now; NaN where a device refuses to say it."""
        try:
            return self._read((name,))[name]
        except LinkError:
            return math.nan

    def _may_look(self, reading: Reading, *, on_slow_line: bool = False) -> bool:
        """Return whether it is time to look for another master, on a line that has the time."""
        has_time = on_slow_line or reading.latency_s <= _QUICK_S
        return has_time and self._clock.now() >= self._looks_s and not reading.suspect

    def _has_looked(self, start_s: float) -> None:
        """Have the next look wait as its share of the time wants it; this one began at ``start_s`` [s]."""
        now_s = self._clock.now()
        self._looks_s = now_s + (now_s - start_s) / _LOOK_SHARE

    def _look_for_master(self, reading: Reading) -> Reading:
        """Look now and then whether the command is still ours, and mark a sample before which it was not.

        Raises
        ------
        LinkError
            It was another's several times within a short while.
        """
        if not self._is_commanding or not self._may_look(reading):
            return reading
        now_s = self._clock.now()
        held, own = self._read_back("u"), self._command_held
        self._has_looked(now_s)
        if held == own or math.isnan(held):
            return reading
        self._foreign.append((now_s, held))
        told = ", ".join(f"{value:g} at {t_s - self._opened_s:.3g} s" for t_s, value in self._foreign)
        self._require(
            len(self._foreign) < _FOREIGN or now_s - self._foreign[0][0] > _FOREIGN_S,
            f"another master writes the command: its register held {told} of this session, {own:g} was written last",
            "end the other session; only one master may command",
        )
        return replace(reading, suspect=True, foreign_u=held)

    def _check_permissives(self, values: Mapping[str, float]) -> None:
        for name, condition in self._permissives.items():
            if not condition.holds(values[name]):
                raise (ExperimentStopped if self._is_taken else NotTaken)(
                    f"{name} is {'lost' if self._is_taken else 'missing'}: it reads {values[name]:g}",
                    where=self._link.where,
                    remedy="look at the rig why, and start again when it is there",
                )

    def _await_command(self, wanted: float) -> None:
        """Wait until the device says who commands, and echoes this session: its status is some program cycles late."""
        start_s = self._clock.now()
        while True:
            asked_s = self._clock.now()
            values = self._ask()[1]
            echoes = not self._checks_echo or self._heart.is_own(values["heartbeat_echo"], asked_s)
            if echoes and values.get("in_command", wanted) == wanted:
                return
            waited_s = self._clock.now() - start_s
            self._require(
                waited_s < max(_TAKE_S, self._late_s),
                f"in_command is not {wanted:g} after {waited_s:.2g} s"
                if echoes
                else f"the device does not echo the heartbeat after {waited_s:.2g} s",
                "look at the device's mode switch and trips, and whether its program runs; give rig.scan_time_s",
            )
            self.feed()
            self._clock.sleep_until(self._clock.now() + 0.25 * self._scan_s)

    def _read(self, names: Sequence[str]) -> dict[str, float]:
        """Return the values of those of the signals that are mapped."""
        values: dict[str, float] = {}
        for block in blocks([self._codecs[name] for name in names if name in self._codecs]):
            values |= block.decode(self._link.read(block).words)
        return values

    def _sample(self) -> tuple[Reading, dict[str, float]]:
        """Return a sample that carries a recent heartbeat, asking again over a flushed line while it does not."""
        start_s = asked_s = self._clock.now()
        reading, values = self._ask()
        while self._checks_echo and not self._heart.allows(values["heartbeat_echo"], asked_s):
            self._require(
                asked_s - start_s <= self._late_s,
                f"the device echoes heartbeat {values['heartbeat_echo']:g}, not {self._heart.value}",
                "it restarted, another master writes to it, or heartbeat_echo is mapped wrongly;"
                " of a slow program give rig.scan_time_s",
            )
            self._link.distrust()
            self._clock.sleep_until(asked_s + 0.5 * self._scan_s)
            asked_s = self._clock.now()
            reading, values = self._ask()
        return reading, values

    def _ask(self) -> tuple[Reading, dict[str, float]]:
        start_s = middle_s = self._clock.now()
        values: dict[str, float] = {}
        suspect = False
        for block in self._sample_blocks:
            answer = self._link.read(block)
            if not values:  # the first block is the one with y
                middle_s = self._clock.now() - 0.5 * answer.took_s
            values |= block.decode(answer.words)
            suspect |= answer.suspect
        reading = Reading(
            t_s=middle_s,
            y=values["y"],
            u_applied=values.get("u_applied", math.nan),
            device_time_s=values.get("device_time", math.nan),
            latency_s=self._clock.now() - start_s,
            suspect=suspect,
        )
        return reading, values

    def _command(self) -> None:
        """Write command and heartbeat; the heartbeat only once the command is in."""
        self._write(self._command_blocks)

    def _write(self, parts: Sequence[Block]) -> None:
        values = {"u": self._u, "heartbeat": float(self._heart.next), "safe": self._u_safe}
        for block in parts:
            words = [word for codec, _ in block.parts for word in self._words(codec, values[codec.name])]
            suspect = self._link.write(block.table, block.address, words)
            if suspect and list(self._link.read(block).words) != words:
                raise LinkError(
                    "a command was sent twice and the device holds another one",
                    where=self._link.where,
                    remedy="let only one master write to the device, or raise timeout_s",
                )
        self._heart.written(self._clock.now())

    def _feed(self) -> None:
        if "heartbeat" not in self._codecs:
            return
        self._put("heartbeat", float(self._heart.next))
        self._heart.written(self._clock.now())

    def _put(self, name: str, value: float) -> None:
        codec = self._codecs[name]
        self._link.write(codec.register.table, codec.register.address, self._words(codec, value))

    def _words(self, codec: Codec, value: float) -> Sequence[int]:
        """Return what is written of a signal: outputs within their range to the last count, a bit within its word."""
        if codec.name in ("u", "safe"):
            return codec.encode_within(value, *self._u_range)
        if codec.register.bit is None:
            return codec.encode(value)
        return codec.encode(value, self._link.read(blocks([codec])[0]).words)

    def _require(self, holds: bool, what: str, remedy: str) -> None:
        if not holds:
            raise LinkError(what, where=self._link.where, remedy=remedy)
