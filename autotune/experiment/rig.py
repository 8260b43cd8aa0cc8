"""What the experiment needs of a rig: small protocols by capability. Time is injected through the rig's clock."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from autotune.controller import PIDController
from autotune.experiment.relay import RelaySettings


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One sample of the rig.

    Attributes
    ----------
    t_s : float
        Time of the measurement on the rig's clock [s].
    y : float
        Measurement in engineering units; NaN where the device sent something that is not a number.
    u_applied : float
        Output the device says it applies, in engineering units; NaN where it does not say.
    device_time_s : float
        Device time stamp [s]; NaN where it has none.
    latency_s : float
        Time the read took on the link [s]; NaN where the device sent it by itself.
    suspect : bool
        Whether the link had to retry or the answer did not identify itself: not to be used in an estimate.
    foreign_u : float
        Command that another master had put in place of the session's own before this sample [u unit]; NaN where there
        was none, or nobody looked.
    """

    t_s: float
    y: float
    u_applied: float = math.nan
    device_time_s: float = math.nan
    latency_s: float = 0.0
    suspect: bool = False
    foreign_u: float = math.nan


class Clock(Protocol):
    """Time as the rig lives it: virtual for a simulated rig, monotonic for a real one."""

    def now(self) -> float:
        """Return the time [s]."""
        ...

    def sleep_until(self, t_s: float) -> None:
        """Return at the absolute deadline ``t_s`` [s], at once when it has passed."""
        ...


class Rig(Protocol):
    """A plant that can be measured and commanded.

    Every method may raise :class:`autotune.errors.LinkError`. ``make_safe`` and ``close`` can be called in any
    state, more than once.
    """

    @property
    def clock(self) -> Clock:
        """The clock that the rig's time stamps are on."""
        ...

    def open(self) -> None:
        """Connect and take command of the actuator (enable coil, host-in-the-loop mode)."""
        ...

    def read(self) -> Reading:
        """Take one sample."""
        ...

    def write(self, u: float) -> None:
        """Command the actuator, in engineering units; also feeds the device's dead-man timer."""
        ...

    def make_safe(self) -> None:
        """Command the safe output and give the actuator back."""
        ...

    def close(self) -> None:
        """Disconnect."""
        ...


@runtime_checkable
class Feeds(Rig, Protocol):
    """A rig whose dead-man can be fed without a command: while the host waits for its next sample."""

    def feed(self) -> None:
        """Feed the dead-man where that is due."""
        ...


@runtime_checkable
class ShowsOutput(Rig, Protocol):
    """A rig that can say whether its readings carry the output that the device applies."""

    @property
    def shows_output(self) -> bool:
        """Whether :attr:`Reading.u_applied` is a number."""
        ...


@dataclass(frozen=True, kw_only=True)
class Former:
    """How the rig's own controller ran before the host took command.

    Attributes
    ----------
    setpoint : float
        Its set-point [y unit]; NaN where the rig does not say.
    """

    setpoint: float = math.nan

    def __str__(self) -> str:
        at = f" at set-point {self.setpoint:.6g}" if math.isfinite(self.setpoint) else ""
        return f"automatic{at}"


@runtime_checkable
class HandsBack(Rig, Protocol):
    """A rig whose own controller may have run before, and can be given the actuator back without a bump."""

    @property
    def former(self) -> Former | None:
        """How it ran when the rig was opened; None where it did not."""
        ...

    def hand_back(self) -> None:
        """Give it the actuator, its mode and its set-point back; raises LinkError where that is not certain."""
        ...


@runtime_checkable
class Exchanges(Rig, Protocol):
    """A rig that takes a command and answers with the sample of the very instant from which the command acts.

    The device stamps of its readings are exact, and a recording counts its time on them: neither the line's latency nor
    the host's lateness is in it.
    """

    def exchange(self, u: float) -> Reading:
        """Command the actuator, in engineering units, and return the sample at which ``u`` begins to act."""
        ...


@dataclass(frozen=True, kw_only=True)
class Row:
    """What a device that runs a law by itself says of one sample.

    Attributes
    ----------
    reading : Reading
        The sample; ``u_applied`` acts from its instant on.
    u_mean : float
        Mean output since the row before [u unit]: its area is exact, however often the law moved the output.
    """

    reading: Reading
    u_mean: float


@runtime_checkable
class RunsRelay(Rig, Protocol):
    """A rig whose device runs the relay by itself, in ticks shorter than the host's samples, and tells of its rows.

    The host's next command ends what runs, without a bump. The device ends it at the safe output where y leaves its
    range, the time is over, or the host falls silent.
    """

    @property
    def tick_s(self) -> float:
        """Period of the device's own loop [s]; known once the rig has been opened."""
        ...

    @property
    def smoothing_max(self) -> int:
        """Readings in the longest average that the device's relay can look at."""
        ...

    def start_relay(
        self, settings: RelaySettings, *, row_s: float, time_s: float, y_range: tuple[float, float]
    ) -> Reading:
        """Run the relay, or change the setting of one that runs; return the last sample before.

        Parameters
        ----------
        settings : RelaySettings
            The relay, its delay in ticks.
        row_s : float
            Time between two rows [s].
        time_s : float
            How long it may run before the device ends it [s].
        y_range : (float, float)
            Lowest and highest y; beyond them the device ends it [y unit].
        """
        ...

    def row(self) -> Row:
        """Wait for the next row."""
        ...


@runtime_checkable
class RunsLaws(RunsRelay, Exchanges, Protocol):
    """A rig whose device runs its PI on trial as it runs the relay."""

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
        """Run the PI on gains that are not kept, or change what is asked of it; return the last sample before.

        Parameters
        ----------
        controller : PIDController
            The gains.
        setpoint : float
            Set-point [y unit].
        load : float
            Added to its output [u unit].
        row_s : float
            Time between two rows [s].
        time_s : float
            How long it may run before the device ends it [s].
        y_range : (float, float)
            Lowest and highest y; beyond them the device ends it [y unit].
        """
        ...


@runtime_checkable
class HoldsGains(Rig, Protocol):
    """A rig whose own controller's gains can be read and written."""

    def read_gains(self) -> PIDController:
        """Return the gains the device's controller holds now."""
        ...

    def write_gains(self, controller: PIDController) -> None:
        """Write gains and read them back; raises LinkError if what is read back differs."""
        ...


@runtime_checkable
class RunsOwnController(HoldsGains, Protocol):
    """A rig whose own controller, on the gains that it holds, may be given the actuator by the host and watched."""

    @property
    def not_startable(self) -> str:
        """What the host lacks for that, as half a sentence; empty where it can."""
        ...

    @property
    def guards_trial(self) -> bool:
        """Whether the rig takes its safe output where the host falls silent while that controller is on trial."""
        ...

    @property
    def takes_load(self) -> bool:
        """Whether a load can be added to the output of the rig's own controller."""
        ...

    @property
    def scan_time_s(self) -> float:
        """Cycle of the device's program [s]; what is assumed where nobody said it."""
        ...

    def start_controller(self, setpoint: float) -> float:
        """Give it the actuator at a set-point [y unit], readings go on; return the set-point as the device holds it."""
        ...

    def take_command(self) -> None:
        """Take the actuator back from it, the output held where it is; nothing where the host has it already."""
        ...

    def ask_controller(self, setpoint: float, load: float) -> tuple[float, float]:
        """Change what the rig's own controller is asked for; return both as the device holds them.

        Raises LinkError where somebody else has changed what it was asked for before.

        Parameters
        ----------
        setpoint : float
            Set-point [y unit].
        load : float
            Added to its output [u unit].
        """
        ...

    def misread(self, controller: PIDController) -> Mapping[str, PIDController]:
        """Return what a device would hold that reads the registers of the gains otherwise, by how."""
        ...

    def misread_setpoint(self, setpoint: float) -> Mapping[str, float]:
        """Return what a device would regulate to that reads the set-point's register otherwise, by how [y unit]."""
        ...


class TrialGains(Protocol):
    """Gains that are in a rig's own controller for as long as it is on trial; both are called while the host commands.

    Whoever made them keeps a record of what the rig holds, and may be asked to take out what was never put in.
    """

    def put_in(self) -> None:
        """Write the new gains."""
        ...

    def take_out(self) -> None:
        """Write the old gains again, where that is still to be done."""
        ...


@runtime_checkable
class RoundsGains(HoldsGains, Protocol):
    """A rig whose registers hold gains in steps: what they can hold is the controller."""

    @property
    def takes_weight(self) -> bool:
        """Whether a weight of the set-point can be written."""
        ...

    def holdable(self, controller: PIDController) -> PIDController:
        """Return the controller that the rig would hold after these gains were written; nothing is written."""
        ...

    def coarse(self, controller: PIDController) -> tuple[str, ...]:
        """Return which settings are held too coarsely, each with the resolution that would do."""
        ...
