"""A relay running on the loop: commands it, keeps its switches, and names what is wrong when it does not oscillate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import median

import numpy as np

from autotune.errors import ExperimentStopped, LinkError
from autotune.experiment.loop import ControlLoop, Tick
from autotune.experiment.plan import PEAK_SHARE
from autotune.experiment.relay import RelaySettings, RelayState, relay_step

#: waited-for half periods after which a switch that does not come is called no oscillation
PATIENCE = 6.0
#: times to the extremum of y after which a plant that still runs away is not held by what is commanded
POWERLESS = 1.25
#: switches of one setting after which it has shown that it turns y
PROVEN = 2
#: rows that the noise is judged on
NOISE_ROWS = 100
#: rows in which y leaves its limits by a sensor's jump, and standard deviations of a step between rows that are one
JUMP_ROWS, JUMP_SIGMAS = 6, 6.0
#: share of missed samples from which on a relay that fails has failed on them
MISSED_SHARE = 0.2
#: part of a half period from when y turns in which another setting may take over
TURNING = 0.3
#: half-width of the noise, as a part of limits.swing, from which on a relay that fails has failed on it
NOISY_SHARE = 0.25


def noise_half(loop: ControlLoop) -> float:
    """Return twice the standard deviation of the noise over the last rows [y unit].

    From second differences, so that a plant that moves is not taken for noise, and from their median, nor are a few
    wild readings; on the way to the operating point a sensor at its rail hides half of it.
    """
    y = loop.history(max(0, loop.tick.k - NOISE_ROWS))[2]
    bends = np.abs(np.diff(y[np.isfinite(y)], 2))
    return 2.0 * 1.4826 * float(np.median(bends)) / math.sqrt(6.0) if bends.size else 0.0


def is_jump(loop: ControlLoop) -> bool:
    """Return whether y came where it is in one step that no earlier one resembles, lost samples counted."""
    t, _, y = loop.history(max(0, loop.tick.k - NOISE_ROWS))
    known = np.isfinite(y)
    steps = np.abs(np.diff(y[known])) / np.maximum(np.diff(t[known]) / loop.sample_time_s, 1.0)
    usual = 1.4826 * float(np.median(steps[:-JUMP_ROWS])) if steps.size > 2 * JUMP_ROWS else math.inf
    return bool(np.any(steps[-JUMP_ROWS:] > JUMP_SIGMAS * usual)) and usual > 0.0


def late_by(loop: ControlLoop, row: int) -> tuple[float, float]:
    """Return how late the latest sample since a row came at most [s], and by how much y moves meanwhile [y unit].

    Parameters
    ----------
    loop : ControlLoop
        With its rows so far.
    row : int
        The first that is looked at.
    """
    t, _, y = loop.history(row)
    steps, known = np.diff(t), np.isfinite(y)
    if steps.size < 2 or np.sum(known) < 3:
        return 0.0, 0.0
    late_s = float(np.max(steps)) - loop.sample_time_s
    speed = float(np.median(np.abs(np.gradient(y[known], t[known]))))
    return late_s, late_s * speed


def mean_command(loop: ControlLoop, edges: Sequence[int]) -> float:
    """Return the mean command [u unit] of the last whole period, every command weighted by the time it was held.

    Parameters
    ----------
    loop : ControlLoop
        Holds the rows.
    edges : sequence of int
        Rows at which the command switched, three at least.
    """
    t, u, _ = loop.history(edges[-3])
    rows = edges[-1] - edges[-3]
    return float(np.average(u[:rows], weights=np.diff(t[: rows + 1])))


def too_noisy(loop: ControlLoop) -> bool:
    """Return whether the noise is so wide that a relay which fails has failed on it."""
    return noise_half(loop) > NOISY_SHARE * loop.envelope.settings.swing


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
    edges, slots : list of int
        Rows at which the command switched since the setting was made, the row of the change first if it was a switch;
        and the sample times that they belong to, which run ahead of the rows where samples were missed.
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
        self.slots: list[int] = []
        self._stepped = loop.tick.slot - 1
        self.start_row = loop.tick.k
        self._state = RelayState()
        self._patience_s = patience_s
        self._last_switch_s = loop.tick.t_s
        self._first_error = math.nan
        self._sign_is_sure = sign_is_sure
        self._nudge_s = nudge_s
        self._last_nudge_s = loop.tick.t_s
        self._turning_s, self._foreseen = math.inf, False

    @property
    def is_turning(self) -> bool:
        """Whether y is at its extremum: the switch has turned it, and no decision is on its way."""
        if not math.isfinite(self._turning_s) or len(self.slots) < 2:
            return False
        since, turning = self.loop.tick.slot - self.slots[-1], round(self._turning_s / self.loop.sample_time_s)
        return turning <= since <= turning + TURNING * (self.slots[-1] - self.slots[-2])

    def go_to_extremum(self) -> None:
        """Go on until y turns, where it is known when that is.

        Elsewhere another setting would have y run away under its amplitude until a decision of this one's arrived.

        Raises
        ------
        ExperimentStopped
            As a step.
        """
        while math.isfinite(self._turning_s) and not self.is_turning:
            self.step()

    def change(
        self,
        settings: RelaySettings,
        *,
        patience_s: float,
        nudge_s: float = math.inf,
        turning_s: float = math.inf,
        foreseen: bool = False,
    ) -> None:
        """Go on with another setting, from the next command on.

        It turns y ``turning_s`` [s] after a switch; ``foreseen`` says that by the measured points it keeps within the
        swing.

        Parameters
        ----------
        settings : RelaySettings
            The next setting.
        patience_s : float
            Longest time without a switch [s].
        nudge_s : float
            Time without a switch after which the relay is nudged [s].
        turning_s : float
            How soon after a switch y turns [s].
        foreseen : bool
            Whether y keeps within the swing by the measured points.
        """
        self._turning_s, self._foreseen = turning_s, foreseen
        self.settings = settings
        self.edges, self.slots = [], []
        self.start_row = self.loop.tick.k
        self._patience_s = patience_s
        self._nudge_s = nudge_s
        self._last_switch_s = self.loop.tick.t_s

    def forget(self) -> None:
        """Forget the switches but the last."""
        self.edges, self.slots = self.edges[-1:], self.slots[-1:]

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
            No oscillation, wrong sign, a relay level outside the command's range, an actuator that gives less than is
            commanded, or noise that hides where y is.
        """
        tick = self.loop.tick
        limits = self.loop.envelope.settings
        before = self._state.level
        self._state, u = relay_step(self._state, self.settings, tick.y, slots=tick.slot - self._stepped)
        self._stepped = tick.slot
        if not limits.u_min <= u <= limits.u_max:
            raise ExperimentStopped(
                f"saturated: the relay's level {u:.4g} is outside {limits.u_min:g}..{limits.u_max:g}",
                remedy="choose another operating point, or a smaller relay_amplitude",
            )
        switched = before not in (0, self._state.level)
        if switched:
            self.edges.append(tick.k)
            self.slots.append(tick.slot)
            self._last_switch_s = tick.t_s
        elif tick.t_s - max(self._last_switch_s, self._last_nudge_s) > self._nudge_s:
            self._last_nudge_s = tick.t_s
            self.move_midpoint(self.settings.midpoint + 0.5 * self._state.level * self.settings.amplitude)
        self._check_alive(tick)
        try:
            return self.loop.step(self.loop.nearest(u)), switched
        except ExperimentStopped as error:
            raise self.named(error) from error

    def named(self, error: ExperimentStopped) -> ExperimentStopped:
        """Return the error with its cause, where y left its limits for one that can be told."""
        y, limits = median(self.loop.monitor.recent), self.loop.envelope.settings
        away = y - self.settings.y_centre
        if type(error) is not ExperimentStopped or abs(away) <= limits.swing:
            return error
        if self.loop.missed_share > MISSED_SHARE:
            return LinkError(
                f"link too slow: {100 * self.loop.missed_share:.0f} % of the latest samples were missed, and"
                f" y = {y:.4g} left the swing of {limits.swing:g} around {self.settings.y_centre:g}",
                remedy="unload the computer or the link (autotune doctor measures it), or raise signals.sample_time_s",
            )
        late_s, moved = late_by(self.loop, self.edges[-2] if len(self.edges) > 1 else self.start_row)
        if moved > abs(away) - PEAK_SHARE * limits.swing:
            return LinkError(
                f"link too slow: a sample came {late_s:.3g} s late, and y = {y:.4g} left the swing of {limits.swing:g}"
                f" around {self.settings.y_centre:g}",
                remedy="unload the computer or the link (autotune doctor measures it), or raise signals.sample_time_s",
            )
        if is_jump(self.loop):
            return ExperimentStopped(
                f"the sensor jumps: y = {y:.4g} left the swing of {limits.swing:g} around {self.settings.y_centre:g} in"
                " one step",
                remedy="check the sensor, its wiring and its scaling in the configuration",
            )
        if too_noisy(self.loop):
            return ExperimentStopped(
                f"drowned in noise: y = {y:.4g} left the swing of {limits.swing:g} around {self.settings.y_centre:g},"
                f" and noise of +-{noise_half(self.loop):.3g} hides where it is",
                remedy="filter the measurement at the device, or allow more swing",
            )
        # a relay that has turned y before, or was chosen from measured points to do so, is not simply too strong
        expected = self._foreseen or len(self.edges) > PROVEN
        pushed_back = away * self._state.level * self.settings.plant_sign < 0.0
        runs_away = pushed_back and self.loop.tick.t_s - self._last_switch_s > POWERLESS * self._turning_s
        if expected or runs_away:
            level = self.settings.midpoint + self._state.level * self.settings.amplitude
            return ExperimentStopped(
                f"y does not follow the command: {y:.4g} left the swing of {limits.swing:g} around"
                f" {self.settings.y_centre:g} at the command {level:.4g}, where it should turn (saturated, stuck or"
                " reversed actuator, load, or sensor)",
                remedy="look at actuator and sensor, and for a load; else choose another operating point",
            )
        return error

    def _check_alive(self, tick: Tick) -> None:
        y = median(self.loop.monitor.recent)
        error = abs(y - self.settings.y_centre)
        if math.isnan(self._first_error):
            self._first_error = error
        sign_unknown = not self._sign_is_sure and self._state.switches == 0
        if sign_unknown and error - self._first_error > 0.5 * self.loop.envelope.settings.swing:
            raise ExperimentStopped(
                f"wrong sign: y = {y:.4g} moves away from {self.settings.y_centre:.4g} under the command that"
                " should bring it back",
                remedy="check operating_point.plant_sign and the wiring of the actuator",
            )
        waited = tick.t_s - self._last_switch_s
        if waited > self._patience_s:
            raise ExperimentStopped(
                f"no oscillation: the relay has not switched for {waited:.3g} s, y = {y:.4g} stays on one side of"
                f" {self.settings.y_centre:.4g}",
                remedy="look for a stuck actuator or a load; else check operating_point.u_guess and u_uncertainty",
            )
