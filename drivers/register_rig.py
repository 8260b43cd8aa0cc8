"""A rig behind a register map: samples, commands, dead-man, the device's own controller."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Protocol

from autotune.config.registers import RegisterMap
from autotune.controller import PIDController
from autotune.errors import InputError, LinkError
from autotune.experiment.rig import Clock, Reading
from drivers.clock import MonotonicClock
from drivers.registers import Block, Codec, blocks, codecs

_SAMPLE = ("y", "u_applied", "device_time", "heartbeat_echo", "in_command")


class RegisterLink(Protocol):
    """What a rig needs of a transport; every method may raise LinkError."""

    @property
    def where(self) -> str:
        """The device, for messages."""
        ...

    def connect(self) -> None:
        """Connect; nothing where there is a connection."""
        ...

    def disconnect(self) -> None:
        """Disconnect; may be called more than once."""
        ...

    def distrust(self) -> None:
        """Make sure that no earlier answer is taken for the next one."""
        ...

    def read(self, block: Block) -> tuple[Sequence[int], bool]:
        """Return the block's words, and whether they are suspect."""
        ...

    def write(self, table: str, address: int, words: Sequence[int]) -> bool:
        """Write words, and return whether that is suspect."""
        ...


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

    Raises
    ------
    InputError
        The register of the command cannot hold the whole range of commands.

    Notes
    -----
    A sample's time stamp is the middle between request and answer. The wait of one request is bounded by the link's
    time-outs and retries.
    """

    def __init__(
        self,
        link: RegisterLink,
        registers: RegisterMap,
        *,
        u_range: tuple[float, float],
        u_safe: float,
        feed_s: float = 0.1,
    ) -> None:
        self._link = link
        self._codecs = codecs(registers.mapped())
        self._clock = MonotonicClock()
        self._u_range = u_range
        self._u_safe = u_safe
        self._feed_s = feed_s
        for u in (*u_range, u_safe):
            self._codecs["u"].encode(u)
        self._sample_blocks = blocks([self._codecs[name] for name in _SAMPLE if name in self._codecs])
        self._command_blocks = blocks([self._codecs[name] for name in ("u", "heartbeat") if name in self._codecs])
        self._checks_echo = "heartbeat_echo" in self._codecs
        self._beats = int(self._codecs["heartbeat"].span[1]) + 1 if "heartbeat" in self._codecs else 1
        # a device that was left with an old heartbeat must not seem to echo the first one
        self._beat = random.randrange(self._beats)
        self._fed_s = -math.inf
        self._u = u_safe
        self._is_open = False
        self._is_commanding = False

    @property
    def clock(self) -> Clock:
        """The monotonic clock."""
        return self._clock

    def open(self) -> None:
        """Connect and take command without a bump where the device says what it applies, else at the safe output."""
        self._link.connect()
        self._is_open = True
        self._fed_s = -math.inf  # nothing to be echoed yet
        taken = self._sample()[0].u_applied
        if "safe" in self._codecs:
            self._put("safe", self._u_safe)
        low, high = self._u_range
        self._u = taken if low <= taken <= high else self._u_safe  # NaN compares false
        self._is_commanding = True
        self._command()
        if "enable" in self._codecs:
            self._put("enable", 1.0)

    def read(self) -> Reading:
        """Take one sample; feeds the dead-man when that is due.

        Raises
        ------
        LinkError
            No answer, or one that does not carry the last heartbeat, also after the link was flushed; or the device
            says that it no longer lets the host command.
        """
        self._require(self._is_open, "the rig is not open", "open it before the first sample")
        if self._is_commanding and self._clock.now() - self._fed_s > self._feed_s:
            self._feed()
        reading, values = self._sample()
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
            The register cannot hold the value.
        LinkError
            The device did not acknowledge it, or after a retry holds another value.
        """
        self._require(self._is_commanding, "the host is not in command", "open the rig again")
        self._u = u
        self._command()

    def make_safe(self) -> None:
        """Command the safe output, stop the device's own controller and give the actuator back.

        Raises
        ------
        LinkError
            The device could not be reached, also over a new connection; its dead-man sets the safe output.
        """
        if not self._is_open:
            return
        try:
            self._go_safe()
        except LinkError:
            self._link.disconnect()
            self._link.connect()
            self._go_safe()

    def close(self) -> None:
        """Disconnect."""
        self._is_open = self._is_commanding = False
        self._link.disconnect()

    def _go_safe(self) -> None:
        self._is_commanding = False
        self._u = self._u_safe
        self._command()
        for name in ("automatic", "enable"):
            if name in self._codecs:
                self._put(name, 0.0)

    def _sample(self) -> tuple[Reading, dict[str, float]]:
        """Return a sample that carries the last heartbeat, asking a second time over a flushed link."""
        for _ in range(2):
            reading, values = self._ask()
            echo = values.get("heartbeat_echo", math.nan)
            if not self._checks_echo or echo == self._beat or self._fed_s < 0:
                return reading, values
            self._link.distrust()
        raise LinkError(
            f"the device echoes heartbeat {echo:g}, not {self._beat}",
            where=self._link.where,
            remedy="it restarted, another master writes to it, or heartbeat_echo is mapped wrongly",
        )

    def _ask(self) -> tuple[Reading, dict[str, float]]:
        start_s = middle_s = self._clock.now()
        values: dict[str, float] = {}
        suspect = False
        for block in self._sample_blocks:
            words, again = self._link.read(block)
            if not values:  # the first block is the one with y
                middle_s = 0.5 * (start_s + self._clock.now())
            values |= block.decode(words)
            suspect |= again
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
        beat = (self._beat + 1) % self._beats
        values = {"u": self._u, "heartbeat": float(beat)}
        for block in self._command_blocks:
            words = [word for codec, _ in block.parts for word in codec.encode(values[codec.name])]
            suspect = self._link.write(block.table, block.address, words)
            if suspect and list(self._link.read(block)[0]) != words:
                raise LinkError(
                    "a command was sent twice and the device holds another one",
                    where=self._link.where,
                    remedy="let only one master write to the device, or raise timeout_s",
                )
        self._beat = beat
        self._fed_s = self._clock.now()

    def _feed(self) -> None:
        if "heartbeat" not in self._codecs:
            return
        beat = (self._beat + 1) % self._beats
        self._put("heartbeat", float(beat))
        self._beat = beat
        self._fed_s = self._clock.now()

    def _put(self, name: str, value: float) -> None:
        codec = self._codecs[name]
        self._link.write(codec.register.table, codec.register.address, codec.encode(value))

    def _require(self, holds: bool, what: str, remedy: str) -> None:
        if not holds:
            raise LinkError(what, where=self._link.where, remedy=remedy)


class GainRegisterRig(RegisterRig):
    """A device whose own PI is in the register map as well."""

    def read_gains(self) -> PIDController:
        """Return the gains the device's controller holds now."""
        values: dict[str, float] = {}
        self._link.connect()
        for block in self._gain_blocks():
            values |= block.decode(self._link.read(block)[0])
        return PIDController(K=values["K"], Ti_s=values["Ti"])

    def write_gains(self, controller: PIDController) -> None:
        """Write gains and read them back; where that fails the old ones are written again.

        Raises
        ------
        InputError
            The controller is no PI, or a gain does not fit its register; nothing was written.
        LinkError
            What is read back differs, or the link broke; says what the device holds, as far as it is known.
        """
        if controller.kind != "pi":
            raise InputError("the device holds a PI", where=self._link.where, remedy="design one with --kind pi")
        self._link.connect()
        gains = {"K": controller.K, "Ti": controller.Ti_s}
        parts = self._gain_blocks()
        new = [[word for codec, _ in block.parts for word in codec.encode(gains[codec.name])] for block in parts]
        old = [list(self._link.read(block)[0]) for block in parts]
        try:
            self._write_checked(parts, new)
        except LinkError as error:
            raise self._restored(parts, old, error) from None

    def start_controller(self, setpoint: float) -> None:
        """Give the actuator to the device's own controller, at a set-point [y unit].

        Raises
        ------
        InputError
            The register map has no ``automatic`` or no ``setpoint``; nothing was done.
        """
        for name in ("automatic", "setpoint"):
            if name not in self._codecs:
                raise InputError(f"{name} is not mapped", where=self._link.where, remedy=f"map rig.registers.{name}")
        self._link.connect()
        self._put("setpoint", setpoint)
        self._put("automatic", 1.0)
        if "enable" in self._codecs:
            self._put("enable", 0.0)
        self._is_commanding = False

    def _gain_blocks(self) -> tuple[Block, ...]:
        return blocks(self._gain_codecs())

    def _gain_codecs(self) -> list[Codec]:
        return [self._codecs["K"], self._codecs["Ti"]]

    def _write_checked(self, parts: Sequence[Block], words: Sequence[list[int]]) -> None:
        for block, wanted in zip(parts, words, strict=True):
            self._link.write(block.table, block.address, wanted)
        for block, wanted in zip(parts, words, strict=True):
            held = list(self._link.read(block)[0])
            if held != wanted:
                raise LinkError(f"read back {held} where {wanted} was written", where=self._link.where)

    def _restored(self, parts: Sequence[Block], old: Sequence[list[int]], cause: LinkError) -> LinkError:
        """Write the old gains again and return the error that says how it ended."""
        try:
            self._link.disconnect()
            self._link.connect()
            self._write_checked(parts, old)
        except LinkError:
            state, remedy = "the device may hold old, new or mixed gains", "stop it and check its gains before it runs"
        else:
            state, remedy = "the device holds its old gains again", cause.remedy
        return LinkError(f"the gains were not taken ({cause.what}); {state}", where=self._link.where, remedy=remedy)
