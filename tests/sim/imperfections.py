"""What real rigs do to signals: a plant and a rig with faults that come and go on schedule."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from autotune.controller import PIDController
from autotune.errors import LinkError
from autotune.experiment.rig import Reading
from drivers.simulated import SimulatedRig
from sim.plant import Plant

FaultKind: TypeAlias = Literal[
    "frozen sensor", "not a number", "spikes", "sensor at full scale", "stuck actuator", "saturated actuator",
    "inverted actuator", "cut link",
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One fault and when it acts.

    Attributes
    ----------
    kind : str
        ``frozen sensor`` repeats the last reading; ``not a number`` answers NaN; ``spikes`` replaces one reading in
        twenty by ``value``; ``sensor at full scale`` answers ``value``; ``stuck actuator`` keeps the command it had;
        ``saturated actuator`` lets no command above ``value`` through; ``inverted actuator`` mirrors the command at
        ``value``; ``cut link`` cuts the link of a :class:`FaultyRig`.
    start_s, end_s : float
        Plant time between which it acts [s].
    value : float
        Level that goes with the kind [its signal's unit].
    """

    kind: FaultKind
    start_s: float = 0.0
    end_s: float = math.inf
    value: float = 10.0


class FaultyPlant:
    """A plant with faults; truth accessors tell the truth about the plant without them."""

    def __init__(self, plant: Plant, faults: Sequence[Fault], *, seed: int = 0) -> None:
        self.plant = plant
        self._faults = tuple(faults)
        self._random = np.random.default_rng((seed, 3))
        self._last_y = math.nan
        self._last_u = plant.u_applied

    @property
    def time_s(self) -> float:
        """Time the plant has lived [s]."""
        return self.plant.time_s

    @property
    def u_applied(self) -> float:
        """Command the actuator really holds [u unit]."""
        return self.plant.u_applied

    @property
    def u_rest(self) -> float:
        """Truth: command at rest [u unit]."""
        return self.plant.u_rest

    @property
    def y_true(self) -> float:
        """Truth: the sensor's signal before noise, converter and faults [y unit]."""
        return self.plant.y_true

    def response(self, omega_rad_s: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Truth: small-signal complex gain of the plant without faults."""
        return self.plant.response(omega_rad_s)

    @property
    def is_cut_off(self) -> bool:
        """Whether the link is cut."""
        return any(fault.kind == "cut link" for fault in self._active())

    def advance(self, u: float, dt_s: float) -> None:
        """Hold what the faults leave of a command.

        Parameters
        ----------
        u : float
            Command that is held [u unit].
        dt_s : float
            How long [s].
        """
        for fault in self._active():
            match fault.kind:
                case "stuck actuator":
                    u = self._last_u
                case "saturated actuator":
                    u = min(u, fault.value)
                case "inverted actuator":
                    u = 2.0 * fault.value - u
        self._last_u = u
        self.plant.advance(u, dt_s)

    def measure(self) -> float:
        """Return what the faults leave of the measurement [y unit]."""
        y = self.plant.measure()
        for fault in self._active():
            match fault.kind:
                case "frozen sensor" if not math.isnan(self._last_y):
                    y = self._last_y
                case "not a number":
                    y = math.nan
                case "sensor at full scale":
                    y = fault.value
                case "spikes":
                    y = fault.value if self._random.random() < 0.05 else y
        self._last_y = y
        return y

    def _active(self) -> list[Fault]:
        return [fault for fault in self._faults if fault.start_s <= self.plant.time_s < fault.end_s]


class FaultyRig(SimulatedRig):
    """A simulated rig whose link is cut while its plant says so."""

    def open(self) -> None:
        self._check_link()
        super().open()

    def read(self) -> Reading:
        self._check_link()
        return super().read()

    def write(self, u: float) -> None:
        self._check_link()
        super().write(u)

    def read_gains(self) -> PIDController:
        self._check_link()
        return super().read_gains()

    def write_gains(self, controller: PIDController) -> None:
        self._check_link()
        super().write_gains(controller)

    def _check_link(self) -> None:
        if isinstance(self.plant, FaultyPlant) and self.plant.is_cut_off:
            raise LinkError("link cut", where="simulated rig", remedy="check the cable and the device")
