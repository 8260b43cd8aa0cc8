"""Laws that the rig's device runs by itself: the host sets them, follows their rows, and watches the limits as well."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.errors import ExperimentStopped
from autotune.experiment.loop import ControlLoop, Tick
from autotune.experiment.oscillation import Oscillation
from autotune.experiment.relay import RelaySettings
from autotune.experiment.rig import RunsLaws, RunsRelay


def device_range(loop: ControlLoop) -> tuple[float, float]:
    """Return the limits on y that the device watches in the present state [y unit].

    It judges single readings, so that twice the noise is added to what the host allows the median of several.
    """
    limits, watch = loop.envelope.settings, loop.watch
    low, high = limits.y_min, limits.y_max
    if watch.y_centre is not None:
        low, high = max(low, watch.y_centre - limits.swing), min(high, watch.y_centre + limits.swing)
    return low - 2.0 * loop.monitor.noise, high + 2.0 * loop.monitor.noise


class DeviceOscillation(Oscillation):
    """A relay that the device runs at its own tick; its settings are in the host's samples as everywhere.

    Parameters
    ----------
    rig : RunsRelay
        The loop's rig.
    before : Oscillation
        The host's relay that it takes over from.

    Notes
    -----
    The device may have room for fewer readings in its average than the host. A shorter average delays the reading
    less, and so does sampling at the tick: the difference is added to the inserted delay. It also lets more noise
    through: the hysteresis is wider by that.
    """

    def __init__(self, rig: RunsRelay, before: Oscillation) -> None:
        super().__init__(before.loop, before.settings, patience_s=math.inf)
        self._rig = rig
        self._running: RelaySettings | None = None

    def step(self) -> tuple[Tick, bool]:
        """Wait for the device's next row; return its sample, and whether the command switched before it.

        Raises
        ------
        ExperimentStopped
            No oscillation, or a relay level or step that the limits do not allow.
        """
        loop = self.loop
        if self.settings != self._running:
            self._start()
        row = self._rig.row()
        try:
            tick = loop.follow(row)
        except ExperimentStopped as error:
            raise self.named(error) from error
        side = 1 if row.reading.u_applied > self.settings.midpoint else -1
        switched = self._state.level not in (0, side)
        self._state = replace(self._state, level=side)
        if switched:
            self.edges.append(tick.k - 1)
            self.slots.append(tick.slot - 1)
            self._last_switch_s = tick.t_s
        self._check_alive(tick)
        return tick, switched

    def _start(self) -> None:
        loop, settings = self.loop, self.settings
        limits = loop.envelope.settings
        low, high = settings.midpoint - settings.amplitude, settings.midpoint + settings.amplitude
        if not limits.u_min <= low <= high <= limits.u_max:
            raise ExperimentStopped(
                f"saturated: the relay's levels {low:.4g} and {high:.4g} leave {limits.u_min:g}..{limits.u_max:g}",
                remedy="choose another operating point, or a smaller relay_amplitude",
            )
        if high - low > limits.u_rate * loop.sample_time_s:
            raise ExperimentStopped(
                f"limit reached: the relay's step of {high - low:.4g} is more than limits.u_rate allows in one sample",
                remedy='ask for a smaller relay_amplitude, or let the host run it: rig.relay = "host"',
            )
        reading = self._rig.start_relay(
            in_ticks(settings, loop.sample_time_s / self._rig.tick_s, self._rig.smoothing_max),
            row_s=loop.sample_time_s,
            time_s=limits.time_s - loop.tick.t_s,
            y_range=device_range(loop),
        )
        if self._running is None:
            loop.begin(reading)
        self._running = settings


def in_ticks(settings: RelaySettings, ticks: float, smoothing_max: int) -> RelaySettings:
    """Return the setting of a relay that is stepped ``ticks`` times a sample and lags as much as the given one.

    Parameters
    ----------
    settings : RelaySettings
        In samples.
    ticks : float
        Ticks per sample.
    smoothing_max : int
        Readings in the longest average.
    """
    smoothing = max(1, min(smoothing_max, round(settings.smoothing * ticks)))
    # a crossing is seen half a reading late on average, and an average of M readings is (M - 1)/2 readings old
    lag = (settings.delay_samples + 0.5 * settings.smoothing) * ticks - 0.5 * smoothing
    blunter = math.sqrt(max(1.0, settings.smoothing / smoothing))
    return replace(settings, delay_samples=max(0.0, lag), smoothing=smoothing, hysteresis=settings.hysteresis * blunter)


def try_on_device(
    loop: ControlLoop,
    rig: RunsLaws,
    controller: PIDController,
    setpoint: FloatArray,
    load: FloatArray,
    tell: Callable[[int], None],
) -> tuple[FloatArray, FloatArray]:
    """Let the device's own PI run on gains that it does not keep, and ask of it what a test asks.

    Parameters
    ----------
    loop : ControlLoop
        Open, the rig at its operating point under a held command.
    rig : RunsLaws
        The loop's rig.
    controller : PIDController
        The gains.
    setpoint, load : (N,) array
        Set-point [y unit], and what is added to the PI's output [u unit], sample by sample.
    tell : callable
        Told the number of each sample.

    Returns
    -------
    y, u : (N,) array
        Measurement, NaN where unusable [y unit]; mean output of the PI over each sample, load not included [u unit].
    """
    y, u = np.full(setpoint.size, np.nan), np.empty(setpoint.size)
    for k in range(setpoint.size):
        tell(k)
        if k == 0 or (setpoint[k], load[k]) != (setpoint[k - 1], load[k - 1]):
            reading = rig.start_trial(
                controller,
                setpoint=float(setpoint[k]),
                load=float(load[k]),
                row_s=loop.sample_time_s,
                time_s=loop.envelope.settings.time_s - loop.tick.t_s,
                y_range=device_range(loop),
            )
            if k == 0:
                loop.begin(reading)
        y[k] = loop.tick.y if loop.tick.usable else np.nan
        row = rig.row()
        u[k] = row.u_mean - load[k]
        loop.follow(row, extra={"r": float(setpoint[k])})
    return y, u
