"""A relay running on the loop: commands it, keeps its switches, and names what is wrong when it does not oscillate."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import median

from autotune.errors import ExperimentStopped
from autotune.experiment.loop import ControlLoop, Tick
from autotune.experiment.relay import RelaySettings, RelayState, relay_step

#: waited-for half periods after which a switch that does not come is called no oscillation
PATIENCE = 6.0


class Oscillation:
    """A relay in a loop.

    Parameters
    ----------
    loop : ControlLoop
        Open.
    settings : RelaySettings
        First setting.
    patience_s : float
        Time without a switch after which the experiment stops [s].
    sign_is_sure : bool
        Whether the sign of the plant's gain was seen on the rig; else a plant that runs away has the wrong one.
    nudge_s : float
        Time without a switch after which the mid-point moves by half an amplitude: for a first guess far off [s].

    Attributes
    ----------
    edges : list of int
        Rows at which the command switched since the setting was made, the row of the change first if it was a switch.
    """

    def __init__(
        self,
        loop: ControlLoop,
        settings: RelaySettings,
        *,
        patience_s: float,
        sign_is_sure: bool = True,
        nudge_s: float = math.inf,
    ) -> None:
        self.loop = loop
        self.settings = settings
        self.edges: list[int] = []
        self.start_row = loop.tick.k
        self._state = RelayState()
        self._patience_s = patience_s
        self._last_switch_s = loop.tick.t_s
        self._first_error = math.nan
        self._sign_is_sure = sign_is_sure
        self._nudge_s = nudge_s
        self._last_nudge_s = loop.tick.t_s

    @property
    def switched(self) -> int:
        """Decisions the relay has taken in its life."""
        return self._state.switches

    def change(self, settings: RelaySettings, *, patience_s: float, nudge_s: float = math.inf) -> None:
        """Go on with another setting, from the next command on."""
        self.settings = settings
        self.edges = []
        self.start_row = self.loop.tick.k
        self._patience_s = patience_s
        self._nudge_s = nudge_s
        self._last_switch_s = self.loop.tick.t_s

    def move_centre(self, y_centre: float) -> None:
        """Oscillate around another measurement [y unit]; the setting is otherwise the same."""
        self.settings = replace(self.settings, y_centre=y_centre)

    def move_midpoint(self, midpoint: float) -> None:
        """Take another mid-point [u unit]; the setting is otherwise the same."""
        self.settings = replace(self.settings, midpoint=midpoint)

    def step(self) -> tuple[Tick, bool]:
        """Hold the relay's command for one sample; return the new sample, and whether the command switched.

        Raises
        ------
        ExperimentStopped
            No oscillation, wrong sign, or a relay level outside the command's range.
        """
        tick = self.loop.tick
        limits = self.loop.envelope.settings
        before = self._state.level
        self._state, u = relay_step(self._state, self.settings, tick.y)
        if not limits.u_min <= u <= limits.u_max:
            raise ExperimentStopped(
                f"saturated: the relay's level {u:.4g} is outside {limits.u_min:g}..{limits.u_max:g}",
                mend="choose another operating point, or a smaller relay_amplitude",
            )
        switched = before not in (0, self._state.level)
        if switched:
            self.edges.append(tick.k)
            self._last_switch_s = tick.t_s
        elif tick.t_s - max(self._last_switch_s, self._last_nudge_s) > self._nudge_s:
            self._last_nudge_s = tick.t_s
            self.move_midpoint(self.settings.midpoint + 0.5 * self._state.level * self.settings.amplitude)
        self._check_alive(tick)
        return self.loop.step(self.loop.nearest(u)), switched

    def _check_alive(self, tick: Tick) -> None:
        y = median(self.loop.monitor.recent)
        error = abs(y - self.settings.y_centre)
        if math.isnan(self._first_error):
            self._first_error = error
        doubtful = not self._sign_is_sure and self._state.switches == 0
        if doubtful and error - self._first_error > 0.5 * self.loop.envelope.settings.swing:
            raise ExperimentStopped(
                f"wrong sign: y = {y:.4g} moves away from {self.settings.y_centre:.4g} under the command that"
                " should bring it back",
                mend="check operating_point.plant_sign and the wiring of the actuator",
            )
        waited = tick.t_s - self._last_switch_s
        if waited > self._patience_s:
            raise ExperimentStopped(
                f"no oscillation: the relay has not switched for {waited:.3g} s, y = {y:.4g} stays on one side of"
                f" {self.settings.y_centre:.4g}",
                mend="look for a stuck actuator or a load; else check operating_point.u_guess and u_uncertainty",
            )
