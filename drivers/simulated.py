"""A simulated plant as a rig, in process and on a virtual clock: as fast as the processor allows, or watched."""

from __future__ import annotations

import math

from autotune.config.rig import SimulatedRigSettings
from autotune.controller import PIDController
from autotune.errors import LinkError
from autotune.experiment.rig import Clock, Reading
from drivers.clock import MonotonicClock
from drivers.kinds import Session
from drivers.plants import plant_of
from sim.plant import Plant


class VirtualClock:
    """Time that moves only when somebody waits; the plant lives on meanwhile under the command it holds.

    Parameters
    ----------
    rig : SimulatedRig
        Whose time it is.
    speed : float
        Seconds of the rig in a second of whoever watches; infinite where nobody does.
    watched : Clock
        Time of whoever watches. What is computed between two samples is not caught up.
    """

    def __init__(self, rig: SimulatedRig, speed: float, watched: Clock) -> None:
        self._rig, self._speed, self._watched = rig, speed, watched
        self._now_s = 0.0

    def now(self) -> float:
        """Return the virtual time [s]."""
        return self._now_s

    def sleep_until(self, t_s: float) -> None:
        """Let the plant live until ``t_s`` [s]; at once when that has passed."""
        if t_s > self._now_s:
            if self._speed < math.inf:
                self._watched.sleep_until(self._watched.now() + (t_s - self._now_s) / self._speed)
            self._rig.live(t_s - self._now_s)
            self._now_s = t_s


class SimulatedRig:
    """A rig around any simulated plant.

    Parameters
    ----------
    plant : Plant
        The plant.
    u_safe : float
        Command that ``make_safe`` leaves [u unit].
    controller : PIDController, optional
        Gains that the rig's own controller holds when it is delivered.
    speed : float
        Seconds of the rig in a second of whoever watches; infinite: as fast as the processor allows.
    watched : Clock, optional
        Time of whoever watches; the computer's where not given.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        u_safe: float,
        controller: PIDController | None = None,
        speed: float = math.inf,
        watched: Clock | None = None,
    ) -> None:
        self.plant = plant
        self._u = plant.u_applied
        self._u_safe = u_safe
        self._controller = controller if controller is not None else PIDController(K=0.0, Ti_s=math.inf)
        self._clock = VirtualClock(self, speed, watched if watched is not None else MonotonicClock())
        self._is_open = False

    @property
    def clock(self) -> VirtualClock:
        """The virtual clock."""
        return self._clock

    @property
    def command(self) -> float:
        """Command the rig holds now [u unit]."""
        return self._u

    def live(self, dt_s: float) -> None:
        """Let the plant live for ``dt_s`` [s] under the command it holds."""
        self.plant.advance(self._u, dt_s)

    def open(self) -> None:
        """Take command."""
        self._is_open = True

    def read(self) -> Reading:
        """Take one sample."""
        self._require_open()
        return Reading(
            t_s=self._clock.now(),
            y=self.plant.measure(),
            u_applied=self.plant.u_applied,
            device_time_s=self.plant.time_s,
        )

    def write(self, u: float) -> None:
        """Hold ``u`` [u unit] from now on."""
        self._require_open()
        self._u = u

    def make_safe(self) -> None:
        """Hold the safe output, also where the rig is not open."""
        self._u = self._u_safe

    def close(self) -> None:
        """Give the rig back."""
        self._is_open = False

    def read_gains(self) -> PIDController:
        """Return the gains the rig's own controller holds."""
        return self._controller

    def write_gains(self, controller: PIDController) -> None:
        """Hand gains to the rig's own controller."""
        self._controller = controller

    def _require_open(self) -> None:
        if not self._is_open:
            raise LinkError("the rig is not open", where="simulated rig", remedy="open it before the first sample")


def open_kind(settings: SimulatedRigSettings, session: Session) -> SimulatedRig:
    """Return the rig that ``[rig] kind = "simulated"`` describes, not yet opened.

    Parameters
    ----------
    settings : SimulatedRigSettings
        The table ``[rig]``.
    session : Session
        What it is opened for.
    """
    plant = plant_of(settings, u_safe=session.u_safe)
    return SimulatedRig(plant, u_safe=session.u_safe, controller=session.controller, speed=session.speed)
